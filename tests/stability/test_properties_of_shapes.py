"""Rotations and projections of Gaussians of any size and shape, against 50 digits and in types against each other."""

import math

import mpmath
import pytest
import torch
from draws import generator, logarithmic, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.geometry.projection import project_gaussians
from heatsplat.geometry.rotations import matrices_to_quats, normalised, quats_to_matrices, slerp
from heatsplat.physics.ellipsoids import (
    THOMSEN_POWER,
    convecting_area_ratio,
    projected_area_ratio,
    radiating_area_ratio,
)
from heatsplat.physics.grey_body import radiance, temperature_of
from heatsplat.renderers.base import EPS2D, FOV_MARGIN
from heatsplat.thermal.atmospheric_field import octaves

axes = logarithmic(1e-8, 1e3)
TYPES = [torch.float32, torch.float64]


def directions(seed: int, *shape: int, dtype=torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64).float().to(dtype)


@pytest.mark.parametrize("dtype", TYPES, ids=str)
@settings(max_examples=100)
@given(seeds(), logarithmic(1e-37, 1e37))
def test_a_quaternion_of_any_length_is_a_rotation(dtype, seed, length):
    quats = (directions(seed, 4) * length).to(dtype).requires_grad_()
    matrix = quats_to_matrices(quats)
    eps = torch.finfo(dtype).eps
    # Of two million rotations the worst is off by 11 eps, and one in four thousand by more than 8.
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=dtype), rtol=0, atol=16 * eps)
    matrix.sum().backward()
    assert quats.grad.isfinite().all()
    # A longer quaternion turns as much: the gradient has no part along it.
    along = (quats.grad.double() * quats.detach().double()).sum().abs()
    assert along <= 64 * eps * (quats.grad.double().norm() * quats.detach().double().norm() + 1)


@settings(max_examples=100)
@given(seeds(), logarithmic(1e-9, math.pi, 0.0))
def test_matrices_and_quaternions_are_each_others_inverse(seed, angle):
    axis = directions(seed, 3)
    axis = axis / axis.norm()
    quat = torch.cat([torch.tensor([math.cos(angle / 2)], dtype=torch.float64), math.sin(angle / 2) * axis])
    back = matrices_to_quats(quats_to_matrices(quat))
    assert min((back - quat).norm(), (back + quat).norm()) < 1e-15 * 8


@settings(max_examples=100)
@given(seeds(), logarithmic(1e-300, 3.0, 0.0), st.floats(0, 1))
def test_the_path_between_two_rotations_has_constant_speed(seed, angle, fraction):
    start = normalised(directions(seed, 4))
    turn = torch.tensor([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0], dtype=torch.float64)
    end = torch.stack([
        start[0] * turn[0] - start[1] * turn[1], start[0] * turn[1] + start[1] * turn[0],
        start[2] * turn[0] + start[3] * turn[1], start[3] * turn[0] - start[2] * turn[1],
    ])  # fmt: skip
    found = slerp(start, end, fraction)
    share = torch.tensor([math.cos(fraction * angle / 2), math.sin(fraction * angle / 2)], dtype=torch.float64)
    expected = torch.stack([
        start[0] * share[0] - start[1] * share[1], start[0] * share[1] + start[1] * share[0],
        start[2] * share[0] + start[3] * share[1], start[3] * share[0] - start[2] * share[1],
    ])  # fmt: skip
    assert (found - expected).norm() < 4e-15


def screen(dtype, quats, scales, slope, depth):
    means = torch.tensor([[slope * depth, -0.3 * slope * depth, depth]], dtype=torch.float64)
    K = torch.tensor([[500.0, 0, 200], [0, 520, 200], [0, 0, 1]], dtype=dtype)
    scales = scales.to(dtype).requires_grad_()
    eye = torch.eye(4, dtype=dtype)
    return scales, project_gaussians(means.to(dtype), quats.to(dtype), scales, eye, K, 400, 400, EPS2D, FOV_MARGIN)


@settings(max_examples=200)
@given(seeds(), axes, axes, axes, st.floats(-0.5, 0.5), logarithmic(0.1, 1e3))
def test_gaussians_of_any_shape_have_a_sound_image(seed, a, b, c, slope, depth):
    """Semi-axes from 1e-8 to 1e3, so ratios to 1e11: positive widths, finite gradients, and float32 near float64."""
    quats, scales = directions(seed, 1, 4), torch.tensor([[a, b, c]], dtype=torch.float64)
    leaves, found = screen(torch.float32, quats, scales, slope, depth)
    _, truth = screen(torch.float64, quats, scales, slope, depth)
    assert (found.variances > 0).all() and (found.whitening[:, [0, 2]] > 0).all()
    assert (found.compensation >= 0).all() and (found.compensation <= 1 + 1e-5).all()
    sum(x.sum() for x in (found.whitening[:, 0], found.whitening[:, 2], found.compensation)).backward()
    assert leaves.grad.isfinite().all()
    # A width seen from its edge or its end depends on the last digits of the rotation: they are what float32 lacks.
    tilt = max(a, b, c) / depth * 500 * 1e-6
    error = (found.variances.double() - truth.variances).abs()
    assert (error <= 2e-5 * truth.variances + tilt * truth.variances.sqrt()).all()
    exact = 1 / truth.whitening[:, 0]
    assert ((1 / found.whitening[:, 0].double() - exact).abs() <= 1e-3 * exact + tilt).all()


@pytest.mark.parametrize("dtype", TYPES, ids=str)
@settings(max_examples=100)
@given(axes, axes, axes, seeds())
def test_areas_over_volumes_of_ellipsoids_of_any_size(dtype, a, b, c, seed):
    semi = torch.tensor([a, b, c], dtype=dtype).requires_grad_()
    towards = directions(seed, 3)
    towards = (towards / towards.norm()).to(dtype)
    surface, shadow = radiating_area_ratio(semi), projected_area_ratio(semi, towards)
    (surface + shadow + convecting_area_ratio(semi, "printed")).backward()
    assert semi.grad.isfinite().all() and surface > 0 and shadow > 0
    # A body shows between none and half of its surface (a flat disc from the front), within Thomsen's 1.1 %.
    assert shadow <= 0.5 * surface * 1.011
    with mpmath.workdps(50):
        p, sides = mpmath.mpf(THOMSEN_POWER), [mpmath.mpf(x) for x in (a, b, c)]
        pairs = sum((sides[i] * sides[j]) ** p for i, j in ((0, 1), (0, 2), (1, 2)))
        exact = 3 * (pairs / 3) ** (1 / p) / (sides[0] * sides[1] * sides[2])
    assert abs(surface.item() - exact) <= 12 * torch.finfo(dtype).eps * exact


@settings(max_examples=100)
@given(logarithmic(1e-6, 1.0), logarithmic(1e-3, 1.0), st.floats(0, 1), st.floats(0, 1), logarithmic(1e-6, 1e3))
def test_grey_bodies_can_be_inverted(temperature, emissivity, reflectance, surroundings, gain):
    numbers = [
        torch.tensor([x], dtype=torch.float64) for x in (emissivity, temperature, gain, reflectance, surroundings)
    ]
    emissivity, temperature, gain, reflectance, surroundings = numbers
    sent = radiance(emissivity, temperature, gain, reflectance, surroundings)
    back = temperature_of(sent, emissivity, gain, reflectance, surroundings)
    # What is sent is rounded, and so is what is left of it without the reflection: T⁴ errs by their sum.
    error = 8 * 2.3e-16 * (sent + reflectance * surroundings) / (emissivity * gain)
    assert ((back**4 - temperature**4).abs() <= error).all()
    assert temperature_of(sent * 0 - 1, emissivity, gain, reflectance, surroundings).item() == 0


@settings(max_examples=100)
@given(st.floats(-0.9, 0.9), st.integers(1, 16))
def test_every_octave_keeps_its_digits(position, count):
    found = octaves(torch.tensor([[position]], dtype=torch.float32), count)[0].double().tolist()
    with mpmath.workdps(50):
        place = mpmath.mpf(torch.tensor(position, dtype=torch.float32).item())
        exact = [float(f(2**k * place)) for f in (mpmath.sinpi, mpmath.cospi) for k in range(count)]
    assert max(abs(a - b) for a, b in zip(found, exact, strict=True)) < 5e-7
