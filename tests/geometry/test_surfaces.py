"""Planes through points and normals of depth maps, against planes that are known."""

import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.surfaces import depth_normals, on_the_side_of, plane_axes
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
