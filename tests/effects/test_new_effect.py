"""A new effect is one file and its entry in the configuration; all that knows effects finds it there."""

import importlib
import sys

import pytest
import torch
from effects.tracks import FRAMES, drawn, fit_to, levels, positions

from heatsplat.effects import assembly, catalogue, physical
from heatsplat.effects.joint.selection import selected

TILT = """
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared, where_moving


def columns(data, image, known):
    return Columns.of_images(data.tracks.positions[..., 0])


EFFECT = Effect(
    name="tilt",
    stage="sensor",
    place=9,
    summary="images that are warmer on one side",
    source="a test",
    null="residuals do not depend on the side of the image",
    threshold=SHARED_HURDLE,
    adds="one number for each training image",
    evidence=lambda inspected: Evidence(2.0, "as the test says", {"start": 0.5}),
    part=Part("camera", "tilt"),
    term=Shared(columns=columns, order=9, kinds=where_moving, numbers=lambda data, kind: data.frames),
    displaces={"agc": "a tilt excludes gains"},
)
"""
CONF = {"select": "auto", "tilt": None}  # conf/effects/shared/choices.yaml
PARTS = {
    "sensor": {"_target_": "Chain", "parts": {"tilt": {"_target_": "Tilt", "start": "scene", "lr": 0.1}, "agc": {}}}
}


@pytest.fixture
def tilt(tmp_path, monkeypatch):
    """The effect is there as if its file lay in the package when heatsplat was started."""
    (tmp_path / "tilt.py").write_text(TILT)
    with monkeypatch.context() as patched:
        patched.setattr(physical, "__path__", [*physical.__path__, str(tmp_path)])
        yield importlib.reload(catalogue), importlib.reload(assembly)
    sys.modules.pop("heatsplat.effects.physical.tilt")
    importlib.reload(catalogue)
    importlib.reload(assembly)


def test_a_file_adds_an_effect(tilt):
    catalogue, assembly = tilt
    assert assembly.NAMES[-1] == "tilt" and len(assembly.NAMES) == 26
    assert assembly.choices(CONF | {"tilt": True})["tilt"] == "on"
    verdict = catalogue._verdict(catalogue.CATALOGUE[-1], SimpleLook(), "auto")
    assert verdict.on and verdict.settings == {"start": 0.5}
    verdicts = {name: catalogue.Verdict(name, False, None, None, "") for name in assembly.NAMES}
    verdicts |= {"tilt": verdict, "agc": catalogue.Verdict("agc", True, 9.0, 1.0, "")}
    found = assembly.reconcile(verdicts)
    assert not found["agc"].on and found["agc"].reason == "a tilt excludes gains"
    templates = PARTS | {"states": {"static": {}}, "parts": {}, "grid": {}, "clip": "none"}
    assert assembly.assemble(found, templates)["sensor"]["parts"] == {
        "tilt": {"_target_": "Tilt", "start": 0.5, "lr": 0.1}
    }


class SimpleLook:
    blind = False

    class given:
        metadata = frozenset()


def test_the_joint_fit_takes_it_in(tilt):
    tilted = levels() + 0.1 * drawn(FRAMES, seed=7) * positions()[..., 0]
    fit, model = selected(fit_to(tilted, effects=tilt[0].CATALOGUE))
    assert model.names == {"tilt"}
    added = fit.contributions(model)["tilt"]
    assert torch.allclose(added, tilted - levels(), atol=0.03)
