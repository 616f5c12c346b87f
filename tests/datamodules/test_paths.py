"""Where a hand holds its camera, and when."""

import numpy as np
import torch

from heatsplat.datamodules.synthetic_scene.paths import camera_path, frame_times, swung_path


def test_time_is_uneven_increasing_and_whole_milliseconds():
    times = frame_times(72, 1800.0, 0)
    gaps = np.diff(times)
    assert times[0] >= 20.0 and times[-1] <= 1800.0 and times[-1] > 1700.0
    assert gaps.min() > 1.0 and gaps.max() < 60.0 and gaps.std() > 1.0
    assert np.abs(times * 1000 - np.rint(times * 1000)).max() < 1e-6


def test_a_view_does_not_tell_the_time():
    """Most frames have another one, minutes away, that looks from nearly the same place: time is not in the pose."""
    times = frame_times(72, 1800.0, 0)
    viewmats = camera_path(times, 1800.0, 0)
    centers = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[:, :, 0]
    apart = torch.cdist(centers, centers)
    later = torch.from_numpy(np.abs(times[:, None] - times[None])) > 240.0
    nearest = torch.where(later, apart, torch.inf).amin(1)
    assert (nearest < 0.5).double().mean() > 0.8  # of 2.2 m to the objects
    rotation = viewmats[:, :3, :3]
    assert torch.allclose(rotation @ rotation.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand(72, 3, 3))
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(72, dtype=torch.float64))


def test_a_swung_camera_moves_as_fast_as_a_lag_shows_and_the_same_way_at_any_moment():
    times = 20.0 + torch.arange(60, dtype=torch.float64) / 30.0
    viewmats = swung_path(times, 0)
    assert torch.equal(swung_path(times[7:8], 0)[0], viewmats[7])
    turns = viewmats[1:, :3, :3] @ viewmats[:-1, :3, :3].transpose(1, 2)
    centers = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[:, :, 0]
    speed = 30.0 * (centers.diff(dim=0).norm(dim=1) + torch.arccos(((turns.diagonal(dim1=1, dim2=2).sum(1)) - 1) / 2))
    assert 1.0 < speed.median() < 6.0  # m/s and rad/s
