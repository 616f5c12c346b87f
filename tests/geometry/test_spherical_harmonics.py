"""Spherical harmonics: against SciPy's, orthonormality, rotation, and directions that are no directions."""

import math

import numpy as np
import pytest
import torch

from heatsplat.geometry import spherical_harmonics


def directions(count, seed=0):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scipy_basis(points, degree):
    """Real harmonics from SciPy's complex ones; SciPy's already carry the Condon-Shortley phase."""
    from scipy.special import sph_harm_y

    x, y, z = (points / points.norm(dim=1, keepdim=True)).numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    values = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            value = sph_harm_y(l, abs(m), polar, azimuth)
            values.append(value.real if m == 0 else math.sqrt(2) * (value.imag if m < 0 else value.real))
    return torch.from_numpy(np.stack(values, -1))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_basis_equals_scipy(degree):
    points = directions(50)
    assert torch.allclose(spherical_harmonics.basis(points, degree), scipy_basis(points, degree), atol=1e-12)


def test_basis_is_orthonormal_on_the_sphere():
    # Gauss-Legendre in z and equal steps of azimuth integrate polynomials of degree 6 exactly
    z, weights = np.polynomial.legendre.leggauss(6)
    azimuth = np.arange(12) * (2 * np.pi / 12)
    r = np.sqrt(1 - z**2)[:, None]
    points = np.stack((r * np.cos(azimuth), r * np.sin(azimuth), np.broadcast_to(z[:, None], (6, 12))), -1)
    values = spherical_harmonics.basis(torch.from_numpy(points.reshape(-1, 3)), 3)
    weights = torch.from_numpy(np.repeat(weights, 12) * 2 * np.pi / 12)
    assert torch.allclose(values.T @ (weights[:, None] * values), torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_first_degree_has_the_signs_of_3dgs():
    c = math.sqrt(3 / (4 * math.pi))
    values = spherical_harmonics.basis(torch.eye(3, dtype=torch.float64), 1)[:, 1:]
    assert torch.allclose(values, c * torch.tensor([[0, 0, -1], [-1, 0, 0], [0, 1, 0]], dtype=torch.float64))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_evaluate_is_the_sum_over_bands(degree):
    points = directions(20)
    coefficients = torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = sum(
        scipy_basis(points, degree)[:, band, None] * coefficients[:, band] for band in range((degree + 1) ** 2)
    )
    assert torch.allclose(spherical_harmonics.evaluate(coefficients, points, degree), expected, atol=1e-12)


def test_gradients():
    points = directions(6).requires_grad_()
    coefficients = torch.randn(6, 16, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    coefficients.requires_grad_()
    assert torch.autograd.gradcheck(lambda c, d: spherical_harmonics.evaluate(c, d, 3), (coefficients, points))


@pytest.mark.parametrize("length", [1e-38, 1e-20, 1e-3, 1.0, 1e10, 1e30])
def test_only_the_direction_counts(length):
    points = directions(20).float()
    points = points / points.norm(dim=1, keepdim=True)
    expected = spherical_harmonics.basis(points, 3)
    assert torch.allclose(spherical_harmonics.basis(points * length, 3), expected, atol=2e-5)


def test_a_direction_of_zero_length_leaves_the_constant():
    points = torch.zeros(2, 3, requires_grad=True)
    coefficients = torch.ones(2, 16, 1)
    value = spherical_harmonics.evaluate(coefficients, points, 3)
    assert torch.allclose(value, torch.full((2, 1), spherical_harmonics.C0))
    value.sum().backward()
    assert points.grad.abs().max() == 0


def test_degree_zero_reads_no_direction():
    coefficients = torch.tensor([[[2.0]]])
    assert spherical_harmonics.evaluate(coefficients, None, 0).item() == pytest.approx(2 * spherical_harmonics.C0)


def test_errors():
    with pytest.raises(ValueError, match="degree 0 to 3 here, got 4"):
        spherical_harmonics.band_count(4)
    with pytest.raises(ValueError, match="degree 2 needs 9 coefficients per channel, got 4"):
        spherical_harmonics.evaluate(torch.zeros(1, 4, 1), torch.ones(1, 3), 2)
