"""Normals of surfaces at points that are a few millimetres off, and near edges."""

from types import SimpleNamespace

import torch
from effects.tracks import drawn

from heatsplat.effects.surface import normals

SIDE = 300  # points of each of two surfaces that meet at a right angle, 2 m by 2 m
OFF_M = 0.004


def seen_from_between():
    """What is seen of a floor and a wall, of points that lie OFF_M beside them; and their true normals."""
    along = 2.0 * torch.rand(2 * SIDE, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = torch.cat([along, torch.zeros(2 * SIDE, 1, dtype=torch.float64)], 1)
    points[SIDE:] = points[SIDE:][:, [0, 2, 1]]
    true = torch.zeros_like(points)
    true[:SIDE, 2] = true[SIDE:, 1] = 1.0
    directions = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64) - points, dim=1)
    points = points + OFF_M * drawn(2 * SIDE, 3, seed=2)
    tracks = SimpleNamespace(points=points, directions=directions[:, None], weights=torch.ones(2 * SIDE, 1))
    return SimpleNamespace(tracks=tracks, scene=SimpleNamespace(points=points.float()), still=False), true


def test_normals_are_those_of_the_surface_beside_an_edge_too():
    obs, true = seen_from_between()
    found = normals(obs)
    assert torch.allclose(found.norm(dim=1), torch.ones(2 * SIDE, dtype=torch.float64))
    off = torch.rad2deg(torch.acos((found * true).sum(1).clamp(-1, 1)))
    assert off.median() < 1.0  # of one plane through nine points: 1.6
    assert off.quantile(0.9) < 5.0  # 24


def test_a_camera_that_stands_still_and_few_points_tell_no_surface():
    obs, _ = seen_from_between()
    assert normals(SimpleNamespace(**(vars(obs) | {"still": True}))) is None
    assert normals(SimpleNamespace(**(vars(obs) | {"scene": SimpleNamespace(points=torch.zeros(11, 3))}))) is None
