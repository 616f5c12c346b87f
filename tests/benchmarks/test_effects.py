"""The study of effects: its runs, its tables, and that it goes on where it stopped."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from benchmarks import effects as study
from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR
from heatsplat.datamodules.synthetic_scene.presets import PRESETS as ROOMS
from heatsplat.effects import assembly
from heatsplat.effects.assembly import dependents
from heatsplat.io.results import RunResults
from heatsplat.studies import child_runs

PRESETS = {"static": [], "heated": ["relaxation", "harmonic_source"], "sheets": ["relaxation", "conduction"]}
SETTINGS = {
    "train": "train.py",
    "presets": PRESETS,
    "selections": ["auto", "none", "all", "oracle"],
    "leave_one_out": True,
    "seeds": [0, 1],
    "overrides": ["max_steps=5", "data.size=tiny"],
}


@pytest.fixture
def commands(monkeypatch):
    """Stands in for training: leaves results in which every effect that is on is worth one decibel and a millisecond.

    The choice of effects finds all that are there but conduction.
    """
    given = []

    def trained(command, **_):
        given.append(command)
        place = next(word.partition("=")[2].strip("'") for word in command if word.startswith("hydra.run.dir="))
        preset = next(word.partition("=")[2] for word in command if word.startswith("data.scene="))
        truth, on = set(PRESETS[preset]), set()
        if "effects=auto" in command or any(word.endswith("=on") for word in command):
            on = truth - {"conduction"} if "effects=auto" in command else set(truth)
        if "effects=all" in command:
            on = {"relaxation", "harmonic_source", "agc"}
        for word in command:
            if word.endswith("=off"):
                on -= dependents(word.removeprefix("effects.").partition("=")[0])
        seed = next(int(word.partition("=")[2]) for word in command if word.startswith("seed="))
        results = RunResults(
            run={"parameters": 1000 + 100 * len(on), "steps": 5, "threads": 2},
            test={"psnr": 30.0 + seed + len(on & truth), "mae_c": 1.0 - 0.1 * len(on & truth), "clean_psnr": 40.0},
            cost={"train_seconds": 5e-3 * (10 + len(on)), "cpu_seconds": 10e-3 * (10 + len(on))},
            effects={name: {"on": name in on} for name in ("relaxation", "harmonic_source", "conduction", "agc")},
        )
        results.write(f"{place}/metrics.json")
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(child_runs.subprocess, "run", trained)
    return given


def test_every_selection_runs_and_each_chosen_effect_is_left_out(commands, tmp_path):
    study.run(tmp_path, **SETTINGS)
    # static: auto, all; heated: auto, which is the truth, all, a source left out, and nothing; sheets: auto, all, oracle, nothing
    assert len(commands) == 2 * (2 + 4 + 4)
    oracle = [command for command in commands if "effects.relaxation=on" in command]
    assert len(oracle) == 2 and all("effects=none" in c and "effects.conduction=on" in c for c in oracle)
    table = (tmp_path / study.TABLE_FILE).read_text()
    assert "All rows: `data.size=tiny seed=0,1 threads=2 max_steps=5`." in table
    every = "relaxation, harmonic_source"
    assert f"| heated | auto | {every} | 32.50 ± 0.71 | 40.00 ± 0.00 | 0.800 ± 0.000 | 1,200 | 12.0 |" in table
    assert f"| static | all | {every}, agc | 30.50 ± 0.71 | 40.00 ± 0.00 | 1.000 ± 0.000 | 1,300 | 13.0 |" in table
    assert f"| heated | oracle | {every} | 32.50 ± 0.71 | 40.00 ± 0.00 | 0.800 ± 0.000 | 1,200 | 12.0 |" in table
    assert (
        "| sheets | auto | relaxation | 31.50 ± 0.71 |" in table
        and "| sheets | oracle | relaxation, conduction | 32.50" in table
    )
    assert "| static | none | none | 30.50 ± 0.71 | 40.00 ± 0.00 | 1.000 ± 0.000 | 1,000 | 10.0 |" in table
    assert "| heated | harmonic_source | 1.00 ± 0.00 | 0.00 ± 0.00 | 0.100 ± 0.000 | 100 | 1.00 |" in table
    assert "| heated | relaxation | 2.00 ± 0.00 | 0.00 ± 0.00 | 0.200 ± 0.000 | 200 | 2.00 |" in table
    assert (tmp_path / study.PICTURE_FILE).stat().st_size > 5000


def test_one_seed_has_no_spread_and_processor_seconds_are_a_clock(commands, tmp_path):
    settings = SETTINGS | {"seeds": [1], "selections": ["auto", "all"], "clock": "cpu_seconds"}
    study.run(tmp_path, **settings)
    table = (tmp_path / study.TABLE_FILE).read_text()
    assert "| heated | auto | relaxation, harmonic_source | 33.00 | 40.00 | 0.800 | 1,200 | 24.0 |" in table
    assert "| heated | relaxation | 2.00 | 0.00 | 0.200 | 200 | 4.00 |" in table and "CPU time" in table
    with pytest.raises(SceneError, match="study.clock must be one of train_seconds, cpu_seconds, got 'hours'"):
        study.run(tmp_path, **settings | {"clock": "hours"})


def test_some_presets_run_and_nothing_is_refused(commands, tmp_path):
    study.run(tmp_path, **SETTINGS | {"only": "static", "seeds": 1, "selections": "none"})
    assert len(commands) == 1 and "data.scene=static" in commands[0]
    for wrong, message in (
        ({"presets": {}}, r"study.presets=\[\] has nothing in it"),
        ({"only": []}, r"study.only=\[\] has nothing in it"),
        ({"only": ["hot"]}, "each of study.only must be one of static, heated, sheets, got 'hot'"),
        ({"selections": ["nope"]}, "each of study.selections must be one of auto, none, all, oracle, got 'nope'"),
        ({"seeds": ["a"]}, "study.seeds must be a whole number, 0 or more, got a"),
        ({"selections": []}, r"study.selections=\[\] has nothing in it"),
        ({"seeds": []}, r"study.seeds=\[\] has nothing in it"),
    ):
        with pytest.raises(SceneError, match=message):
            study.run(tmp_path, **SETTINGS | wrong)
    assert len(commands) == 1


def test_many_effects_are_counted(commands, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "MOST_NAMED", 2)
    study.run(tmp_path, **SETTINGS | {"seeds": [0], "leave_one_out": False})
    table = (tmp_path / study.TABLE_FILE).read_text()
    assert (
        "| heated | all | 3 effects | 32.00 |" in table and "| heated | auto | relaxation, harmonic_source |" in table
    )


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
        "view_dependence",
    }  # asked for; of a wall; of data.degrade; of what neither mirrors nor emits less towards its sides
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
