"""Points of cameras that are known: they lie on the surfaces that were filmed, and tell where cameras are not of the images."""

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from aligned import calibration, camera, write_metashape

from benchmarks.camera_folder import Field, write_camera
from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import read_model, write_model
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.synthetic_scene.shapes import nearest_surface
from heatsplat.preparation.features import Sift
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.given_poses import GivenPoses
from heatsplat.preparation.poses import FindPoses
from heatsplat.preparation.prepare import prepare
from heatsplat.preparation.triangulation import KnownCameras, away

pytestmark = pytest.mark.usefixtures("dots_for_pictures")
PLAIN = {"conditions": {}, "uncertainty": {}, "counts": {}}
BACKWARDS = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes in OpenCV's


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A room, the camera's files, and what Metashape would write of its cameras at twice the size."""
    recording = film(Scene(PRESETS["static"]), Size(160, 128, 16, 100), distortion=(-0.1, 0.02, 0.0, 0.0))
    folder = tmp_path_factory.mktemp("filmed")
    write_camera(recording, folder, Field())
    lens = recording.lens
    values = {"f": 2.0 * lens.fx, "cx": 2.0 * lens.cx - 160.0, "cy": 2.0 * lens.cy - 128.0, "k1": -0.1, "k2": 0.02}

    def export(path: Path, turned: np.ndarray = np.eye(4)) -> Path:  # noqa: B008
        poses = [np.linalg.inv(viewmat) @ turned for viewmat in recording.viewmats]
        cameras = [camera(i, f"frame_{i:04d}_T", pose) for i, pose in enumerate(poses)]
        return write_metashape(path, cameras, [calibration(values, (320, 256))])

    return SimpleNamespace(recording=recording, source=folder / "thermal", export=export)


@pytest.fixture(scope="module")
def prepared(filmed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prepared")
    page = prepare(
        str(filmed.source), folder / "scene", **PLAIN, poses=GivenPoses(str(filmed.export(folder / "cameras.xml")))
    )
    return SimpleNamespace(scene=folder / "scene", text=page.read_text())


def test_points_lie_on_the_surfaces_that_were_filmed(filmed, prepared):
    model = pycolmap.Reconstruction(str(prepared.scene / "sparse" / "0"))
    points = np.array([point.xyz for point in model.points3D.values()])
    assert (
        len(points) > 150
        and f"The cameras come without points: {len(points)} points were triangulated from" in prepared.text
    )
    surfaces = [surface.shape for surface in filmed.recording.scene.preset.surfaces]
    near = nearest_surface(surfaces, torch.from_numpy(points))[0]
    distances = near if near.dim() == 1 else (near - torch.from_numpy(points)).norm(dim=1)
    size = np.linalg.norm(np.ptp(np.quantile(filmed.recording.points, [0.05, 0.95], axis=0), axis=0))
    assert distances.median() < 0.02 * size  # features of 160x128 pixels with noise of 0.05 °C
    model.update_point_3d_errors()
    errors = np.array([point.error for point in model.points3D.values()])  # of a lens with twice as many pixels
    assert np.median(errors) < 2.0 and errors.max() < 10.0
    assert model.compute_mean_track_length() > 2.5
    assert len({tuple(point.color) for point in model.points3D.values()}) > 20
    assert "reprojection error 0." in prepared.text and "Matched features lie 0." in prepared.text
    assert "## Findings" not in prepared.text and "cameras over the points" in prepared.text
    scene = Colmap(root=str(prepared.scene)).scene
    assert len(scene.points) == len(points) and "points_random" not in scene.notes


def test_cameras_are_those_that_were_given_bit_for_bit(filmed, prepared, tmp_path):
    given = GivenPoses(str(filmed.export(tmp_path / "cameras.xml")), triangulate=False)
    text = prepare(str(filmed.source), tmp_path / "scene", **PLAIN, poses=given).read_text()
    assert (
        "The cameras come without points, and none were triangulated (poses.triangulate=false): training starts from random"
        in text
    )
    plain, found = read_model(tmp_path / "scene"), read_model(prepared.scene)
    assert plain.names == found.names and plain.lenses == found.lenses and not len(plain.points)
    np.testing.assert_array_equal(np.stack(plain.viewmats), np.stack(found.viewmats))
    np.testing.assert_allclose(np.stack(found.viewmats), filmed.recording.viewmats, atol=1e-12)
    for name in ("cameras.bin", "frames.bin", "rigs.bin"):
        files = [folder / "sparse" / "0" / name for folder in (tmp_path / "scene", prepared.scene)]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_a_search_for_points_that_was_stopped_goes_on_to_the_same_bits(filmed, prepared, tmp_path, monkeypatch):
    given, own, calls = GivenPoses(str(filmed.export(tmp_path / "cameras.xml"))), Sift.match, []

    def stopped(self, database, pairs, file, seed):
        calls.append(pairs)
        if len(calls) == 3:
            raise KeyboardInterrupt
        own(self, database, pairs, file, seed)

    monkeypatch.setattr(Sift, "match", stopped)
    with pytest.raises(KeyboardInterrupt):
        prepare(str(filmed.source), tmp_path / "scene", **PLAIN, poses=given)
    assert not (tmp_path / "scene" / "sparse").exists() and (tmp_path / "scene" / ".poses" / "database.db").is_file()
    database = (tmp_path / "scene" / ".poses" / "database.db").stat().st_ino
    prepare(str(filmed.source), tmp_path / "scene", **PLAIN, poses=given)
    assert (tmp_path / "scene" / ".poses" / "database.db").stat().st_ino == database
    for name in ("cameras", "images", "frames", "rigs", "points3D"):
        files = [folder / "sparse" / "0" / f"{name}.bin" for folder in (tmp_path / "scene", prepared.scene)]
        assert files[0].read_bytes() == files[1].read_bytes(), name


def test_points_do_not_depend_on_where_the_world_begins_and_how_long_its_unit_is(filmed, prepared):
    """Adjusted in metres of a flight, or far from the origin, as in UTM, points would stay where rays first met."""
    frames = read_recording(filmed.source, Reading()).frames
    model, shift = read_model(prepared.scene), np.array([5e5, 5.6e6, 300.0])
    viewmats = {}
    for name, viewmat in zip(model.names, model.viewmats, strict=True):
        viewmats[name] = viewmat.copy()
        viewmats[name][:3, 3] = 1e3 * viewmat[:3, 3] - viewmat[:3, :3] @ shift
    lenses = dict(zip(model.names, model.lenses, strict=True))
    search = KnownCameras(FindPoses(Sift(), gps=False), frames, prepared.scene, viewmats, lenses)
    points = np.array([point.xyz for _, point in sorted(search.triangulate().model.points3D.items())])
    own = np.array([model.points[i] for i in np.argsort(model.point_ids)])
    np.testing.assert_allclose((points - shift) / 1e3, own, atol=1e-6)


def test_cameras_with_other_axes_are_warned_of_and_give_no_points(filmed, tmp_path, caplog):
    given = GivenPoses(str(filmed.export(tmp_path / "cameras.xml", BACKWARDS)))
    with caplog.at_level(logging.WARNING):
        text = prepare(str(filmed.source), tmp_path / "scene", **PLAIN, poses=given).read_text()
    said = "The given cameras and the images do not agree: matched features lie"
    assert f"## Findings\n\n- {said}" in text and said in caplog.text and "Are the camera's axes" in caplog.text
    assert (
        "The cameras come without points, and points that such cameras see would be wrong: training starts from random ones"
        in text
    )
    assert len(read_model(tmp_path / "scene").points) == 0


def test_many_points_that_were_given_stay_and_so_do_few_where_none_are_found(filmed, tmp_path, monkeypatch):
    asked = []

    def nothing(*given):
        asked.append(given)
        raise SceneError("nothing can be seen")

    monkeypatch.setattr("heatsplat.preparation.given_poses.triangulated", nothing)

    kind = ("PINHOLE", (150.0, 150.0, 80.0, 64.0), 160, 128)
    viewmats = {f"frame_{i:04d}_T.png": viewmat for i, viewmat in enumerate(filmed.recording.viewmats)}
    for count, triangulate, wanted in ((99, "auto", 1), (100, "auto", 0), (100, True, 1), (99, False, 0)):
        points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
        write_model(tmp_path / "tool" / "sparse" / "0", viewmats, [kind], points, np.full((count, 3), 51))
        asked.clear()
        given = GivenPoses(str(tmp_path / "tool"), triangulate=triangulate)
        text = prepare(str(filmed.source), tmp_path / "scene", **PLAIN, poses=given).read_text()
        assert len(asked) == wanted and len(read_model(tmp_path / "scene").points) == count
        said = f"The cameras come with {count} points, and none were triangulated"
        assert (f"{said} (nothing can be seen): these stay" in text) == bool(wanted)
        assert (f"{said} (poses.triangulate=false): these stay" in text) == (triangulate is False)


def test_neighbours_in_space_are_those_of_the_given_cameras(filmed, tmp_path):
    frames = read_recording(filmed.source, Reading()).frames
    (tmp_path / "images").mkdir()
    for frame in frames:
        (tmp_path / "images" / f"{frame.name}.tiff").touch()
    # There and back along a line, so that the first frame and the last stand side by side.
    viewmats = {f"{frame.name}.tiff": np.eye(4) for frame in frames}
    for i, viewmat in enumerate(viewmats.values()):
        viewmat[0, 3] = min(i, 15 - i)
    lens = Lens(150.0, 150.0, 80.0, 64.0, 160, 128)
    options = FindPoses(Sift(), video=True, overlap=2, gps=False)
    search = KnownCameras(options, frames, tmp_path, viewmats, dict.fromkeys(viewmats, lens))
    names = list(search.frames)
    pairs = set(search.pairs())
    assert {(names[0], names[15]), (names[1], names[14])} <= pairs and (names[0], names[13]) not in pairs


def test_how_far_a_feature_lies_from_where_another_one_s_may_be_seen():
    rng = np.random.default_rng(0)
    for case in range(40):
        between = np.eye(4)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if case % 4 == 3 else np.eye(3) + 0.1 * rng.normal(size=(3, 3))
        turn = np.linalg.qr(turn)[0]
        turn *= np.sign(np.diag(turn))[None] if case % 4 != 3 else 1.0
        between[:3, :3] = turn * np.sign(np.linalg.det(turn))
        between[:3, 3] = 0.0 if case % 4 == 2 else rng.normal(size=3)
        rays, others = (np.append(rng.uniform(-0.5, 0.5, 2), 1.0) for _ in range(2))
        start, step = between[:3, :3] @ rays, between[:3, 3]

        def distances(nearness: np.ndarray, start=start, step=step, others=others) -> np.ndarray:
            seen = start + nearness[:, None] * step
            with np.errstate(divide="ignore", invalid="ignore"):
                off = np.hypot(*(seen[:, :2] / seen[:, 2:] - others[:2]).T)
            return np.where(seen[:, 2] > 0, off, np.inf)

        tried = np.concatenate([[0.0], np.logspace(-4, 4, 4000)])
        least, endless = distances(tried).min(), distances(np.zeros(1))[0]
        best = tried[distances(tried).argmin()]
        least = min(least, distances(best * np.linspace(0.99, 1.01, 4001)).min())
        found = away(rays[None], others[None], between)[0]
        if np.isfinite(found):
            # Where the line ends before its nearest place, that of what is infinitely far is said.
            assert found == pytest.approx(least, rel=1e-4, abs=1e-5) or found == pytest.approx(endless)
        else:
            assert not np.isfinite(endless)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"triangulate": "maybe"}, "poses.triangulate must be one of auto"),
        ({"overlap": 0}, "poses.overlap"),
        ({"clip": "much"}, "poses.clip must be a number"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_any_work(wrong, said):
    with pytest.raises(SceneError, match=said):
        GivenPoses("nowhere", **wrong)
