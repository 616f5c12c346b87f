"""What the report says, as text and on the screen."""

import html

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from heatsplat.callbacks.report import show
from heatsplat.callbacks.report_text import _picture, cells, data_lines, effects_table, markdown
from heatsplat.io.page import page
from heatsplat.io.results import RunResults
from heatsplat.metrics.definitions import COSTS, DEFINITIONS


def test_names_are_shown_as_they_are(tmp_path, capsys):
    name = "*hall* [new](x) __b__ outdoor_true <b>q<b> &amp; :fire: #"
    results = RunResults(run={"method": "etgs", "scene": name}, data={"images": {"first": "[z](y)_1"}})
    (tmp_path / "[old]").mkdir()
    text = markdown(results, tmp_path, [], None)
    shown = html.escape(name)
    written = page(text, tmp_path)
    assert f"<title>etgs on {shown}</title>" in written and f"<h1>etgs on {shown}</h1>" in written
    assert f"<li>scene: {shown}</li>" in written and "<li>images: first [z](y)_1</li>" in written
    assert "outdoor_true" in text  # no backslash where none is needed
    show(results, tmp_path / "[old]", tmp_path / "[old]" / "a [b].png")
    said = " ".join(capsys.readouterr().out.split())
    assert "[new](x)" in said and ":fire:" in said and "[old]/report.md" in said and "a [b].png" in said


def test_scores_of_images_that_were_trained_on_say_so_where_they_stand(tmp_path, capsys):
    said = "4 test frames trained on, too: scores tell how well they are fitted"
    for data, shown in (({}, False), ({"split_in_both": said}, True)):
        results = RunResults(run={"method": "auto", "scene": "a"}, data=data)
        assert (f"\n**{said}.**\n" in markdown(results, tmp_path, [], None)) == shown
        show(results, tmp_path, None)
        assert (said in capsys.readouterr().out) == shown


def test_a_score_of_an_own_callback_has_the_unit_of_its_definition():
    definitions = {
        "error": "K, lower is better: root",
        "sharpness": "higher is better: of edges",
        "deviation_c": "°C: median",
    }
    test = {"error": 3.907, "sharpness": 0.5, "deviation_c": 0.25, "psnr": 20.0, "other": None}
    assert [(name, value) for name, _, value in cells({"test": test, "definitions": definitions}, "test")] == [
        ("error", "3.907 K"), ("sharpness", "0.5"), ("deviation_c", "0.25 °C"), ("psnr", "20 dB"), ("other", "–"),
    ]  # fmt: skip


def test_scores_and_costs_are_told_in_words_beside_their_names(tmp_path, capsys):
    results = RunResults(run={"method": "etgs", "scene": "a"})
    results.test = {"mae_c": 0.5, "clean_psnr": 31.25, "own_score_c": 2.0}
    results.cost = {"train_seconds": 12.5, "steps_per_second": 40.0, "peak_memory_mb": 512.5}
    results.definitions = {"mae_c": "°C, lower is better: mean", "scored": "the image", "scene_threshold_c": 32.5}
    text = markdown(results, tmp_path, [], None)
    for row in ("MAE (`mae_c`) | 0.5 °C", "clean PSNR (`clean_psnr`) | 31.25 dB", "own score (`own_score_c`) | 2 °C"):
        assert f"| {row} |" in text
    for row in (
        "training (`train_seconds`) | 12.5 s",
        "steps per second (`steps_per_second`) | 40",
        "(`peak_memory_mb`) | 512.5 MB",
    ):
        assert f"{row} |" in text
    told = text[text.index("## Definitions") :].split("\n\n")[1].splitlines()
    assert told == [
        "- MAE (`mae_c`): °C, lower is better: mean",
        "- scored: the image",
        "- scene threshold (`scene_threshold_c`): 32.5 °C",
    ]
    show(results, tmp_path, None)
    said = capsys.readouterr().out
    assert "│ MAE " in said and "│ training " in said and "mae_c" not in said and "train_seconds" not in said


def test_the_table_of_all_scores_fits_a_terminal_of_80_columns(tmp_path, capsys):
    results = RunResults(run={"method": "etgs", "scene": "a"})
    results.test, results.cost = dict.fromkeys(DEFINITIONS, 12.3456), dict.fromkeys(COSTS, 123.456)
    show(results, tmp_path, None, Console(width=80))
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert len(rows) == len(COSTS)  # none is broken


def test_a_budget_is_told_once_and_without_what_is_empty(tmp_path):
    budget = {
        "asked_s": 5.0, "off_percent": 1.47, "settings": [], "moved_at_step": None, "twice_gain_db": 2.68, "twice_steps": 2004,
        "twice": "twice the time (10 s) would buy about +2.68 dB: 2,004 steps", "notes": [],
    }  # fmt: skip
    text = markdown(RunResults(run={"method": "etgs", "budget": budget}), tmp_path, [], None)
    told = f"asked for 5 s, missed by 1.47 percent, moved at step –, by the plan {budget['twice']}"
    assert f"- time that was given (`budget`): {told}\n" in text


@pytest.mark.parametrize("name", ["IMG (1).png", "Bild#1 50%ü_[x].png", "a*b_c_`d`.png", "<b>.png"])
def test_pictures_are_found_whatever_they_are_called(tmp_path, name):
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / name)
    text = page(f"# run\n\n{_picture(tmp_path / name, tmp_path)}\n", tmp_path)
    assert text.count("<img") == 1 and f'alt="{html.escape(name[:-4])}"' in text and 'width="8"' in text


def test_a_clock_has_its_date_beside_its_seconds(tmp_path):
    data = {
        "clock_at_zero_s": 1722965689.25,
        "weather": {"utc_at_zero_s": 1722965689.0, "wind": "calm"},
        "duration_s": 1800.0,
    }
    text = markdown(RunResults(run={"method": "etgs", "scene": "a"}, data=data), tmp_path, [], None)
    assert "- camera's clock at second 0: 2024-08-06 17:34:49\n" in text
    assert "- weather: time at second 0 2024-08-06 17:34:49 UTC, wind calm\n" in text and "- duration: 1800 s\n" in text


def test_the_data_are_told_in_words_with_their_units():
    data = {
        "views": {"train": 63, "val": 8, "test": 9}, "image_sizes": ["40x32"], "seconds": 1779.98,
        "thermal_range_c": [21.0, 62.0], "ambient_c": 22.0, "metres_per_unit": None, "noise_k": 0.05, "duration_s": 1779.98,
        "split": "every_8th", "train_views": 63, "pixel_type": "uint16", "image_size": "160x128 (3), 80x64 (1)",
        "test_pixels_saturated": 0.00125, "weather_air_source": "a_b.csv", "origin": [1.5, 2.0, 3.0], "warmest_c": 33.21,
        "learned_twice": True,
    }  # fmt: skip
    assert data_lines(data) == [
        "- images: 63 to train, 8 to validate, 9 to test", "- size of the images in training: 40x32 pixels",
        "- length of the record: 29.7 min", "- temperatures that an image can hold: 21 to 62 °C",
        "- temperature of the surroundings: 22 °C", "- length of a unit of the scene: –", "- noise of the camera: 0.05 K",
        "- test images are chosen by: every 8th image", "- numbers in the image files: 16-bit integers",
        "- size of the images as stored: 160x128 (3), 80x64 (1) pixels",
        "- pixels of the test images at the camera's ends: 0.125 %", "- weather air source: a_b.csv", "- origin: 1.5, 2, 3",
        "- warmest: 33.21 °C", "- learned twice: True",
    ]  # fmt: skip
    assert data_lines({"thermal_range_c": "none: image values", "duration_s": 5.0}) == [
        "- temperatures that an image can hold: none: image values", "- duration: 5 s",
    ]  # fmt: skip


def effect(on: bool, told: bool, statistic: float | None, reason: str) -> dict:
    return {"on": on, "told": told, "statistic": statistic, "threshold": 1.0, "gain_db": None, "reason": reason} | {
        "parameters": 0,
        "ms_per_step": 0.0,
    }


def test_what_is_simulated_comes_first_and_one_reason_is_said_once():
    effects = {
        "solar": effect(False, True, None, "the scene lacks weather"),
        "agc": effect(False, True, 0.5, "no gains"),
        "reflection": effect(False, True, None, "no surroundings"),
        "relaxation": effect(False, False, None, "too few frames"),
        "albedo": effect(False, True, None, "the scene lacks weather"),
        "frame_offset": effect(True, False, 2.0, "offsets"),
        "fixed_pattern": effect(True, True, 6.0, "places differ"),
    }
    *table, empty, below = effects_table(effects)
    cells = [[cell.strip() for cell in line.strip("|").split("|")][:2] for line in table[2:]]
    assert cells == [
        ["fixed pattern of the pixels (`fixed_pattern`)", "**yes**"],
        ["offset of each image (`frame_offset`)", "yes, but cannot be told"],
        ["relaxation to the surroundings (`relaxation`)", "cannot be told"],
        ["gain of each image (`agc`)", "no"],
        ["mirrored surroundings (`reflection`)", "no"],
    ]
    left_out = "- absorbed sunlight (`solar`), sunlight from the ground (`albedo`): no; the scene lacks weather"
    assert (empty, below) == ("", left_out)
    alone = {name: effects[name] for name in ("solar", "albedo")}
    assert effects_table(alone) == [below]


def test_the_run_is_told_in_words_beside_its_names(tmp_path):
    run = {
        "method": "auto", "scene": "hall", "seed": 0, "thermal_model": "Composed", "averaged_updates": 7,
        "camera_check": {"moved_px": 0.25, "error_falls": 0.031}, "machine": "two cores",
    }  # fmt: skip
    text = markdown(RunResults(run=run), tmp_path, [], None)
    told = text[text.index("## The run") : text.index("## Simulated effects")]
    assert told.split("\n\n")[1].splitlines() == [
        "- method: auto", "- scene: hall", "- seed: 0", "- thermal model (`thermal_model`): Composed",
        "- updates that the final weights average (`averaged_updates`): 7",
        "- cameras, looked at after training (`camera_check`): moved by 0.25 pixels, squared errors would fall by 3.1 %",
        "- machine: two cores",
    ]  # fmt: skip


def test_errors_that_would_rise_are_told_so(tmp_path):
    run = {"method": "auto", "scene": "hall", "camera_check": {"moved_px": 0.25, "error_falls": -0.105}}
    told = markdown(RunResults(run=run), tmp_path, [], None)
    assert "(`camera_check`): moved by 0.25 pixels, squared errors would rise by 10.5 %\n" in told


def test_simulated_effects_and_their_settings_are_told_in_words(tmp_path):
    effects = {
        "harmonic_source": {"on": True, "frequencies": 24}, "convection": {"on": True, "body": "surface", "depth_m": 0.1},
        "thermal_lag": {"on": True, "tau_ms": 12.5}, "radiation": {"on": True}, "own_effect": {"on": True, "order": 2},
    }  # fmt: skip
    text = markdown(RunResults(run={"method": "etgs", "scene": "a"}, effects=effects), tmp_path, [], None)
    told = text[text.index("## Simulated effects") : text.index("## Data")]
    assert told.split("\n\n")[1].splitlines() == [
        "- heat source (`harmonic_source`): harmonics 24",
        "- convection by air (`convection`): body surface, depth 0.1 m",
        "- lag of the detector (`thermal_lag`): time constant 12.5 ms",
        "- long-wave radiation (`radiation`): on", "- own effect (`own_effect`): order 2",
    ]  # fmt: skip
