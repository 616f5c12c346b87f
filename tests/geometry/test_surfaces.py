"""Planes through points and normals of depth maps, against planes that are known."""

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.surfaces import depth_normals, on_the_side_of, plane_axes, plane_thickness
from heatsplat.training.rng import generator_for


def drawn(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator_for(0, 0, "surfaces"), dtype=torch.float64)


def test_planes_of_points_on_two_walls_are_those_walls():
    flat = drawn(400, 2)
    level = torch.cat([flat[:200], torch.zeros(200, 1)], dim=1)
    upright = torch.cat([flat[200:, :1], torch.full((200, 1), 3.0), flat[200:, 1:] + 1.0], dim=1)
    axes, far = plane_axes(torch.cat([level, upright]), torch.cat([level, upright]), 8)
    assert torch.allclose(torch.linalg.det(axes), torch.ones(400, dtype=torch.float64))
    normals = axes[..., 2].abs()
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], dtype=torch.float64).repeat_interleave(200, dim=0)
    assert torch.allclose(normals, expected, atol=1e-9)
    # 200 points in a square: 8 of them lie in a circle of radius 0.11 and mean squared distance 0.11² / 2.
    assert 0.06 < far.median() < 0.11


def test_normals_are_turned_to_the_side_that_is_asked_for():
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    turned = on_the_side_of(normals, torch.tensor([[5.0, 0.0, 0.1], [0.0, 5.0, -0.1]]))
    assert torch.equal(turned, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))


def test_a_depth_map_of_a_plane_gives_its_normal_towards_the_camera_and_nothing_where_it_is_open():
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, 0.2], [-0.3, 0, 0.5], [-0.2, -0.5, 0]]).double())
    camera = Camera(viewmat, torch.tensor([[30.0, 0, 16], [0, 28.0, 12], [0, 0, 1]]), 32, 24)
    rows, columns = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    rays = torch.stack([(columns - 16) / 30, (rows - 12) / 28, torch.ones(24, 32)], dim=-1).double()
    normal = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, -1.0], dtype=torch.float64), dim=0)  # camera axes
    z = 4.0 * normal[2] / (rays @ normal)  # the plane through (0, 0, 4)
    alpha = torch.full((24, 32), 0.9, dtype=torch.float64)
    alpha[:, :8] = 0.2
    found = depth_normals(alpha * z, alpha, camera)
    expected = normal @ viewmat[:3, :3]
    assert torch.allclose(found[:, 10:], expected.expand(24, 22, 3), atol=1e-9)
    assert (found[:, :7] == 0).all()
    assert found.isfinite().all()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_planes_end_at_an_edge(noise):
    """A floor and a wall that meet: only points that lie on both may have another plane than theirs."""
    flat, scatter = drawn(800, 2), noise * (drawn(800) - 0.5)
    floor = torch.stack([flat[:400, 0], flat[:400, 1], scatter[:400]], dim=1)
    wall = torch.stack([flat[400:, 0], scatter[400:], flat[400:, 1]], dim=1)
    points = torch.cat([floor, wall])
    normals = plane_axes(points, points, 12)[0][..., 2].abs()
    expected = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], dtype=torch.float64).repeat_interleave(400, dim=0)
    off = torch.rad2deg(torch.acos((normals * expected).sum(1).clamp(max=1.0)))
    beside = torch.cat([flat[:400, 1], flat[400:, 1]])
    assert (off[beside > 0.03] < 5.0).float().mean() > 0.98
    # Planes through the nearest points alone cut the corner as far as those reach, about 0.1.
    own = plane_thickness(points, points, 12)[0][..., 2].abs()
    cut = torch.rad2deg(torch.acos((own * expected).sum(1).clamp(max=1.0)))
    assert (cut[(beside > 0.03) & (beside < 0.1)] > 5.0).float().mean() > 0.5


def test_planes_at_places_beside_the_points_are_theirs():
    points = torch.cat([drawn(100, 2), torch.zeros(100, 1)], dim=1)
    axes, far = plane_axes(points, torch.tensor([[0.5, 0.5, 0.3]]), 8)
    assert axes.shape == (1, 3, 3) and float(axes[0, 2, 2].abs()) == pytest.approx(1.0) and 0.3 < float(far) < 0.4
