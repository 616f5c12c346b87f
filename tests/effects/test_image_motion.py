"""Delays along the motion of images: found where a simulated camera has them, none where it has not."""

from dataclasses import replace

import pytest
import torch
from swinging import TIMES, frames, recorded, wall

from heatsplat.contracts import SceneData, View, ViewSet
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.rolling_readout import EFFECT as ROLLING
from heatsplat.effects.physical.thermal_lag import EFFECT as LAG


def scene(images, hz=1.0):
    """The wall in these images [F, H, W] with noise, and points on it; its times are ``hz`` times too fast."""
    generator = torch.Generator().manual_seed(0)
    images = images + 0.002 * torch.randn(images.shape, generator=generator)
    known = [replace(one, time_s=one.time_s / hz) for one in frames()]
    views = ViewSet(known, lambda i: View(known[i], images[i, ..., None].float()))
    spots = torch.cat([4 * torch.rand(500, 2, generator=generator) - 2, torch.zeros(500, 1)], 1)
    empty = views.subset([])
    return SceneData("wall", views, empty, empty, spots)


def clean():
    return torch.stack([wall(t)[0] for t in TIMES.tolist()])


def verdicts(made):
    inspected = Inspection(made, CATALOGUE)
    found = {effect.name: effect.evidence(inspected) for effect in (LAG, ROLLING)}
    return inspected, {name: evidence.statistic > 1.0 for name, evidence in found.items()}, found


@pytest.mark.parametrize(("tau", "readout"), [(0.0, 0.0), (0.012, 0.0), (0.0, 0.02), (0.012, 0.02)])
def test_a_lag_and_a_read_out_are_found_where_they_are(tau, readout):
    inspected, on, found = verdicts(scene(recorded(tau, readout) if tau or readout else clean()))
    assert on == {"thermal_lag": tau > 0, "rolling_readout": readout > 0}, found
    assert torch.allclose(inspected.delays.seconds, torch.tensor([tau, readout], dtype=torch.float64), atol=2e-3)


def test_undone_tracks_are_nearer_to_what_points_show_and_clean_ones_are_left_alone():
    lagged, same = Inspection(scene(recorded(0.012, 0.02))), Inspection(scene(clean()))
    assert same.delays.undone(same.obs) is same.obs.tracks

    def wrong(tracks):
        seen = tracks.weights > 0
        return (tracks.values - same.obs.tracks.values)[seen].square().mean().sqrt()

    torch.testing.assert_close(lagged.obs.tracks.points, same.obs.tracks.points)
    assert wrong(lagged.delays.undone(lagged.obs)) < 0.4 * wrong(lagged.obs.tracks)


def test_a_slow_camera_shows_neither_and_one_without_times_says_why():
    slow = verdicts(scene(clean(), hz=1e-4))[1]
    assert slow == {"thermal_lag": False, "rolling_readout": False}
    timeless = scene(clean())
    bare = ViewSet([replace(frame, time_s=None) for frame in timeless.train.frames], lambda i: timeless.train[i])
    evidence = LAG.evidence(Inspection(replace(timeless, train=bare)))
    assert evidence.statistic is None and len(evidence.reason) > 10


def test_images_ahead_of_their_poses_are_no_lag():
    ahead = torch.stack([wall(t + 0.012)[0] for t in TIMES.tolist()])
    _, on, found = verdicts(scene(ahead))
    assert not on["thermal_lag"] and "clocks that disagree" in found["thermal_lag"].reason
