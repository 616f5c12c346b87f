"""A wall that a swung camera films: exact images at any moment, and what a detector that lags makes of them."""

import math
from functools import cache

import torch

from heatsplat.contracts import Camera, Frame
from heatsplat.datamodules.synthetic_scene.moving import Bolometers

HEIGHT, WIDTH, HZ = 32, 40, 30.0
K = torch.tensor([[40.0, 0, 20.0], [0, 38.0, 16.0], [0, 0, 1]], dtype=torch.float64)
TIMES = torch.arange(9, dtype=torch.float64) / HZ


def pose(at):
    """World to camera at a moment, before a wall at z = 0: it shifts, nears, turns and rolls."""
    x, y = 0.8 * math.sin(3 * at + 0.3), 0.6 * math.sin(3 * at + 0.5)
    z, a, b, c = -2.0 - 0.3 * math.sin(2 * at), 0.2 * math.sin(3 * at), 0.2 * math.sin(2 * at), 0.3 * math.sin(3 * at)
    turn = torch.tensor([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]], dtype=torch.float64).matrix_exp()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ torch.tensor([x, y, z], dtype=torch.float64)
    return viewmat


@cache
def wall(at):
    """What the camera sees at a moment [H, W], float64, and how far away it is."""
    viewmat = pose(at)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], -1).double()
    centre, world = -viewmat[:3, :3].T @ viewmat[:3, 3], rays @ viewmat[:3, :3]
    depth = -centre[2] / world[..., 2]
    on = centre + depth[..., None] * world
    return 0.5 + 0.2 * torch.sin(7 * on[..., 0] + 1) + 0.2 * torch.sin(6 * on[..., 1] - 3 * on[..., 0]), depth


@cache
def frames():
    return [Frame(f"{i}.png", i, Camera(pose(t), K, WIDTH, HEIGHT), t) for i, t in enumerate(TIMES.tolist())]


@cache
def recorded(tau, readout):
    """What a simulated camera reads, [F, H, W] float64."""
    return Bolometers(tau, readout).images(lambda at: (wall(t)[0] for t in at), TIMES.numpy(), HEIGHT)
