"""What points do by themselves is taken away, what all of them share from frame to frame is not."""

from dataclasses import replace

import torch
from materials import clean

from heatsplat.doctor.courses import beside_courses


def test_cooling_is_taken_away_and_leaps_that_all_share_are_left():
    material = clean("cooling")
    times = torch.tensor(material.times_s)[list(material.chosen)]
    rates = torch.linspace(1.0, 8.0, 50)[:, None] / (times.max() - times.min())
    cooling = (20.0 + 10.0 * torch.exp(-rates * times)).double()
    leaps = torch.randn(len(times), generator=torch.Generator().manual_seed(0)).double()
    left, weights = beside_courses(cooling, torch.ones_like(cooling), material)
    assert left.abs().max() < 0.02 * 10.0 and weights.all()
    left, _ = beside_courses(cooling + leaps, torch.ones_like(cooling), material)
    assert (left - left[:1]).abs().max() < 0.2 and left[0].std() > 0.5 * leaps.std()


def test_points_that_are_seen_too_seldom_do_not_count_and_without_times_a_point_has_a_level():
    material = replace(clean(), times_s=None)
    values = torch.arange(len(material.images)).double().expand(2, -1)
    seen = torch.ones_like(values)
    seen[1, 1:] = 0.0
    left, weights = beside_courses(values, seen, material)
    assert torch.allclose(left[0], values[0] - values[0].mean()) and weights[0].all() and not weights[1].any()


def test_few_moments_tell_few_courses_apart_and_keep_what_one_frame_shows():
    material, count = clean(), len(clean().chosen)
    for moments, kept in ((1, 1 - 1 / count), (2, 1 - 2 / count)):
        times = [float(i * moments // len(material.names)) for i in range(len(material.names))]
        spikes = torch.eye(count, dtype=torch.float64)
        left, _ = beside_courses(spikes, torch.ones_like(spikes), replace(material, times_s=times))
        assert left.diagonal().min() > kept - 0.1
