"""Heat goes on between images: a camera that jumps foresees none that is left out."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.effects.joint import certainty as certainty_of
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.foreseen import foreseen, holds_still
from heatsplat.effects.joint.held_out import shows
from heatsplat.effects.joint.model import Model
from tests.effects.tracks import COOLING, FRAMES, NOTHING, PASSED, POINTS, data_of, drawn, fit_to, levels

LAMP = levels() + 0.05 * drawn(POINTS, 1, seed=8) * torch.cos(4.0 * math.pi * PASSED)
GAINS = Model.of(agc=1)


def jumping(size: float) -> torch.Tensor:
    """Levels before a camera whose gain is another in every image."""
    return 0.5 + (levels() - 0.5) * (1.0 + size * drawn(FRAMES, seed=9))


@pytest.mark.parametrize("values", [COOLING, LAMP])
def test_images_of_a_scene_that_changes_are_foreseen_from_those_before_and_after(values):
    fit = fit_to(values)
    assert shows(foreseen(fit, fit.data.tracks.values, 1))
    assert not holds_still(fit, NOTHING, ())


def test_of_a_camera_that_jumps_no_image_is_foreseen():
    fit = fit_to(jumping(0.04))
    for count in (1, 2):
        assert not shows(foreseen(fit, fit.data.tracks.values, count))
    assert holds_still(fit, GAINS, {"agc"})


def test_jumps_that_would_hide_heat_do_not_say_that_a_scene_holds_still():
    assert not holds_still(fit_to(jumping(0.1)), GAINS, {"agc"})


def test_what_is_not_in_doubt_is_not_taken_for_heat():
    fit = fit_to(levels() + 0.05 * torch.sin(4.0 * math.pi * PASSED)).linearised(Model.of(frame_offset=1))
    assert holds_still(fit, Model.of(frame_offset=1), ())
    assert not holds_still(fit, Model.of(frame_offset=1), {"frame_offset"})


@pytest.mark.parametrize("times", [None, torch.zeros(FRAMES, dtype=torch.float64)])
def test_images_without_times_do_not_say_that_a_scene_holds_still(times):
    fit = fit_of(replace(data_of(jumping(0.04)), times_s=times))
    assert holds_still(fit, GAINS, {"agc"}) is False


def test_images_too_few_to_follow_a_scene_do_not_say_that_it_holds_still():
    data = data_of(jumping(0.04))
    often = torch.ones_like(data.tracks.weights)
    often[:, 6:] = 0.0
    assert not holds_still(fit_of(replace(data, tracks=replace(data.tracks, weights=often))), GAINS, {"agc"})


def test_heat_that_would_be_foreseen_and_is_not_does_not_take_the_place_of_gains(monkeypatch):
    fit = fit_to(jumping(0.04))
    doubt = {"agc": "nobody can tell"}
    heat = {"relaxation", "harmonic_source"}
    found = Certainty(fit, GAINS, doubt).doubts
    monkeypatch.setattr(certainty_of, "holds_still", lambda *asked: False)
    assert heat <= Certainty(fit, GAINS, doubt).doubts.keys()
    assert not heat & found.keys() and found["agc"] == doubt["agc"]
