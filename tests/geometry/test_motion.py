"""How a camera turns and how points move through its image, against finite differences."""

import torch
from swinging import K, pose

from heatsplat.geometry.motion import screen_velocity, twists
from heatsplat.geometry.projection import to_camera, to_pixels


def test_velocities_are_those_of_points_in_the_image():
    dt, at = 1e-4, 0.07
    found = twists(torch.stack([pose(at - dt), pose(at), pose(at + 2 * dt)]), torch.tensor([-dt, 0.0, 2 * dt]))
    points = torch.tensor([[0.3, -0.2, 0.0], [-0.5, 0.4, 0.7], [0.0, 0.1, 30.0]], dtype=torch.float64)
    local = to_camera(points, pose(at))
    velocity = screen_velocity(to_pixels(local, K), 1 / local[:, 2], K, found[1])
    ends = [to_pixels(to_camera(points, pose(at + s * dt)), K) for s in (-1, 1)]
    assert torch.allclose(velocity, (ends[1] - ends[0]) / (2 * dt), rtol=1e-4, atol=1e-4)
    assert not twists(torch.stack([pose(0.0), pose(0.1)]), torch.tensor([5.0, 5.0])).any()  # two frames of one moment
