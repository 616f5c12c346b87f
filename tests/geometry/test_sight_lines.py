import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.sight_lines import cosines, distances, rays
from heatsplat.training.rng import generator_for


def camera(width: int = 40, height: int = 32) -> Camera:
    K = torch.tensor([[38.0, 0, 20.5], [0, 41.0, 15.0], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, width, height)


def plane(normal, offset: float) -> torch.Tensor:
    """Camera z of the plane n x = offset in every pixel."""
    return offset / (rays(camera()) @ torch.tensor(normal, dtype=torch.float64))


def test_distances_are_those_along_the_line_of_sight():
    depth = torch.full((32, 40), 3.0, dtype=torch.float64)
    depth[0, 0] = torch.inf
    found = distances(camera(), depth)
    x, y = (30.5 - 20.5) / 38.0, (20.5 - 15.0) / 41.0
    assert found[20, 30] == 3.0 * (1 + x**2 + y**2) ** 0.5 and found[0, 0].isinf()


def test_a_plane_has_one_normal_and_is_seen_at_the_angle_of_each_ray():
    normal = torch.nn.functional.normalize(torch.tensor([0.2, -0.6, 1.0], dtype=torch.float64), dim=0)
    found = cosines(camera(), plane(normal.tolist(), 5.0))
    truth = (torch.nn.functional.normalize(rays(camera()), dim=-1) @ normal).abs()
    inner = (slice(3, -3), slice(3, -3))
    torch.testing.assert_close(found[inner], truth[inner], rtol=1e-9, atol=1e-9)
    noise = 1 + 0.01 * torch.randn(32, 40, generator=generator_for(0, 0, "depth"), dtype=torch.float64)
    rough = cosines(camera(), plane(normal.tolist(), 5.0) * noise)
    assert (torch.rad2deg(rough.arccos() - truth.arccos()))[inner].abs().median() < 3.0
    assert found[0].isnan().all() and found[:, -1].isnan().all()


def test_edges_and_holes_have_no_angle():
    depth = torch.full((32, 40), 3.0, dtype=torch.float64)
    depth[:, 20:] = 9.0
    depth[10, 5] = torch.inf
    found = cosines(camera(), depth)
    assert found[15, 19:21].isnan().all() and found[9:12, 4:7].isnan().all() and found[15, 12] == found[15, 12]
    assert cosines(camera(2, 2), torch.ones(2, 2)).isnan().all()
