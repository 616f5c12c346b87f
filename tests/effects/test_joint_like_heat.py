"""What single images have in common, beside what heat would make of it."""

from dataclasses import replace

import pytest
import torch
from effects.tracks import FRAMES, NOTHING, PASSED, POINTS, data_of, drawn, fit_to, levels

from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.like_heat import is_heat, may_be_heat
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import selected

OFFSETS = Model.of(frame_offset=1)
COOLING_ALIKE = levels() + 0.1 * torch.exp(-3 * PASSED)


def walking(seed):
    return levels() + 0.01 * drawn(FRAMES, seed=seed).cumsum(0)


def test_a_scene_that_cools_alike_is_taken_for_heat_though_offsets_cost_less():
    fit = fit_to(COOLING_ALIKE)
    assert may_be_heat(fit, OFFSETS, "frame_offset") and is_heat(fit, OFFSETS, "frame_offset")
    _, model = selected(fit)
    assert model.names == {"relaxation"}


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_sensor_that_walks_is_not_taken_for_heat(seed):
    fit = fit_to(walking(seed))
    assert not is_heat(fit, OFFSETS, "frame_offset")
    _, model = selected(fit)
    assert model.names == {"frame_offset"}


def flown_over(values, frames=16):
    """What a flight sees of values: each point in so many frames, and ever fewer points as it leaves most of them behind."""
    data, share = data_of(values), torch.rand(POINTS, 1, generator=torch.Generator().manual_seed(3))
    since = torch.arange(FRAMES) - (share**3 * (FRAMES - 4)).long()
    weights = ((since >= 0) & (since < frames)).double()
    return fit_of(replace(data, tracks=replace(data.tracks, weights=weights)))


def test_how_many_points_an_image_sees_is_no_change_of_it():
    fit = flown_over(COOLING_ALIKE)
    seen = (fit.weights > 0).sum(0)
    assert seen.max() > 4 * seen.min()
    assert is_heat(fit, OFFSETS, "frame_offset")
    assert selected(fit)[1].names == {"relaxation"}
    assert not is_heat(flown_over(walking(20)), OFFSETS, "frame_offset")


def test_images_of_which_no_pixel_counts_say_nothing_of_heat():
    data = data_of(COOLING_ALIKE)
    data.tracks.weights[:, [4, 17]] = 0.0
    assert is_heat(fit_of(data), OFFSETS, "frame_offset")


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_sensor_walks_in_time_in_whichever_order_its_images_are(seed):
    data, order = data_of(walking(seed)), drawn(FRAMES, seed=7).argsort()
    moved = {key: one[:, order] for key, one in vars(data.tracks).items() if key != "points"}
    fit = fit_of(replace(data, tracks=replace(data.tracks, **moved), times_s=data.times_s[order]))
    assert not is_heat(fit, OFFSETS, "frame_offset")


def test_what_a_model_explains_by_heat_or_lacks_is_no_heat_in_disguise():
    fit = fit_to(COOLING_ALIKE)
    assert not may_be_heat(fit, NOTHING, "frame_offset")
    assert not may_be_heat(fit, OFFSETS.plus("relaxation"), "frame_offset")
    assert not may_be_heat(fit, Model.of(fixed_pattern=1), "fixed_pattern")


def test_a_weather_record_is_too_rough_to_tell():
    fit = fit_of(data_of(COOLING_ALIKE, drivers=torch.exp(-3 * PASSED)[:, None]))
    assert may_be_heat(fit, OFFSETS, "frame_offset") and not is_heat(fit, OFFSETS, "frame_offset")
