"""Drift of the level is found, and heat that changes is not taken for it."""

import torch
from materials import changed, checks, clean

from heatsplat.doctor.examination import examine


def test_drift_is_found_with_its_shutter_and_cooling_is_not_taken_for_it():
    count = len(clean().images)
    saw = 0.01 * (torch.arange(count, dtype=torch.float64) % 6)
    found = [one for one in examine(changed(clean(), clean().images + saw[:, None, None])) if one.check == "drift"]
    assert found and clean().name(6) in found[0].frames
    assert "drift" not in checks(clean("cooling"))


def test_a_sensor_that_drifts_is_found_before_a_scene_that_cools_and_a_lamp_is_not_taken_for_it():
    assert "drift" in checks(clean("drifting_cooling"))
    assert "drift" not in checks(clean("heated"))
