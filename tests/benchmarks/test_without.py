"""Scenes without one of their effects: only that is gone."""

from dataclasses import replace

import pytest
import torch

from benchmarks.without import scene_of, without
from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
from heatsplat.datamodules.synthetic_scene.presets import PRESETS

SIZE = Size(16, 13, 5, 40)


def images(scene, bounds=None):
    scene.thermal_range = bounds
    recording = film(scene, SIZE, noise_k=0.0)
    return torch.from_numpy(recording.celsius), recording.thermal_range


@pytest.mark.parametrize(
    ("preset", "other"), [("drifting", "static"), ("uneven", "static"), ("dark_corners", "static")]
)
def test_without_its_flaw_a_camera_sees_what_is_there(preset, other):
    flawless, bounds = images(scene_of(PRESETS[other]))
    (effect,) = PRESETS[preset].effects
    mended, _ = images(without(PRESETS[preset], effect), bounds)
    flawed, _ = images(scene_of(PRESETS[preset]), bounds)
    assert (mended - flawless).abs().max() < 1e-4 < 0.05 < (flawed - flawless).abs().max()


def test_without_relaxation_a_scene_stays_as_it_is_in_the_middle_of_the_record():
    preset = PRESETS["cooling"]
    moving, still = scene_of(preset), without(preset, "relaxation")
    points, which = moving.nearest(torch.tensor([[0.0, 0.0, 0.0], [0.5, -0.35, 0.42]], dtype=torch.float64))
    times = torch.tensor([0.0, 900.0, 1800.0], dtype=torch.float64)
    kept = still.celsius(still.heat_at(points, which), times)
    assert torch.equal(kept, kept[:, :1].expand(-1, 3))
    assert torch.equal(kept[:, 0], moving.celsius(moving.heat_at(points, which), times)[:, 1])


@pytest.mark.parametrize("effect", ["haze", "dull", "mirrors", "heated", "sheets"])
def test_what_stands_between_surface_and_camera_or_heats_is_gone(effect):
    preset = PRESETS[effect]
    (name,) = preset.effects - {"relaxation"}
    there, bounds = images(scene_of(preset))
    gone, _ = images(without(preset, name), bounds)
    assert (there - gone).abs().max() > 0.1


def test_without_glass_what_lies_behind_is_seen():
    assert all(one.name != "pane" for one in without(PRESETS["glass"], "thermal_opacity").preset.surfaces)


@pytest.mark.parametrize("effect", ["solar", "radiation", "convection"])
def test_under_the_sky_only_one_way_of_heat_is_closed(effect):
    (preset,) = OUTDOOR.values()
    less = without(replace(preset, duration_s=3600.0), effect)  # as much of the record as shows what it is made of
    assert isinstance(less, OutdoorScene)
    before, after = preset.surfaces[0], less.preset.surfaces[0]
    assert (before.absorbs != after.absorbs) == (effect == "solar")
    assert (after.material.emissivity == 0.0) == (effect == "radiation")
    assert (after.material.convection_per_wind == 0.0) == (effect == "convection")
    if effect != "solar":  # the exchange with the air takes it over
        assert after.material.convection_still > before.material.convection_still


def test_an_effect_that_is_not_there_cannot_be_taken_away():
    with pytest.raises(SceneError, match="the scene shows no effect, not agc"):
        without(PRESETS["static"], "agc")
    with pytest.raises(SceneError, match="nobody knows the scene without thermal_lag"):
        without(PRESETS["moving_camera"], "thermal_lag")
