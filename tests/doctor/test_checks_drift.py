"""Drift of the level is found, and heat that changes is not taken for it."""

from dataclasses import replace

import pytest
import torch
from materials import changed, clean, findings_of

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import Material, material_of
from heatsplat.doctor.checks import drift


def test_drift_is_found_with_its_shutter_and_cooling_is_not_taken_for_it():
    count = len(clean().images)
    saw = 0.01 * (torch.arange(count, dtype=torch.float64) % 6)
    found = findings_of(changed(clean(), clean().images + saw[:, None, None]), "drift")
    assert found and clean().name(6) in found[0].frames
    assert not drift.find(clean("cooling"))


def test_points_that_change_all_alike_have_halves():
    """As of a camera that stands still and of greys without noise, whose level alone changes."""
    levels = torch.tensor([0.0, 4.0, 12.0, 16.0, 0.0, 8.0, 12.0, 20.0, 0.0, 4.0, 8.0, 16.0])
    still = (200 * clean().images[:1]).round() + levels[:, None, None]
    frames = list(range(len(levels)))
    shown = Material([str(f) for f in frames], None, frames, still)
    assert [found.check for found in drift.find(shown)] == ["drift"]
    assert drift.find(replace(shown, images=still[:, :5, :5])) == []


def test_a_sensor_that_drifts_is_found_before_a_scene_that_cools_and_a_lamp_is_not_taken_for_it():
    assert drift.find(clean("drifting_cooling"))
    assert not drift.find(clean("heated"))


@pytest.mark.parametrize("scene", ["facade", pytest.param("stone", marks=pytest.mark.slow)])
def test_walls_that_follow_one_weather_do_not_drift_and_a_sensor_before_them_does(scene):
    found = material_of(Synthetic(scene=scene, size="tiny", frames=48).scene)
    assert not drift.find(found)
    assert drift.find(replace(found, answers=None))  # their levels wander in common, by more than a shutter sets back
    saw = 0.01 * (torch.arange(len(found.images), dtype=torch.float64) % 9)
    assert drift.find(replace(found, images=found.images + saw[:, None, None]))
