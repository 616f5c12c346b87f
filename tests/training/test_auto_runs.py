"""method=auto: a scene's verdicts become a run that simulates exactly them, and tells why."""

import json
import sys
from types import SimpleNamespace

import pytest
import torch
from running import BARE, TINY, run

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.doctor.base import Finding
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.io.results import RunResults
from heatsplat.runs.checks import checked
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.resume import resumed
from heatsplat.runs.run import train_in
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.session import restore

LEAST = ("max_steps=6", "density=fixed", "data.scene=cooling")
SHORT = (*TINY, *LEAST, "trainer.val_check_interval=6", "trainer.limit_val_batches=1", "trainer.limit_test_batches=1")
PRESENT = ("relaxation", "frame_offset")


@pytest.fixture
def scene_says(monkeypatch):
    """Replaces the looking at the scene by verdicts that are known; counts how often it is asked."""
    asked = []

    def decide(scene, choices):
        asked.append(dict(choices))
        on = {"on": True, "off": False}
        return {
            name: Verdict(name, on.get(choice, name in PRESENT), 4.0 if name in PRESENT else 0.1, 1.0, "as known")
            for name, choice in choices.items()
        }

    monkeypatch.setitem(sys.modules, "heatsplat.effects.catalogue", SimpleNamespace(decide=decide))
    return asked


def test_what_is_wrong_with_a_scene_is_told_before_its_effects_are_looked_for(scene_says, tmp_path, monkeypatch):
    told = []
    finding = Finding("conventions", 1.5, "Poses look turned.", "Convert them")

    def warn_of(scene):
        told.append(len(scene_says))
        return [finding]

    monkeypatch.setattr("heatsplat.runs.run.warn_of", warn_of)
    train_in(compose([*BARE, *LEAST, "method=auto", "effects.price=false", "max_steps=1"]), tmp_path)
    assert told == [0] and len(scene_says) == 1
    assert json.loads((tmp_path / "doctor.json").read_text())[0]["check"] == "conventions"


def test_a_run_simulates_what_the_scene_calls_for_and_says_why_and_for_how_much(scene_says, tmp_path):
    module, _ = run(tmp_path, *SHORT, "method=auto")
    assert set(module.thermal.effects()) | set(module.sensor.effects()) == set(PRESENT)
    assert {"initial_state", "log_rate"} == set(module.splats.names) - {
        "means",
        "log_scales",
        "quats",
        "opacity_logits",
    }
    results = RunResults.read(tmp_path / "metrics.json")
    effects = results.effects
    assert results.cost["choosing_seconds"] > 0
    assert list(effects) == list(assembly.NAMES) and {n for n, e in effects.items() if e["on"]} == set(PRESENT)
    assert effects["relaxation"]["parameters"] == len(module.splats)  # a state and a rate in place of one value
    assert effects["frame_offset"]["parameters"] == len(module.scene.train)
    assert effects["agc"] == {
        "on": False,
        "told": True,
        "statistic": 0.1,
        "threshold": 1.0,
        "gain_db": None,
        "reason": "as known",
        "parameters": 0,
        "ms_per_step": 0.0,
    }
    assert all(isinstance(effects[name]["ms_per_step"], float) for name in PRESENT)
    text = (tmp_path / "report.md").read_text()
    assert "| offset of each image (`frame_offset`) | **yes** | 4 | 1 | – | – | as known | 16 |" in text.replace(
        f"| {len(module.scene.train)} |", "| 16 |"
    )
    assert (
        "fastest of each" in text and "| gain of each image (`agc`) | no | 0.1 | 1 | – | – | as known | 0 | 0 |" in text
    )


def test_a_checkpoint_is_enough_without_looking_at_the_scene_again(scene_says, tmp_path):
    overrides = (
        *SHORT,
        "method=auto",
        "effects.price=false",
        "callbacks.checkpoint.every_n_train_steps=3",
        "test=false",
    )
    module, trainer = run(tmp_path / "whole", *overrides)
    last = tmp_path / "whole" / "checkpoints" / "last.ckpt"
    stored = load_checkpoint(last)
    config = stored["heatsplat"]["config"]
    assert "states" not in config["effects"] and config["thermal"] == config["module"]["thermal"]
    restored = build(config["module"], output_dir=str(tmp_path))
    restored.config = config
    frame = module.scene.test.frames[0]
    assert torch.equal(restore(restored, build(config["data"]), stored).predict(frame), module.predict(frame))
    assert len(scene_says) == 1
    half = tmp_path / "whole" / "checkpoints" / "step_000003.ckpt"
    second, _ = run(tmp_path / "resumed", *overrides, f"ckpt={half}")
    assert second.results.cost["choosing_seconds"] == module.results.cost["choosing_seconds"] > 0
    assert len(scene_says) == 1  # the choice is the checkpoint's
    weights, again = module.state_dict(), second.state_dict()
    assert weights.keys() == again.keys() and all(torch.equal(weights[name], again[name]) for name in weights)
    for other in ("effects.agc=off", "loss.terms.photometric.dssim_weight=0.9"):
        with pytest.raises(SceneError, match=f"step_000003.ckpt was trained with another {other.partition('=')[0]}"):
            run(tmp_path / "other", *overrides, f"ckpt={half}", other)
    last.unlink()  # as if it had been stopped after step 3
    config = resumed(checked(compose(overrides)), tmp_path / "whole")
    assert config["ckpt"] is not None and "verdicts" in config
    with pytest.raises(OccupiedError, match=r"unfinished run with other settings \(effects.agc\)"):
        resumed(checked(compose([*overrides, "effects.agc=off"])), tmp_path / "whole")


def test_what_the_choice_would_replace_is_refused(scene_says, tmp_path):
    with pytest.raises(SceneError, match="thermal.clip=hard has no effect here: .* effects.states"):
        run(tmp_path, *SHORT, "method=auto", "thermal.clip=hard")
    with pytest.raises(SceneError, match="sensor=frame_offset has no effect here"):
        run(tmp_path, *SHORT, "method=auto", "sensor=frame_offset")


def test_none_is_3dgs_to_the_last_bit(scene_says, tmp_path):
    same = (*BARE, *LEAST, "effects.price=false")
    none, _ = run(tmp_path / "none", *same, "method=auto", "effects=none")
    plain, _ = run(tmp_path / "3dgs", *same[:-1], "method=3dgs")
    assert set(scene_says[0].values()) == {"off"}
    assert none.splats.names == plain.splats.names and not list(none.sensor.parameters())
    assert len(list(none.parameters())) == len(list(plain.parameters()))
    for name in plain.splats.names:
        assert torch.equal(none.splats[name], plain.splats[name])


def test_the_selection_of_etgs_is_etgs_to_the_last_bit(scene_says, tmp_path):
    same = (*BARE, *LEAST)
    chosen, _ = run(tmp_path / "chosen", *same, "method=auto", "effects=etgs", "effects.price=false")
    method, _ = run(tmp_path / "method", *same, "method=etgs")
    assert chosen.splats.names == method.splats.names and "source_gains" in chosen.splats.names
    for name in method.splats.names:
        assert torch.equal(chosen.splats[name], method.splats[name])


def test_everything_at_once_trains(scene_says, tmp_path):
    under_sky = {"solar", "radiation", "convection", "shadows", "sky_view", "albedo", "mirrored_sky", "semi_infinite"}
    off = [f"effects.{name}=off" for name in sorted(under_sky)] + ["effects.grid.pixel_area.factor=2"]
    module, _ = run(
        tmp_path,
        *SHORT,
        "method=auto",
        "effects=all",
        "data.degrade=area2",
        *off,
        "effects.price=false",
    )
    simulated = set(module.thermal.effects()) | set(module.sensor.effects())
    assert simulated == set(assembly.NAMES) - under_sky - {"pixel_area"} and module.supersample == 2
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["test"]["psnr"] > 5 and found["test"]["rgb_psnr"] > 5
    assert found["run"]["parameters"] == sum(parameter.numel() for parameter in module.parameters())


def test_a_method_with_parts_of_its_own_cannot_choose():
    with pytest.raises(SceneError, match="effects=auto chooses the parts of method=auto, but method=3dgs"):
        checked(compose([*SHORT, "method=3dgs", "effects=auto"]))
