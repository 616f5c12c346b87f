"""Evidence of a lag: where there is one, and nowhere else."""

from dataclasses import replace

import torch
from swinging import TIMES, clean, points_on_a_wall, recorded, wall

from heatsplat.contracts import ViewSet
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.thermal_lag import EFFECT


def evidence(scene):
    return EFFECT.evidence(Inspection(scene))


def test_a_lag_is_found_and_a_read_out_is_none():
    assert evidence(points_on_a_wall(recorded(0.012, 0.02))).statistic > 3 * EFFECT.threshold
    for images in (clean(), recorded(0.0, 0.02)):
        assert evidence(points_on_a_wall(images)).statistic < EFFECT.threshold


def test_a_camera_that_is_slow_or_has_no_times_says_nothing():
    assert evidence(points_on_a_wall(recorded(0.012, 0.0), hz=1e-4)).statistic < EFFECT.threshold
    timed = points_on_a_wall(clean())
    views = [replace(view, frame=replace(view.frame, time_s=None)) for view in timed.train]
    bare = evidence(replace(timed, train=ViewSet([view.frame for view in views], lambda i: views[i])))
    assert bare.statistic is None and "have times" in bare.reason


def test_images_ahead_of_their_poses_are_no_lag():
    found = evidence(points_on_a_wall(torch.stack([wall(t + 0.012)[0] for t in TIMES.tolist()])))
    assert found.statistic == 0 and "clocks that disagree" in found.reason
