"""Projection: against explicit matrices, finite differences, and in float32 where the naive form loses every digit."""

import math

import pytest
import torch

from heatsplat.geometry.projection import clamped_slopes, look_at, project_gaussians, to_camera, to_pixels, to_world
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.training.rng import generator_for

K = torch.tensor([[50.0, 0, 30], [0, 55, 26], [0, 0, 1]], dtype=torch.float64)
SIZE = (64, 48)


def scene(count=50, scales=(0.05, 0.5), dtype=torch.float64):
    generator = generator_for(0, 0, "projection")
    means = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    low, high = (math.log(s) for s in scales)
    sizes = (low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)).exp()
    eye = torch.tensor([0.5, -1.0, -5.0], dtype=torch.float64)
    viewmat = look_at(eye, torch.zeros_like(eye), torch.tensor([0.0, -1.0, 0.2], dtype=torch.float64))
    return [x.to(dtype) for x in (means, quats, sizes, viewmat, K)]


def project(means, quats, scales, viewmat, K, eps2d=0.3):
    return project_gaussians(means, quats, scales, viewmat, K, *SIZE, eps2d, 0.3)


def screen_covariances(means, quats, scales, viewmat, K, eps2d):
    """J W R diag(scales²) Rᵀ Wᵀ Jᵀ + eps2d, with the Jacobian of ``to_pixels`` by autograd."""
    points = to_camera(means, viewmat)
    held = torch.cat([clamped_slopes(points, K, *SIZE, 0.3) * points[:, 2:], points[:, 2:]], dim=1)
    jacobians = torch.stack([torch.autograd.functional.jacobian(lambda p: to_pixels(p, K), p) for p in held])
    jacobians = jacobians @ viewmat[:3, :3]
    axes = quats_to_matrices(quats) * scales[..., None, :]
    return jacobians @ (axes @ axes.mT) @ jacobians.mT + eps2d * torch.eye(2, dtype=means.dtype)


def test_points_go_through_the_pinhole():
    point = torch.tensor([[1.0, 2.0, 4.0]], dtype=torch.float64)
    assert to_pixels(point, K).tolist() == [[50 / 4 + 30, 55 * 2 / 4 + 26]]
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([1.0, 0.0, -2.0])
    assert to_camera(point, viewmat).tolist() == [[2.0, 2.0, 2.0]]


def test_the_way_back_to_the_world():
    means, _, _, viewmat, _ = scene()
    torch.testing.assert_close(to_world(to_camera(means, viewmat), viewmat), means)


def test_variances_and_whitening_are_those_of_the_covariance():
    arguments = scene()
    screen, expected = project(*arguments), screen_covariances(*arguments, 0.3)
    torch.testing.assert_close(screen.variances, expected.diagonal(dim1=1, dim2=2))
    p, q, r = screen.whitening.unbind(1)
    zero = torch.zeros_like(p)
    root = torch.stack([torch.stack([p, -p * q], -1), torch.stack([zero, r], -1)], -2)
    torch.testing.assert_close(root.mT @ root, torch.linalg.inv(expected))
    torch.testing.assert_close(screen.means, to_pixels(to_camera(arguments[0], arguments[3]), K))
    torch.testing.assert_close(screen.depths, to_camera(arguments[0], arguments[3])[:, 2])


def test_compensation_is_the_ratio_of_determinants():
    arguments = scene()
    plain, blurred = (torch.linalg.det(screen_covariances(*arguments, eps2d)) for eps2d in (0.0, 0.3))
    torch.testing.assert_close(project(*arguments).compensation, (plain / blurred).sqrt())


def test_the_view_need_not_be_a_rotation():
    # Optimising a pose moves its entries one by one, and their gradients must be right all the same.
    means, quats, scales, viewmat, _ = scene(6)
    viewmat = viewmat + 0.1 * torch.arange(16, dtype=torch.float64).view(4, 4).sin()
    plain, blurred = (
        torch.linalg.det(screen_covariances(means, quats, scales, viewmat, K, eps2d)) for eps2d in (0.0, 0.3)
    )
    torch.testing.assert_close(project(means, quats, scales, viewmat, K).compensation, (plain / blurred).sqrt())


def test_gradients():
    means, quats, scales, viewmat, _ = (x.requires_grad_() for x in scene(4))
    function = lambda *rows: tuple(project(*rows, K))  # noqa: E731
    assert torch.autograd.gradcheck(function, (means, quats, scales, viewmat))


def test_needles_keep_their_digits_in_float32():
    exact, single = (scene(300, (1e-4, 3.0), dtype) for dtype in (torch.float64, torch.float32))
    exact = [x.double() for x in single]
    screen, expected = project(*single), project(*exact)
    for actual, wanted in ((screen.compensation, expected.compensation), (screen.whitening, expected.whitening)):
        error = (
            (actual.double() - wanted).norm(dim=-1) / wanted.norm(dim=-1)
            if wanted.ndim > 1
            else ((actual.double() - wanted).abs() / wanted)
        )
        assert error.max() < 2e-4
    # The textbook form, det = xx yy - xy², of the same float32 numbers has no correct digit on the worst of them.
    flat = screen_covariances(*single, 0.0)
    naive = flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] ** 2
    true = torch.linalg.det(screen_covariances(*exact, 0.0))
    assert ((naive - true) / true).abs().max() > 1


def test_a_disc_seen_from_its_edge_has_no_area_and_a_finite_gradient():
    means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
    scales = torch.tensor([[0.5, 0.0, 0.5]], requires_grad=True)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], requires_grad=True)
    screen = project(means, quats, scales, torch.eye(4), K.float())
    assert screen.compensation.item() == 0
    sum(x.sum() for x in screen).backward()
    for leaf in (means, scales, quats):
        assert leaf.grad.isfinite().all()


def test_huge_gaussians_do_not_overflow_in_float32():
    screen = project_gaussians(
        torch.tensor([[0.0, 0.0, 0.01]]), torch.tensor([[1.0, 0.2, 0.3, 0.1]]), torch.full((1, 3), 1e6),
        torch.eye(4), K.float(), *SIZE, 0.3, 0.3,
    )  # fmt: skip
    assert all(x.isfinite().all() for x in screen)
    assert screen.compensation.item() == pytest.approx(1)


def test_slopes_are_held_at_the_margin():
    points = torch.tensor([[10.0, 0.1, 1.0], [-10.0, 9.0, 1.0], [0.2, -9.0, 2.0]], dtype=torch.float64)
    right, left = (64 - 30) / 50 + 0.3 * 32 / 50, -30 / 50 - 0.3 * 32 / 50
    bottom, top = (48 - 26) / 55 + 0.3 * 24 / 55, -26 / 55 - 0.3 * 24 / 55
    expected = torch.tensor([[right, 0.1], [left, bottom], [0.1, top]], dtype=torch.float64)
    torch.testing.assert_close(clamped_slopes(points, K, *SIZE, 0.3), expected)


def test_look_at():
    eye, target, up = (torch.tensor(x, dtype=torch.float64) for x in ([1.0, 2, 3], [4.0, 0, 1], [0.0, 0, 1]))
    viewmat = look_at(eye, target, up)
    torch.testing.assert_close(to_camera(eye, viewmat), torch.zeros(3, dtype=torch.float64))
    distance = (target - eye).norm().item()
    torch.testing.assert_close(to_camera(target, viewmat), torch.tensor([0, 0, distance], dtype=torch.float64))
    above = to_camera(eye + up, viewmat)
    assert above[1] < 0  # y is down
    assert above[0].abs() < 1e-12
    assert torch.linalg.det(viewmat).item() == pytest.approx(1)


@pytest.mark.parametrize(("target", "up"), [((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), ((1.0, 2.0, 9.0), (0.0, 0.0, 1.0))])
def test_look_at_refuses_what_has_no_direction(target, up):
    eye, target, up = (torch.tensor(x, dtype=torch.float64) for x in ((1.0, 2.0, 3.0), target, up))
    with pytest.raises(ValueError, match="look_at needs a target away from the eye and an up direction across"):
        look_at(eye, target, up)
