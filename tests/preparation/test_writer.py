import csv
import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from recordings import read_frames, write_flir, write_images

from heatsplat.contracts import SceneError
from heatsplat.io.tiff import read_temperature
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.writer import Writer


def written(frames, target, **options):
    writer = Writer(target, InputUncertainty(), **{"keep_counts": False, **options})
    writer.check(frames)
    done = [writer.write(frame) for frame in frames]
    writer.finish(frames, [record for record, _ in done])
    return [record for record, _ in done], [fresh for _, fresh in done]


def test_a_frame_has_an_image_and_beside_it_all_that_is_known(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    records, _ = written(frames, tmp_path / "scene")
    for frame, record in zip(frames, records, strict=True):
        image = read_temperature(tmp_path / "scene" / "images" / f"{frame.name}.tiff")
        np.testing.assert_array_equal(image, frame.temperature())
        assert json.loads((tmp_path / "scene" / "images" / f"{frame.name}.json").read_text()) == record
    first = records[0]
    assert first["conditions"]["emissivity"] == {
        "value": pytest.approx(0.95),
        "from": "file",
        "standard_uncertainty": 0.02,
    }
    assert first["time"] == "2024-07-01T12:00:00+00:00" and first["position"]["latitude_deg"] == 51.0
    assert first["calibration"]["kind"] == "planck" and 0.9 < first["transmittance"] < 1
    assert first["uncertainty_c"]["combined"] > first["uncertainty_c"]["camera"] > 1
    rows = list(csv.DictReader((tmp_path / "scene" / "frames.csv").open()))
    assert [float(row["time_s"]) for row in rows] == [0.0, 2.0, 4.0, 6.0]
    bounds = json.loads((tmp_path / "scene" / "temperature_bounds.json").read_text())
    assert bounds["absolute_min_temperature"] == pytest.approx(min(f.temperature().min() for f in frames), abs=1e-4)
    assert not (tmp_path / "scene" / ".partial").exists()


def test_what_was_written_before_is_kept_and_what_changed_is_made_anew(tmp_path):
    source = write_flir(tmp_path / "files")
    frames = read_frames(source)
    assert written(frames, tmp_path / "scene")[1] == [True] * 4
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "scene" / "images").iterdir()}
    assert written(frames, tmp_path / "scene")[1] == [False] * 4
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "scene" / "images").iterdir()}
    (tmp_path / "scene" / "images" / f"{frames[1].name}.json").write_text("{half")  # stopped there
    assert written(frames, tmp_path / "scene")[1] == [False, True, False, False]
    os.utime(frames[2].path, ns=(1, 1))
    assert written(frames, tmp_path / "scene")[1] == [False, False, True, False]
    assert written([GivenConditions(emissivity=0.8).settled(f) for f in frames], tmp_path / "scene")[1] == [True] * 4


def test_a_failure_leaves_no_half_written_image(tmp_path, monkeypatch):
    frames = read_frames(write_flir(tmp_path / "files"))

    def fails(path, image):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("heatsplat.preparation.writer.write_temperature", fails)
    with pytest.raises(OSError, match="disk full"):
        written(frames, tmp_path / "scene")
    assert not list((tmp_path / "scene").glob("images/*"))
    monkeypatch.undo()
    assert written(frames, tmp_path / "scene")[1] == [True] * 4


def test_images_of_another_recording_are_not_mixed_in(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    written(frames, tmp_path / "scene")
    with pytest.raises(SceneError, match=r"2 images .*: IR_0000.tiff, IR_0001.tiff\. .*\(rm -r .*scene/images\)"):
        written(frames[1:3], tmp_path / "scene")


def test_counts_are_kept_as_they_were_and_greys_stay_greys(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    written(frames, tmp_path / "scene", keep_counts=True)
    kept = cv2.imread(str(tmp_path / "scene" / "counts" / f"{frames[0].name}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(kept, frames[0].load())
    grey = np.arange(64, dtype=np.uint8).reshape(8, 8)
    greys = read_frames(write_images(tmp_path / "greys", {"a.png": grey}))
    (record,), _ = written(greys, tmp_path / "grey_scene")
    np.testing.assert_array_equal(
        cv2.imread(str(tmp_path / "grey_scene" / "images" / "a.png"), cv2.IMREAD_UNCHANGED), grey
    )
    assert "conditions" not in record and not (tmp_path / "grey_scene" / "temperature_bounds.json").exists()


def test_a_frame_without_any_temperature_is_told_and_breaks_nothing(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    dark = replace(frames[0], load=lambda: np.zeros((32, 40), np.uint16))  # below the calibration
    records, _ = written([dark, *frames[1:]], tmp_path / "scene")
    assert records[0]["quantiles"] is None and records[0]["unknown_pixels"] == 32 * 40


def test_dead_pixels_are_masked_in_every_image_and_sound_ones_are_not(tmp_path):
    scene = np.random.default_rng(0).normal(20.0, 0.05, (4, 24, 32)).astype(np.float32)
    scene[:, 5, 7], scene[:, 20, 30] = 30.0, 10.0
    frames = read_frames(write_images(tmp_path / "files", {f"{i}.tiff": image for i, image in enumerate(scene)}))
    writer = Writer(tmp_path / "scene", InputUncertainty(), False)
    assert writer.find_dead_pixels(frames) == 2
    records = [writer.write(frame)[0] for frame in frames]
    writer.write_masks(frames)
    writer.finish(frames, records)
    for frame in frames:
        mask = cv2.imread(str(tmp_path / "scene" / "masks" / f"{frame.name}.tiff.png"), cv2.IMREAD_GRAYSCALE)
        assert np.argwhere(mask != 255).tolist() == [[5, 7], [20, 30]] and mask.shape == (24, 32)
    bounds = json.loads((tmp_path / "scene" / "temperature_bounds.json").read_text())
    assert 19.0 < bounds["absolute_min_temperature"] < bounds["absolute_max_temperature"] < 21.0  # without what is dead
    few = Writer(tmp_path / "few", InputUncertainty(), False)
    assert few.find_dead_pixels(frames[:3]) == 0  # too few to tell
    assert few.write(frames[0])[0]["quantiles"][-1] == 30.0


def test_counts_that_files_do_not_hold_cannot_be_kept(tmp_path):
    frames = read_frames(write_images(tmp_path / "files", {"a.tiff": np.full((8, 8), 20.0, np.float32)}))
    with pytest.raises(
        SceneError, match="keep_counts=true changes nothing: files such as .*a.tiff hold no 16-bit counts"
    ):
        written(frames, tmp_path / "scene", keep_counts=True)


def test_what_a_stopped_preparation_left_half_written_is_taken_away(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    written(frames, tmp_path / "scene")
    (tmp_path / "scene" / ".partial").mkdir()
    (tmp_path / "scene" / ".partial" / f"{frames[0].name}.tiff").write_bytes(b"half")  # of other conditions
    assert written(frames, tmp_path / "scene")[1] == [False] * 4
    assert not (tmp_path / "scene" / ".partial").exists()


def test_masks_of_pixels_that_are_no_longer_dead_are_taken_away_and_those_of_others_stay(tmp_path):
    rng = np.random.default_rng(0)
    images = {f"{i}.tiff": rng.normal(20.0, 0.05, (24, 32)).astype(np.float32) for i in range(4)}
    for image in images.values():
        image[5, 7] = 30.0
    masks = tmp_path / "scene" / "masks"

    def prepared(frames):
        writer = Writer(tmp_path / "scene", InputUncertainty(), False)
        writer.find_dead_pixels(frames)
        records = [writer.write(frame)[0] for frame in frames]
        writer.write_masks(frames)
        return [record["dead_pixels"] for record in records]

    assert prepared(read_frames(write_images(tmp_path / "files", images))) == [1] * 4
    assert len(list(masks.glob("*.png"))) == 4
    for image in images.values():
        image[5, 7] = 20.0
    frames = read_frames(write_images(tmp_path / "files", images))
    assert prepared(frames) == [0] * 4 and not list(masks.glob("*.png"))
    own = masks / "0.tiff.png"
    own.write_bytes(b"drawn by hand")
    os.utime(frames[0].path, ns=(1, 1))
    assert prepared(frames) == [0] * 4 and own.read_bytes() == b"drawn by hand"


def test_masks_that_were_drawn_leave_out_what_they_did_beside_dead_pixels(tmp_path):
    rng = np.random.default_rng(0)
    images = {f"{i}.tiff": rng.normal(20.0, 0.05, (24, 32)).astype(np.float32) for i in range(4)}
    target = tmp_path / "scene"
    masks = target / "masks"

    def prepared() -> None:
        frames = read_frames(write_images(tmp_path / "files", images))
        writer = Writer(target, InputUncertainty(), False)
        writer.find_dead_pixels(frames)
        for frame in frames:
            writer.write(frame)
        writer.write_masks(frames)

    def left_out(name: str) -> list[list[int]]:
        return np.argwhere(cv2.imread(str(masks / name), cv2.IMREAD_GRAYSCALE) == 0).tolist()

    prepared()
    masks.mkdir()
    drawn = np.full((24, 32), 255, np.uint8)
    drawn[0, :2] = 0
    cv2.imwrite(str(masks / "0.tiff.png"), drawn)
    for image in images.values():
        image[5, 7] = 30.0
    for _ in range(2):
        prepared()
        assert left_out("0.tiff.png") == [[0, 0], [0, 1], [5, 7]] and left_out("1.tiff.png") == [[5, 7]]
    for image in images.values():
        image[5, 7] = 20.0
    prepared()
    assert [path.name for path in masks.glob("*.png")] == ["0.tiff.png"]
