"""The surface that Gaussians show, with fog before it and clutter behind it."""

from functools import partial

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.closest_depth import closest_depth
from heatsplat.geometry.coverage import surface_depth
from heatsplat.renderers.settings import Renderer

WALL = 4.0
RENDERER = Renderer(backend="cpu")


@pytest.fixture
def camera() -> Camera:
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, 32, 24)


def layers(*opacity_at: tuple[float, float]):
    """Layers of Gaussians across the image, each with an opacity and a depth."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41), indexing="xy")
    plane = torch.stack([x, y, torch.ones_like(x)], dim=-1).reshape(-1, 3)
    means = torch.cat([z * plane for _, z in opacity_at])
    scales = torch.cat([torch.full_like(plane, 0.05 * z) for _, z in opacity_at])
    opacities = torch.cat([torch.full((len(plane),), opacity) for opacity, _ in opacity_at])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    return means, quats, scales * torch.tensor([1.0, 1.0, 0.05]), opacities[None]


def found(shapes, camera, mask=None):
    return closest_depth(partial(RENDERER.depths_at_shares, shapes), camera, mask)


def test_fog_before_a_wall_and_clutter_behind_it_do_not_move_it(camera):
    fog = [(0.02, z) for z in (1.0, 1.5, 2.0, 2.5, 3.0)]
    clutter = [(0.5, z) for z in (8.0, 12.0, 20.0)]
    shapes = layers(*fog, (0.3, WALL), *clutter)
    depth, spread = found(shapes, camera)
    output = RENDERER.values_seen(shapes, torch.zeros(len(shapes[0]), 1), camera, depth=True)
    mean = surface_depth(output.depth, output.alpha[0])
    inner = (slice(6, -6), slice(6, -6))
    assert (depth - WALL).abs()[inner].max() < 0.06 * WALL and spread[inner].max() < 0.2 * WALL
    assert (mean - WALL).abs()[inner].median() > 0.1 * WALL


def test_a_surface_before_all_mean_depths_is_found_where_its_gaussians_lie(camera):
    """As the ground below a drone, with much of a pixel's opacity far behind it: any stretch within half a unit of 74."""
    thin = [(0.03, 73.5 + 0.05 * i) for i in range(21)]
    far = (0.1, 110.0), (0.1, 130.0), (0.1, 160.0), (0.2, 300.0), (0.5, 900.0)
    depth, spread = found(layers(*thin, *far), camera)
    inner = (slice(6, -6), slice(6, -6))
    assert (depth - 74.0).abs()[inner].median() < 0.55 and spread[inner].median() < 0.3


def test_a_mask_and_open_pixels_are_infinite(camera):
    mask = torch.ones(24, 32, dtype=torch.bool)
    mask[:, :10] = False
    depth, spread = found(layers((0.5, WALL)), camera, mask)
    assert depth[:, :10].isinf().all() and spread[:, :10].isinf().all() and depth[:, 10:].isfinite().all()
    depth, spread = found(layers((0.01, WALL)), camera)
    assert depth.isinf().all() and spread.isinf().all()


def test_a_large_image_is_looked_at_in_strips(camera, monkeypatch):
    shapes = layers(*[(0.03, WALL + 0.02 * i) for i in range(60)])
    mask = torch.rand(24, 32, generator=torch.Generator().manual_seed(0)) > 0.3
    whole = found(shapes, camera, mask)
    monkeypatch.setattr("heatsplat.geometry.closest_depth.AT_ONCE", 32 * 5)
    for one, other in zip(whole, found(shapes, camera, mask), strict=True):
        assert torch.equal(one.isinf(), other.isinf())
        torch.testing.assert_close(other[mask], one[mask], atol=0.05, rtol=0)
    assert whole[1][mask].median() > 0.05
