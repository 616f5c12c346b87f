"""Recordings of two thermal cameras: each has a lens, dead pixels and counts of its own."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import read_frames, write_images

from benchmarks.camera_folder import Field, dead_pixels, write_camera
from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.synthetic_scene.film import Recording, Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.preparation.devices import devices_of
from heatsplat.preparation.doctor import check
from heatsplat.preparation.features import Sift
from heatsplat.preparation.frame import CameraInfo, ThermalFrame
from heatsplat.preparation.frames import read_recording
from heatsplat.preparation.poses import FindPoses
from heatsplat.preparation.prepare import prepare

pytestmark = pytest.mark.usefixtures("dots_for_pictures")
PLAIN = {"conditions": {}, "uncertainty": {}, "counts": {}}
DEAD = {"a": (0, 6), "b": (5, 7)}  # seed and number of the dead pixels of either camera


@cache
def filmed() -> tuple[Recording, ...]:
    of_both = ((0, 160, 128), (1, 240, 192))
    return tuple(film(Scene(PRESETS["static"]), Size(w, h, 6, 60), seed) for seed, w, h in of_both)


def write_two(folder: Path, cut: bool = False) -> tuple[float, float]:
    """Two cameras that filmed the same room, in folders a and b: 160x128 pixels, and 240x192 or the middle of it.

    Returns their focal lengths in pixels.
    """
    one, other = filmed()
    if cut:
        lens = replace(other.lens, width=160, height=128, cx=other.lens.cx - 40.0, cy=other.lens.cy - 32.0)
        other = replace(other, celsius=other.celsius[:, 32:160, 40:200], lens=lens)
    for name, recording, model in (("a", one, "Thermal 12"), ("b", other, "Thermal 18")):
        seed, dead = DEAD[name]
        write_camera(recording, folder / name, Field(dead_pixels=dead, model=model), seed=seed)
    return one.lens.fx, other.lens.fx


def frame(name: str, size: tuple[int, int] | None = (8, 6), **camera) -> ThermalFrame:
    return ThermalFrame(
        name, Path(f"{name}.tiff"), 0, lambda: np.zeros((6, 8), np.float32), camera=CameraInfo(**camera), size=size
    )


@pytest.mark.parametrize(
    ("other", "cameras"),
    [
        ({"model": "M", "serial": "1", "focal_mm": 13.0}, 1),
        ({"model": "M", "serial": "1", "focal_mm": 13.4}, 1),  # another focus
        ({"model": "M", "serial": "1", "focal_mm": 19.0}, 2),  # another lens
        ({"model": "M", "serial": "2", "focal_mm": 13.0}, 2),
        ({"model": "N", "serial": "1", "focal_mm": 13.0}, 2),
        ({"model": "M", "serial": "1", "focal_mm": 13.0, "size": (4, 3)}, 2),
        ({}, 1),  # a file that says nothing contradicts nothing
    ],
)
def test_frames_are_of_one_camera_where_nothing_that_they_say_of_it_differs(other, cameras):
    said = {"model": "M", "serial": "1", "focal_mm": 13.0}
    for frames in ([frame("a", **other), frame("b", **said)], [frame("a", **said), frame("b", **other)]):
        found = devices_of(frames)
        assert len(found) == cameras and [d.frames[0].name for d in found] == ["a", "b"][:cameras]


def test_a_camera_is_told_by_what_its_files_say():
    (one,) = devices_of([frame("a"), frame("b", make="FLIR", model="T640", serial="7", focal_mm=13.1)])
    assert one.label == "FLIR T640 7, 8x6 pixels, focal length 13.1 mm" and [f.name for f in one.frames] == ["a", "b"]
    assert devices_of([frame("a", size=None)])[0].label == "unknown camera"


@pytest.mark.parametrize("cut", [False, True], ids=["other size", "other lens"])
def test_two_cameras_are_prepared_with_a_lens_and_dead_pixels_of_each(tmp_path, caplog, cut):
    focal = write_two(tmp_path / "files", cut=cut)
    with caplog.at_level("WARNING", "heatsplat"):
        page = prepare(str(tmp_path / "files"), tmp_path / "scene", **PLAIN, poses=FindPoses(Sift(most=1000)))
    assert "2 thermal cameras, each with a lens and dead pixels of its own: " in caplog.text
    assert "Synthetic Thermal 18" in page.read_text() and "13 pixels of the detector are dead" in page.read_text()
    sizes = {"a": (160, 128), "b": (160, 128) if cut else (240, 192)}
    model = read_model(tmp_path / "scene")
    found = {name[0]: lens for name, lens in zip(model.names, model.lenses, strict=True)}
    for name, focal_px in zip("ab", focal, strict=True):
        assert found[name].fx == pytest.approx(focal_px) and (found[name].width, found[name].height) == sizes[name]
        mask = cv2.imread(str(tmp_path / f"scene/masks/{name}_thermal_frame_0003_T.tiff.png"), cv2.IMREAD_GRAYSCALE)
        true = dead_pixels(*sizes[name][::-1], DEAD[name][1], DEAD[name][0])
        assert set(map(tuple, np.argwhere(mask == 0).tolist())) == set(map(tuple, true.tolist()))
    views = [*(scene := Colmap(root=str(tmp_path / "scene")).scene).train, *scene.test]
    assert {view.frame.name[0]: (view.frame.camera.width, view.frame.camera.height) for view in views} == sizes


def test_the_doctor_looks_at_each_camera_s_files(tmp_path):
    write_two(tmp_path / "files", cut=True)
    found = check(str(tmp_path / "files"), tmp_path)
    assert sorted(one.what[: one.what.index("pixels differ")] for one in found) == [
        "Synthetic Thermal 12, 160x128 pixels, focal length 2.16 mm: 6 ",
        "Synthetic Thermal 18, 160x128 pixels, focal length 3.23 mm: 7 ",
    ]


def test_what_is_of_one_camera_alone_is_refused_for_two(tmp_path):
    write_two(tmp_path / "files")
    frames = read_frames(tmp_path / "files")
    (tmp_path / "scene" / "images").mkdir(parents=True)
    for options in ({"by": "rgb"}, {"focal_px": 200.0}):
        with pytest.raises(SceneError, match="here are 2: .*Thermal 18.*[Pp]ut each into a folder of its own"):
            FindPoses(Sift(), **options)(frames, tmp_path / "scene")


def test_counts_of_each_camera_are_judged_by_its_own(tmp_path):
    celsius = np.random.default_rng(0).normal(20.0, 3.0, (24, 32))
    write_images(tmp_path, {"a.png": (100 * (celsius + 273.15)).astype(np.uint16)})
    assert any("kelvin x 100" in note for note in read_recording(tmp_path).notes)
    write_images(tmp_path / "other", {"b.png": (25 * (celsius[:12] + 273.15)).astype(np.uint16)})
    with pytest.raises(
        SceneError, match=r"other/b.png holds 16-bit counts .*2 cameras: .*32x24 .*; .*32x12 .*folder of its own"
    ):
        read_recording(tmp_path)
