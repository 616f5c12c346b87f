import json
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import temperatures
from commands import succeeds
from hydra.core.override_parser.overrides_parser import OverridesParser
from recordings import read_frames, write_flir, write_images, write_sequence

from benchmarks.camera_folder import Field, write_camera
from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import read_model, write_model
from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.io.tiff import read_temperature
from heatsplat.preparation.doctor import check, section
from heatsplat.preparation.features import Sift
from heatsplat.preparation.poses import FindPoses
from heatsplat.preparation.prepare import prepare
from heatsplat.preparation.report import Section

pytestmark = pytest.mark.usefixtures("dots_for_pictures")
ROOT = Path(__file__).resolve().parents[2]
PINHOLE = ("PINHOLE", (38.0, 38.0, 20.0, 16.0), 40, 32)
PLAIN = {"conditions": {}, "uncertainty": {}, "counts": {}}


def poses(frames, target):
    """Stands in for a search: cameras side by side that look ahead."""
    cameras = {}
    for i, frame in enumerate(frames):
        cameras[f"{frame.name}.tiff"] = np.eye(4)
        cameras[f"{frame.name}.tiff"][:3, 3] = [0.1 * i, 0.0, 4.0]
    seen = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3))
    write_model(target / "sparse" / "0", cameras, [PINHOLE], seen, np.full((len(seen), 3), 128))
    return Section("Poses", [f"{len(frames)} of {len(frames)}"])


@pytest.mark.parametrize(
    ("name", "shown"),
    [("scene_2", "data.root={}"), ("Flug über Köln, 2", "\"data.root='{}'\"")],
    ids=["plain", "quoted"],
)
def test_the_command_that_trains_can_be_typed_as_it_is_shown(tmp_path, caplog, name, shown):
    with caplog.at_level("INFO"):
        prepare(str(write_flir(tmp_path / "files", 2)), tmp_path / name, **PLAIN, poses=poses)
    word = shown.format(tmp_path / name)
    assert f"python src/train.py data=colmap {word}\n" in caplog.text
    (override,) = OverridesParser.create().parse_overrides(shlex.split(word))
    assert override.value() == str(tmp_path / name)


def test_marks_of_what_is_not_known_are_no_temperatures(tmp_path):
    """gdal_calc writes the largest float for what it does not know, others the smallest or infinity: no bounds hold those."""
    known = temperatures().astype(np.float32)
    images = {f"f{i}.tiff": known + i for i in range(9)}
    for image in images.values():
        image[3, 2:6] = 3.402823466e38, -3.402823466e38, np.inf, np.nan
    prepare(str(write_images(tmp_path / "files", images)), tmp_path / "scene", **PLAIN, poses=poses)
    written = read_temperature(tmp_path / "scene" / "images" / "f4.tiff")
    assert np.isnan(written[3, 2:6]).all() and np.isfinite(written).sum() == written.size - 4
    bounds = Colmap(root=str(tmp_path / "scene")).scene.thermal_range
    assert (bounds.min_c, bounds.max_c) == pytest.approx((known.min(), known.max() + 8), abs=1e-4)


def test_a_folder_of_camera_files_becomes_a_scene_that_loads_with_temperatures_and_times(tmp_path):
    source, target = write_flir(tmp_path / "files", 9), tmp_path / "scene"
    page = prepare(str(source), target, **PLAIN, poses=poses)
    assert page == target / "report.md"
    text = page.read_text()
    assert (
        "9 frames, camera FLIR Test Cam 640 S123, 40x32 pixels" in text
        and "## Radiometry" in text
        and text.rstrip().endswith("9 of 9")
    )
    module = Colmap(root=str(target))
    module.setup()
    views = [*module.scene.train, *module.scene.test]
    assert sorted(view.time_s for view in views) == [2.0 * i for i in range(-1, 8)]  # 0 is the first training frame
    assert module.scene.notes["time_source"] == "frames.csv"
    frame = next(f for f in read_frames(source) if f.time.second == 2)
    view = next(view for view in views if view.frame.name == f"{frame.name}.tiff")
    shown = module.scene.thermal_range.to_celsius(view.thermal[..., 0])
    np.testing.assert_allclose(shown, frame.temperature(), atol=2e-3)


def test_pictures_in_false_colours_become_temperatures_between_bounds(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    levels = np.clip(8 * temperatures(), 0, 255).astype(np.uint8)
    colours = np.rint(named("iron").curve(256)[levels]).astype(np.uint8)
    colours[:4, :6] = (0, 255, 0)
    for i in range(3):
        cv2.imwrite(str(source / f"f{i}.png"), colours[..., ::-1])
    page = prepare(str(source), tmp_path / "scene", **PLAIN, bounds_c=[0.0, 51.0], palette="iron")
    celsius = cv2.imread(str(tmp_path / "scene" / "images" / "f1.tiff"), cv2.IMREAD_UNCHANGED)
    assert celsius.dtype == np.float32 and np.isnan(celsius[:4, :6]).all()
    np.testing.assert_allclose(celsius[4:], levels[4:] / 5.0, atol=0.21)
    record = json.loads((tmp_path / "scene" / "images" / "f1.json").read_text())
    assert record["unknown_pixels"] == 24
    assert "levels by the palette iron" in page.with_suffix(".md").read_text()
    before = (tmp_path / "scene" / "images" / "f1.tiff").stat().st_mtime_ns
    prepare(str(source), tmp_path / "scene", **PLAIN, bounds_c=[0.0, 51.0], palette="iron")
    assert (tmp_path / "scene" / "images" / "f1.tiff").stat().st_mtime_ns == before
    prepare(str(source), tmp_path / "scene", **PLAIN, bounds_c=[0.0, 51.0], palette="iron_r")
    turned = cv2.imread(str(tmp_path / "scene" / "images" / "f1.tiff"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(turned[4:], 51 - levels[4:] / 5.0, atol=0.21)


def test_the_doctor_takes_images_that_were_made_of_colours_for_temperatures(tmp_path):
    levels = [np.clip(8 * temperatures() + i, 0, 255).astype(np.uint8) for i in range(9)]
    colours = {
        f"f{i}.png": np.rint(named("iron").curve(256)[image]).astype(np.uint8)[..., ::-1]
        for i, image in enumerate(levels)
    }
    source, given = write_images(tmp_path / "files", colours), {"bounds_c": [0.0, 51.0], "palette": "iron"}
    page = prepare(str(source), tmp_path / "scene", **PLAIN, **given, poses=poses, doctor=section)
    assert "Doctor, with the cameras" in page.with_suffix(".md").read_text()


def test_conditions_that_are_given_change_the_temperatures(tmp_path):
    source = write_flir(tmp_path / "files", 2)
    prepare(str(source), tmp_path / "a", **PLAIN)
    prepare(str(source), tmp_path / "b", **{**PLAIN, "conditions": {"emissivity": 1.0, "distance_m": 0.0}})
    a, b = (read_temperature(tmp_path / name / "images" / "IR_0000.tiff") for name in "ab")
    assert np.abs(a - b).max() > 0.5


def test_a_sequence_needs_no_more_than_a_frame_at_a_time(tmp_path):
    prepare(str(write_sequence(tmp_path / "files" / "flight.seq").parent), tmp_path / "scene", **PLAIN)
    assert len(list((tmp_path / "scene" / "images").glob("*.tiff"))) == 4


def test_a_target_within_the_source_is_refused(tmp_path):
    source = write_flir(tmp_path / "files", 2)
    for target in (source, source / "scene"):
        with pytest.raises(SceneError, match="give a folder outside of it"):
            prepare(str(source), target, **PLAIN)


def test_a_source_that_is_a_file_is_told_what_to_give(tmp_path):
    (tmp_path / "a.seq").touch()
    with pytest.raises(SceneError, match="a.seq: this is a file; give the folder that it lies in"):
        prepare(str(tmp_path / "a.seq"), tmp_path / "scene", **PLAIN)


def test_a_source_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SceneError, match="source=.*nowhere: there is no such folder"):
        prepare(str(tmp_path / "nowhere"), tmp_path / "scene", **PLAIN)


def test_a_swung_camera_s_frames_become_a_scene_with_cameras_that_share_one_lens(tmp_path):
    preset = replace(PRESETS["swung"], video_hz=10.0)
    recording = film(Scene(preset), Size(160, 128, 6, 60), distortion=(0.05, 0.0, 0.0, 0.0))
    write_camera(recording, tmp_path / "source", Field(dead_pixels=6))
    page = prepare(str(tmp_path / "source"), tmp_path / "scene", **PLAIN, poses=FindPoses(Sift()))
    model = read_model(tmp_path / "scene")
    assert len(model.viewmats) >= 4 and all(lens == model.lenses[0] for lens in model.lenses)
    assert model.lenses[0].fx == pytest.approx(recording.lens.fx)  # which the files say
    assert "![cameras over the points](report/cameras.png)" in page.read_text()
    assert (tmp_path / "scene" / "report" / "cameras.png").is_file()
    assert len(Colmap(root=str(tmp_path / "scene")).scene.train) >= 3


def test_frames_without_cameras_keep_their_temperatures_and_the_page_says_why(tmp_path):
    image = np.random.default_rng(0).normal(20.0, 3.0, (64, 80)).astype(np.float32)
    noise = np.random.default_rng(1).normal(0.0, 0.1, (6, 64, 80)).astype(np.float32)
    source = write_images(tmp_path / "files", {f"{i}.tiff": image + noise[i] for i in range(6)})
    with pytest.raises(SceneError, match=r"the image does not move.*temperatures are in .*scene/images all the same"):
        prepare(str(source), tmp_path / "scene", **PLAIN, poses=FindPoses(Sift(most=200)))
    assert len(list((tmp_path / "scene" / "images").glob("*.tiff"))) == 6
    assert "the image does not move" in (tmp_path / "scene" / "report.html").read_text()


def test_the_doctor_comes_first_and_sees_the_source(tmp_path):
    seen = []

    def doctor(folder, reading, recording):
        seen.append(folder)
        assert len(recording.frames) == 2  # as they were read
        return Section("Findings", ["none"])

    source = write_flir(tmp_path / "files", 2)
    page = prepare(str(source), tmp_path / "scene", **PLAIN, doctor=doctor)
    assert seen == [source] and page.read_text().index("## Findings") < page.read_text().index("## The recording")


def test_what_counts_are_said_to_mean_is_what_the_doctor_reads_too(tmp_path):
    counts = np.random.default_rng(0).integers(19000, 19900, (4, 16, 20)).astype(np.uint16)
    source = write_images(tmp_path / "files", {f"{i}.png": image for i, image in enumerate(counts)})
    said = {**PLAIN, "counts": {"scale": 0.015625}}
    page = prepare(str(source), tmp_path / "scene", **said, doctor=section)
    assert "## Doctor" in page.read_text()
    assert check(str(source), tmp_path, counts=said["counts"]) == []


def test_the_command_prepares_and_goes_on(tmp_path):
    write_images(tmp_path / "files", {f"{i}.tiff": np.full((8, 8), 20.0 + i, np.float32) for i in range(3)})
    command = [
        str(ROOT / "src" / "prepare.py"),
        "source=files",
        "target=scene",
        "conditions.emissivity=0.9",
        "poses=none",
    ]
    assert "already" not in (said := succeeds(command, tmp_path)) and "3 frames" in said
    assert "3 frames, 3 of them were there already" in succeeds(command, tmp_path)
    record = json.loads((tmp_path / "scene" / "images" / "1.json").read_text())
    assert record["conditions"]["emissivity"] == {"value": 0.9, "from": "given", "standard_uncertainty": 0.02}
    assert "give the folder" in succeeds([*command[:1], "source=files"], tmp_path, 1)
    stop = ["+poses._target_=signal.raise_signal", "+poses._args_=[2]"]
    said = succeeds([*command, *stop], tmp_path, 130)
    assert "and the same command goes on" in said and "Traceback" not in said
    (tmp_path / "scene.txt").touch()
    said = succeeds([*command[:2], "target=scene.txt"], tmp_path, 1)
    assert "scene.txt: File exists; a file is where a folder is to be" in said and "Traceback" not in said


def test_settings_that_change_nothing_are_refused(tmp_path):
    source = write_images(tmp_path / "files", {"a.tiff": np.full((8, 8), 20.0, np.float32)})
    with pytest.raises(SceneError, match="conditions.reflected_c=5 changes nothing while emissivity is 1"):
        prepare(str(source), tmp_path / "scene", **{**PLAIN, "conditions": {"reflected_c": 5}})
    assert not (tmp_path / "scene").exists()


def test_a_grey_without_temperatures_and_cameras_is_not_said_to_be_temperatures(tmp_path):
    source = write_images(tmp_path / "files", {"a.png": np.arange(48, dtype=np.uint8).reshape(6, 8)})
    with pytest.raises(SceneError, match=r"1 frame cannot tell .*\. The images are in .*scene/images all the same"):
        prepare(str(source), tmp_path / "scene", **PLAIN, poses=FindPoses(Sift(most=200)))
    assert (tmp_path / "scene" / "images" / "a.png").is_file()


def test_greys_and_colours_of_a_span_each_become_a_scene_in_celsius(tmp_path):
    """What one span for all would tell wrong by degrees comes back to half a step of each image's own; so it does to training."""
    spans, columns = (
        [(10.0 + i, 30.0 + 3.0 * i) for i in range(9)],
        {"name": "file", "min_c": "min_c", "max_c": "max_c"},
    )
    seen = [temperatures() * (1.0 + 0.1 * i) for i in range(9)]
    shown = [np.clip(image, low, high) for image, (low, high) in zip(seen, spans, strict=True)]
    levels = [
        np.rint((image - low) / (high - low) * 255).astype(np.uint8)
        for image, (low, high) in zip(shown, spans, strict=True)
    ]
    table = tmp_path / "spans.csv"
    table.write_text("file;min_c;max_c\n" + "".join(f"f{i};{a};{b}\n" for i, (a, b) in enumerate(spans)))
    given = {**PLAIN, "table": str(table), "table_columns": columns, "poses": poses, "doctor": section}
    for name, palette in (("greys", None), ("colours", "iron")):
        drawn = {
            f"f{i}.png": np.rint(named("iron").curve(256)[image]).astype(np.uint8)[..., ::-1] if palette else image
            for i, image in enumerate(levels)
        }
        target = tmp_path / f"scene_{name}"
        prepare(str(write_images(tmp_path / name, drawn)), target, palette=palette, **given)
        for i, (low, high) in enumerate(spans):
            written = read_temperature(target / "images" / f"f{i}.tiff")
            half = (1.5 if palette else 0.5) * (high - low) / 255 + 1e-4
            assert np.abs(written - shown[i]).max() <= half
            record = json.loads((target / "images" / f"f{i}.json").read_text())
            assert record["calibration"]["offset_c"] == low and record["unknown_pixels"] == 0
        assert not (target / "temperature_bounds.json").exists()
        scene = Colmap(root=str(target)).scene
        assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == pytest.approx((10.0, 54.0))
        view = next(v for v in scene.train if v.frame.name == "f3.tiff")
        celsius = scene.thermal_range.to_celsius(view.thermal[..., 0].numpy())
        assert np.abs(celsius - shown[3]).max() <= 1.5 * (spans[3][1] - spans[3][0]) / 255
        assert (view.ends.numpy()[seen[3] > spans[3][1]] == 1).all() and (seen[3] > spans[3][1]).any()
        assert (view.ends.numpy()[seen[3] < spans[3][0]] == -1).all()
    images = tmp_path / "scene_greys" / "images"
    before = [(images / f"f{i}.json").stat().st_mtime_ns for i in (7, 8)]
    table.write_text(table.read_text().replace("f8;18.0;54.0", "f8;18.0;50.0"))
    prepare(str(tmp_path / "greys"), tmp_path / "scene_greys", **given)
    after = [(images / f"f{i}.json").stat().st_mtime_ns for i in (7, 8)]
    assert after[0] == before[0] and after[1] > before[1]  # another span makes other temperatures
    page = prepare(str(tmp_path / "greys"), tmp_path / "scene_greys", **PLAIN, bounds_c=[10.0, 50.0])
    assert (page.parent / "temperature_bounds.json").exists() and not (page.parent / "temperature_bounds.csv").exists()
