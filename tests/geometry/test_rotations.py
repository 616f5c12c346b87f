"""Rotations: against independent constructions, at all angles and lengths, with gradients."""

import math

import pytest
import torch

from heatsplat.geometry.rotations import matrices_to_quats, normalised, quats_to_matrices, reflected, slerp
from heatsplat.training.rng import generator_for


def random_quats(count=200, dtype=torch.float64):
    return torch.randn(count, 4, generator=generator_for(0, 0, "quats"), dtype=torch.float64).to(dtype)


def about(axis, angle):
    """Rotation matrix by the matrix exponential, which shares no formula with quaternions."""
    x, y, z = (angle * torch.tensor(axis, dtype=torch.float64) / math.hypot(*axis)).tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(skew)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 1.7, math.pi - 1e-9, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.3, -0.5, 0.8), (-0.7, -0.7, 0.1)])
def test_axis_and_angle(axis, angle):
    unit = torch.tensor(axis, dtype=torch.float64) / math.hypot(*axis)
    quat = torch.cat([torch.tensor([math.cos(angle / 2)], dtype=torch.float64), math.sin(angle / 2) * unit])
    expected = about(axis, angle)
    torch.testing.assert_close(quats_to_matrices(quat), expected, rtol=0, atol=1e-14)
    back = matrices_to_quats(expected)
    assert (back * quat).sum().abs().item() == pytest.approx(1, abs=1e-14)
    assert back[0] >= 0


def test_matrices_are_rotations_and_come_back():
    matrices = quats_to_matrices(random_quats())
    identity = torch.eye(3, dtype=torch.float64).expand_as(matrices)
    torch.testing.assert_close(matrices @ matrices.mT, identity, rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(200, dtype=torch.float64), rtol=0, atol=1e-14)
    torch.testing.assert_close(quats_to_matrices(matrices_to_quats(matrices)), matrices, rtol=0, atol=1e-14)


@pytest.mark.parametrize("length", [1e-37, 1e-20, 1.0, 1e20, 1e37])
def test_length_does_not_matter(length):
    quats = random_quats(dtype=torch.float32)
    torch.testing.assert_close(quats_to_matrices(quats * length), quats_to_matrices(quats), rtol=0, atol=1e-6)


def test_the_gradient_is_exact_and_orthogonal_to_the_quaternion():
    quats = random_quats(5).requires_grad_()
    assert torch.autograd.gradcheck(quats_to_matrices, quats)
    weights = torch.arange(45.0, dtype=torch.float64).view(5, 3, 3)
    gradient = torch.autograd.grad((weights * quats_to_matrices(quats)).sum(), quats)[0]
    assert (gradient * quats).sum(1).abs().max() < 1e-12
    assert gradient.abs().min() > 0


def test_a_zero_quaternion_stays_zero_with_a_finite_gradient():
    quats = torch.zeros(1, 4, requires_grad=True)
    unit = normalised(quats)
    unit.sum().backward()
    assert (unit == 0).all()
    assert quats.grad.isfinite().all()


def test_slerp_turns_evenly_about_one_axis():
    axis = (0.3, -0.5, 0.8)
    start, end = (matrices_to_quats(about(axis, angle)) for angle in (0.2, 2.9))
    fractions = torch.linspace(0, 1, 7, dtype=torch.float64)
    for fraction, quat in zip(fractions.tolist(), slerp(start, end, fractions), strict=True):
        expected = about(axis, 0.2 + fraction * 2.7)
        torch.testing.assert_close(quats_to_matrices(quat), expected, rtol=0, atol=1e-13)


def test_slerp_takes_the_shorter_way():
    start, end = (matrices_to_quats(about((0, 0, 1), angle)) for angle in (0.1, 0.5))
    torch.testing.assert_close(slerp(start, -end, 0.5), slerp(start, end, 0.5))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.99e-4, 1.01e-4])
def test_slerp_between_neighbours(angle):
    start, end = (matrices_to_quats(about((1, 2, 3), a)) for a in (0.0, angle))
    expected = matrices_to_quats(about((1, 2, 3), 0.25 * angle))
    torch.testing.assert_close(slerp(start, end, 0.25), expected, rtol=0, atol=1e-13)


def test_between_a_rotation_and_itself_there_is_only_itself():
    """The dot product of a unit quaternion with itself rounds to more than 1, of which acos is NaN."""
    for dtype, bound in ((torch.float32, 3e-7), (torch.float64, 5e-16)):
        quats = random_quats(2000, dtype)
        assert (normalised(quats).square().sum(-1) > 1).any()
        torch.testing.assert_close(slerp(quats, quats, 0.3), normalised(quats), rtol=0, atol=bound)


def test_a_mirror_turns_what_is_across_it_and_keeps_what_is_along():
    normals = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, 1.0], [1.0, 1.0, 0.0]]), dim=1)
    directions = torch.tensor([[1.0, 2.0, -3.0], [1.0, 0.0, 5.0]])
    expected = torch.tensor([[1.0, 2.0, 3.0], [0.0, -1.0, 5.0]])
    torch.testing.assert_close(reflected(directions, normals), expected)
    torch.testing.assert_close(reflected(directions, -normals), expected)
