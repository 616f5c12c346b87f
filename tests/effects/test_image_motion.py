"""Delays along the motion of images: how long they are, and tracks without them."""

import pytest
import torch
from swinging import clean, points_on_a_wall, recorded

from heatsplat.effects.inspection import Inspection


@pytest.mark.parametrize(("tau", "readout"), [(0.0, 0.0), (0.012, 0.0), (0.0, 0.02), (0.012, 0.02)])
def test_delays_are_those_of_the_detector(tau, readout):
    found = Inspection(points_on_a_wall(recorded(tau, readout) if tau or readout else clean())).delays
    assert torch.allclose(found.seconds, torch.tensor([tau, readout], dtype=torch.float64), atol=2e-3)
    assert (found.sure & (found.pixels.abs() > 0.25)).tolist() == [tau > 0, readout > 0]


def test_undone_tracks_are_nearer_to_what_points_show_and_clean_ones_are_left_alone():
    lagged, same = Inspection(points_on_a_wall(recorded(0.012, 0.02))), Inspection(points_on_a_wall(clean()))
    assert same.delays.undone(same.obs) is same.obs.tracks

    def wrong(tracks):
        seen = tracks.weights > 0
        return (tracks.values - same.obs.tracks.values)[seen].square().mean().sqrt()

    torch.testing.assert_close(lagged.obs.tracks.points, same.obs.tracks.points)
    assert wrong(lagged.delays.undone(lagged.obs)) < 0.4 * wrong(lagged.obs.tracks)
