"""The study of effects: its runs, its tables, and that it goes on where it stopped."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from benchmarks import effects as study
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR
from heatsplat.datamodules.synthetic_scene.presets import PRESETS as ROOMS
from heatsplat.effects import assembly
from heatsplat.effects.assembly import dependents
from heatsplat.io.results import RunResults
from heatsplat.studies import child_runs

PRESETS = {"static": [], "heated": ["relaxation", "harmonic_source"]}
SETTINGS = {
    "train": "train.py",
    "presets": PRESETS,
    "selections": ["auto", "none", "all", "oracle"],
    "leave_one_out": True,
    "seeds": [0, 1],
    "overrides": ["max_steps=5"],
}


@pytest.fixture
def commands(monkeypatch):
    """Stands in for training: leaves results in which every effect that is on is worth one decibel and a millisecond."""
    given = []

    def trained(command, **_):
        given.append(command)
        place = next(word.partition("=")[2].strip("'") for word in command if word.startswith("hydra.run.dir="))
        preset = next(word.partition("=")[2] for word in command if word.startswith("data.scene="))
        truth, on = set(PRESETS[preset]), set()
        if "effects=auto" in command or any(word.endswith("=on") for word in command):
            on = set(truth)
        if "effects=all" in command:
            on = {"relaxation", "harmonic_source", "agc"}
        for word in command:
            if word.endswith("=off"):
                on -= dependents(word.removeprefix("effects.").partition("=")[0])
        results = RunResults(
            run={"parameters": 1000 + 100 * len(on)},
            test={"psnr": 30.0 + len(on & truth), "mae_c": 1.0 - 0.1 * len(on & truth), "clean_psnr": 40.0},
            cost={"steps_per_second": 1000.0 / (10 + len(on))},
            effects={name: {"on": name in on} for name in ("relaxation", "harmonic_source", "agc")},
        )
        results.write(f"{place}/metrics.json")
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(child_runs.subprocess, "run", trained)
    return given


def test_every_selection_runs_and_each_chosen_effect_is_left_out(commands, tmp_path):
    study.run(tmp_path, **SETTINGS)
    assert len(commands) == 2 * (2 + 5)  # static: auto, all; heated: auto, all, oracle, a source left out, and nothing
    oracle = [command for command in commands if "effects.relaxation=on" in command]
    assert len(oracle) == 2 and all("effects=none" in c and "effects.harmonic_source=on" in c for c in oracle)
    table = (tmp_path / study.TABLE_FILE).read_text()
    assert "| heated | auto | relaxation, harmonic_source | 32.00 | 40.00 | 0.800 | 1,200 | 12.0 |" in table
    assert "| static | all | relaxation, harmonic_source, agc | 30.00 | 40.00 | 1.000 | 1,300 | 13.0 |" in table
    assert "| heated | oracle | relaxation, harmonic_source | 32.00 | 40.00 | 0.800 | 1,200 | 12.0 |" in table
    assert "| static | none | none | 30.00 | 40.00 | 1.000 | 1,000 | 10.0 |" in table
    assert "| heated | harmonic_source | 1.00 | 0.00 | 0.100 | 100 | 1.00 |" in table
    assert "| heated | relaxation | 2.00 | 0.00 | 0.200 | 200 | 2.00 |" in table
    assert (tmp_path / study.PICTURE_FILE).stat().st_size > 5000


def test_the_truth_of_its_configuration_is_that_of_the_scenes():
    conf = Path(__file__).resolve().parents[2] / "conf" / "study" / "effects.yaml"
    truth = yaml.safe_load(conf.read_text(encoding="utf-8"))["presets"]
    scenes = ROOMS | OUTDOOR
    assert {name: set(effects) for name, effects in truth.items()} == {n: set(scenes[n].effects) for n in truth}
    unseen = {
        "shadows",
        "sky_view",
        "albedo",
        "mirrored_sky",
        "semi_infinite",
        "pixel_area",
    }  # asked for; of a wall; of data.degrade
    assert set().union(*truth.values()) == set(assembly.NAMES) - unseen  # every other effect is there somewhere


def test_it_goes_on_where_it_stopped(commands, tmp_path):
    study.run(tmp_path, **SETTINGS)
    before = len(commands)
    study.run(tmp_path, **SETTINGS)
    assert len(commands) == before


def test_without_an_oracle_there_is_no_picture(commands, tmp_path):
    study.run(tmp_path, **SETTINGS | {"selections": ["auto"], "leave_one_out": False, "seeds": [0]})
    assert not (tmp_path / study.PICTURE_FILE).exists()
    assert json.loads((tmp_path / "runs/static_auto/0/metrics.json").read_text())["test"]["psnr"] == 30.0
