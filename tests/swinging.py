"""A wall that a swung camera films: exact images at any moment, and what a detector that lags makes of them."""

import math
from dataclasses import replace
from functools import cache

import torch

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
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


def film(found=None):
    """The scene of these frames."""
    views = ViewSet(found or frames(), lambda index: None)
    return SceneData("wall", views, views, views, torch.zeros(4, 3))


def ready(part, **raw):
    """A part of a sensor that has seen the scene, with these raw parameters."""
    part = part.double()
    part.prepare(film())
    with torch.no_grad():
        for name, value in raw.items():
            getattr(part, name).fill_(value)
    return part


def through(chain, i):
    """What a chain of parts makes of the clean image of a frame, [H, W]."""
    image, depth = wall(TIMES[i].item())
    return chain(image[..., None], frames()[i], depth)[..., 0]


def points_on_a_wall(images, hz=1.0):
    """The wall in these images [F, H, W] with noise, and points on it; its times are ``hz`` times too fast."""
    generator = torch.Generator().manual_seed(0)
    images = images + 0.002 * torch.randn(images.shape, generator=generator)
    known = [replace(one, time_s=one.time_s / hz) for one in frames()]
    views = ViewSet(known, lambda i: View(known[i], images[i, ..., None].float()))
    spots = torch.cat([4 * torch.rand(500, 2, generator=generator) - 2, torch.zeros(500, 1)], 1)
    empty = views.subset([])
    return SceneData("wall", views, empty, empty, spots)


def clean():
    """Clean images of all frames, [F, H, W]."""
    return torch.stack([wall(t)[0] for t in TIMES.tolist()])
