"""Renders of any code are scored by their temperatures, and what is wrong with a file is named with its remedy."""

import json
import re
import shutil

import numpy as np
import pytest
from boards import PROTOCOL, VIEWS, hand_in, protocol_folder, truth

from heatsplat.contracts import SceneError
from heatsplat.io.tiff import write_temperature
from heatsplat.studies.score import run, score_submission

SCORES = PROTOCOL["scores"]


@pytest.fixture
def root(tmp_path):
    return protocol_folder(tmp_path / "root", "cooling")


@pytest.fixture
def submission(tmp_path):
    folder = tmp_path / "ours"
    hand_in(folder / "cooling", 0.5)
    (folder / "metrics.json").write_text(json.dumps({"method": "ours", "scenes": {"cooling": {"seconds": 12}}}))
    return folder


def renamed_archive(file, whole: bool) -> None:
    """Puts an .npz that is called .npy, or half of one, where an image was."""
    file.unlink()
    with file.with_suffix(".npy").open("wb") as target:
        np.savez(target, truth(VIEWS[0]))
    if not whole:
        content = file.with_suffix(".npy").read_bytes()
        file.with_suffix(".npy").write_bytes(content[: len(content) // 2])


def test_half_a_degree_is_half_a_degree(root, submission, tmp_path):
    np.save(submission / "cooling" / "near_00003.npy", truth("near_00003").astype(np.float64) - 2.0)
    (submission / "cooling" / "near_00003.tiff").unlink()
    scored = run(tmp_path / "out", str(submission), str(root), PROTOCOL)["cooling"]
    assert scored.parts == ["near", "times"] and scored.cost == {"seconds": 12}
    assert scored.mean("mae_c", "near") == pytest.approx(2.0, abs=1e-5)
    assert scored.mean("mae_c") == pytest.approx(1.0, abs=1e-5)
    assert scored.mean("psnr", "times") == pytest.approx(-20 * np.log10(0.5 / 30.0), abs=1e-3)
    text = (tmp_path / "out" / "score.md").read_text()
    assert "| cooling | all | 3 | 1.000 |" in text and (tmp_path / "out" / "score.csv").read_text().count("\n") == 4


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: f.unlink(), r"lacks 1 of the 3 held-out views of cooling: near_00003. Render every view of .*transforms_test"),
        (lambda f: f.rename(f.with_suffix(".png")), r"near_00003.png: .png files are .* no temperatures in °C. Write float32"),
        (lambda f: [path.rename(path.with_suffix(".PNG")) for path in f.parent.iterdir()], "PNG and 2 more like it: .PNG"),
        (lambda f: write_temperature(f, truth(VIEWS[0])[:, :8]), r"near_00003.tiff is \[12, 8\], its view is \[12, 16\]"),
        (lambda f: write_temperature(f, np.full((12, 16), np.nan)), "has 192 pixels that are NaN or infinite; every pixel"),
        (lambda f: write_temperature(f, truth(VIEWS[0]) + 273.15), r"kelvin, no °C. Subtract 273.15"),
        (lambda f: write_temperature(f, truth(VIEWS[0]) / 50), r"between 0.42 and 0.82: image values, .* 15 \+ value \* 30"),
        (lambda f: f.write_bytes(b"no image"), "cannot be read .* write float32 temperatures in °C, one channel"),
        (lambda f: (f.unlink(), np.save(f.with_suffix(".npy"), np.ones((12, 16), np.uint16))), "uint16; write float32"),
        (lambda f: write_temperature(f, truth(VIEWS[0]) - 500), "below absolute zero"),
        (lambda f: np.save(f.with_suffix(".npy"), truth(VIEWS[0])), r"3.tiff and near_00003.npy are of one view: del"),
        (lambda f: renamed_archive(f, whole=True), r"near_00003.npy cannot be read \(several arrays, as of an .npz\); write"),
        (lambda f: renamed_archive(f, whole=False), "near_00003.npy cannot be read .* write float32"),
    ],
)  # fmt: skip
def test_a_bad_file_is_named_with_its_remedy(root, submission, spoil, message):
    spoil(submission / "cooling" / "near_00003.tiff")
    with pytest.raises(SceneError, match=message):
        score_submission(submission, root, SCORES)


def test_scenes_come_in_the_order_of_the_protocol_and_those_that_are_missing_are_told(root, submission, tmp_path):
    protocol_folder(root, "glass", "driven")
    hand_in(submission / "glass", 0.5)
    (submission / "metrics.json").write_text('{"method": "ours", "scenes": {"glass": null, "cooling": null}}')
    assert list(run(tmp_path / "out", str(submission), str(root), PROTOCOL)) == ["cooling", "glass"]
    assert (
        "\n- not handed in, as metrics.json does not name them: driven\n" in (tmp_path / "out" / "score.md").read_text()
    )


def test_greys_are_warned_of_as_most_lie_outside_of_the_bounds(root, submission, caplog):
    score_submission(submission, root, SCORES)
    assert not caplog.records
    for view in VIEWS:
        write_temperature(submission / "cooling" / f"{view}.tiff", (truth(view) - 15) / 30 * 255)
    score_submission(submission, root, SCORES)
    assert "cooling: 100 % of the pixels lie outside of 15 to 45 °C, the camera's bounds, " in caplog.text


def test_a_track_that_the_protocol_does_not_have_is_refused(root, submission, tmp_path):
    (submission / "metrics.json").write_text('{"method": "ours", "track": "step", "scenes": {"cooling": null}}')
    with pytest.raises(
        SceneError, match='metrics.json: "track" is step; the protocol has steps, seconds. Name one of them'
    ):
        run(tmp_path, str(submission), str(root), PROTOCOL)


def test_a_submission_tells_its_method_and_its_scenes(root, submission, tmp_path):
    for told, message in (
        ("{", "is no JSON"),
        ('{"method": "ours"}', 'needs "method": a name, and "scenes"'),
        ('{"method": "ours", "scenes": {"glass": {}}}', f"names glass; {re.escape(str(root))} has cooling"),
        (
            '{"method": "ours", "scenes": {"cooling": {"seconds": -1}}}',
            "scenes.cooling.seconds is -1; a number of 0 or more",
        ),
        ('{"method": "ours", "seed": "1", "scenes": {"cooling": {}}}', "\"seed\" is '1'; a whole number of 0 or more"),
        ('{"method": "ours", "scenes": {}}', 'needs "method": a name, and "scenes"'),
        ('{"method": "ours", "scenes": {"cooling": {"seconds": true}}}', "seconds is True; a number of 0 or more"),
        (
            '{"method": "ours", "scenes": {"cooling": {"secs": 9}}}',
            "each key of scenes.cooling must be one of seconds, memory_mb, gaussians, got 'secs'",
        ),
        ('{"method": "ours", "scenes": {"cooling": 12}}', "metrics.json: scenes.cooling is 12; what it cost"),
        ('{"method": "ours", "scenes": {"cooling": [12]}}', r"metrics.json: scenes.cooling is \[12\]; what it cost"),
    ):
        (submission / "metrics.json").write_text(told)
        with pytest.raises(SceneError, match=message):
            score_submission(submission, root, SCORES)
    (submission / "metrics.json").write_text('{"method": "ours", "scenes": {"cooling": null}}')
    assert score_submission(submission, root, SCORES)[1]["cooling"].cost == {}
    shutil.rmtree(root / "truth")
    with pytest.raises(SceneError, match="study=scenes"):
        run(tmp_path, str(submission), str(root), PROTOCOL)
    (submission / "metrics.json").unlink()
    with pytest.raises(SceneError, match="metrics.json is missing"):
        score_submission(submission, root, SCORES)
    with pytest.raises(SceneError, match="submission=FOLDER root=FOLDER"):
        run(tmp_path, None, None, PROTOCOL)
