"""Newton's law of cooling with harmonic sources, in closed form: dT/dt = -a (T - T_ambient) + sum of sources.

The response from rest to the source e^{iωt} is K(t) = ∫_0^t e^{-a(t-s)} e^{iωs} ds = (e^{iωt} - e^{-at}) / (a + iω);
its real part answers cos ωt and its imaginary part sin ωt. As printed (ETGS, ICLR 2026, Eq. 8, with τ = 1/a) it becomes
0/0 or inf - inf in every limit; in float32 it was measured to be wrong by 600 %. Written in the dimensionless x = ωt
and y = at, with functions that stay of order one,

    φ = (1 - e^{-y})/y,   sinc = sin x / x,   cosc = (1 - cos x)/x,   q = y²/(x² + y²),   o = 1 - q,   p = xy/(x² + y²)
    response to cos = t [q φ + o sinc - p cosc]
    response to sin = t [p (sinc - φ) + o cosc]

nothing cancels except sinc - φ where both are near one, which is then taken as (1 - φ) - (1 - sinc) with both brackets
by series. The derivative by the rate has the same shape (see ``response_slope``), so gradients keep the accuracy of
values down to a = 0, ω = 0, t = 0 and all of them at once.

**Convention:** rates in 1/s and at least 0, ω in rad/s, time in float64 seconds from the moment of the initial state;
any consistent unit of time does as well. Before that moment (t < 0) e^{-at} would grow without bound, so the rate is
limited to 1/|t|: at most one time constant is extrapolated backwards, and e^{-at} stays below e.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable

BACKWARD_TIME_CONSTANTS = 1.0  # how far e^{-at} is extrapolated to t < 0, in time constants

# Series are used below 1, where they converge to float64 accuracy within this many terms (1/20! = 4e-19).
_TERMS = 17
_SPLIT = 134217729.0  # 2^27 + 1 cuts a float64 into two halves whose products are exact (Dekker 1971)


class Phases(NamedTuple):
    """Functions of x = ωt for the frequencies [K], float64: K numbers per moment, so exactness costs nothing.

    x; sinc = sin x / x; cosc = (1 - cos x)/x; sinc2 = (1 - sinc)/x²; cosc1 = (1 - cos x)/x²; cosc3 = (1/2 - cosc1)/x².
    """

    x: Tensor
    sinc: Tensor
    cosc: Tensor
    sinc2: Tensor
    cosc1: Tensor
    cosc3: Tensor


def phases(omega: Tensor, time: Tensor) -> Phases:
    """Phase functions of ω [K] at a time [], both float64; x reaches 1e7, so the rounding of the product counts."""
    x, rest = _exact_product(omega, time.to(omega.device))
    half, rest = x / 2, rest / 2
    sin_half, cos_half = half.sin() + rest * half.cos(), half.cos() - rest * half.sin()
    safe = torch.where(x == 0, 1.0, x)
    sinc = torch.where(x == 0, 1.0, 2 * sin_half * cos_half / safe)
    cosc1 = torch.where(x == 0, 0.5, 2 * (sin_half / safe) ** 2)
    near = x.abs() < 1
    square, far = torch.where(near, x * x, 0.0), torch.where(near, 1.0, x * x)
    sinc2 = torch.where(near, _alternating_series(square, 3), (1 - sinc) / far)
    cosc3 = torch.where(near, _alternating_series(square, 4), (0.5 - cosc1) / far)
    return Phases(x, sinc, x * cosc1, sinc2, cosc1, cosc3)


def bounded_rate(rate: Tensor, time: Tensor) -> Tensor:
    """The rate [N], limited to 1/|t| before t = 0 (see the module); unchanged from t = 0 on."""
    limit = torch.where(time < 0, BACKWARD_TIME_CONSTANTS / time.abs().clamp_min(1e-300), math.inf)
    return torch.minimum(rate, limit.to(rate))


def harmonic_response(rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Responses of dT/dt = -a T + u to u = sin ωt and to u = cos ωt from rest, each [N, K]; differentiable in the rate.

    **Convention:** the results have the unit of time. Exact limits: a = 0 gives (1 - cos ωt)/ω and sin ωt / ω, ω = 0
    gives 0 and (1 - e^{-at})/a, both 0 gives 0 and t, and t = 0 gives 0 and 0.

    Args:
        rate: [N] a in 1/s, finite and at least 0, float32 or float64 (also the type of the results).
        omega: [K] ω in rad/s, float64, a constant.
        time: [] seconds, float64, a constant.

    Raises:
        ValueError: omega or time is not float64 (float32 phases are wrong by whole turns), or needs a gradient.
    """
    for name, constant in (("omega", omega), ("time", time)):
        if constant.dtype != torch.float64:
            raise ValueError(f"{name} must be float64, got {constant.dtype}: phases ωt lose their turns in less")
        if constant.requires_grad:
            raise ValueError(f"{name} is a constant of harmonic_response and cannot have a gradient; detach it")
    return _HarmonicResponse.apply(bounded_rate(rate, time), omega, time)


def temperature(
    time: Tensor, ambient: Tensor, initial: Tensor, rate: Tensor, omega: Tensor, sin_gain: Tensor, cos_gain: Tensor
) -> Tensor:
    """Temperature at a time, [N]; differentiable in ambient, initial, rate and gains (ETGS Eq. 8 in rate form).

    **Convention:** dT/dt = -rate (T - ambient) + Σ_k sin_gain_k sin ω_k t + cos_gain_k cos ω_k t with T(0) = initial.
    Any unit of temperature; gains in that unit per second. They are A/C and B/C of the paper, not A and B.

    Args:
        time: [] float64 seconds since T = initial.
        ambient: [] or [N].
        initial: [N].
        rate: [N] h/C in 1/s, at least 0.
        omega: [K] float64 rad/s; K = 0 is pure relaxation.
        sin_gain, cos_gain: [N, K].
    """
    relaxed = relax(time, ambient, initial, rate)
    if omega.numel() == 0:
        return relaxed
    sine, cosine = harmonic_response(rate, omega, time)
    return relaxed + (sin_gain * sine + cos_gain * cosine).sum(1)


def relax(time: Tensor, ambient: Tensor, initial: Tensor, rate: Tensor) -> Tensor:
    """Temperature of bodies without a source, [N]: first initial, in the end ambient. Arguments as ``temperature``."""
    y = bounded_rate(rate, time) * time.to(rate)
    # Each side from its own end, so that t = 0 returns the initial temperature exactly and t = ∞ the ambient.
    early, late = initial - (initial - ambient) * -torch.expm1(-y), ambient + (initial - ambient) * torch.exp(-y)
    return torch.where(y < math.log(2), early, late)


class _Decay(NamedTuple):
    """Functions of y = at for the Gaussians [N, 1]; the ones with θ and of order 2 hold where ``small``, y < 1."""

    y: Tensor
    small: Tensor
    phi: Tensor  # (1 - e^{-y})/y
    chi: Tensor  # (1 - (1 + y) e^{-y})/y², minus the derivative of φ
    theta: Tensor  # (1 - φ)/y
    theta2: Tensor  # (1/2 - θ)/y
    chi2: Tensor  # (1/2 - χ)/y


def _decay(y: Tensor) -> _Decay:
    small = y < 1
    near, far = torch.where(small, y, 0.0), torch.where(small, 1.0, y)
    theta2 = _exponential_series(near)
    theta = 0.5 - near * theta2
    phi = 1 - near * theta
    phi_far = -torch.expm1(-far) / far
    chi_far = (phi_far - torch.exp(-far)) / far
    return _Decay(
        y,
        small,
        torch.where(small, phi, phi_far),
        torch.where(small, phi - theta, chi_far),
        theta,
        theta2,
        0.5 - (1 + near) * theta2,
    )


class _HarmonicResponse(torch.autograd.Function):
    """K(t) and its derivative by the rate, each in the form that loses no digits (the module says how)."""

    @staticmethod
    def forward(ctx, rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(rate, omega, time)
        t = time.to(rate)
        decay, phase = _decay((rate * t)[:, None]), Phases(*(f.to(rate) for f in phases(omega, time)))
        q, o, p, _ = _weights(phase.x, decay.y)
        near = decay.y * decay.theta - phase.x * phase.x * phase.sinc2
        difference = torch.where(decay.small, near, phase.sinc - decay.phi)
        return t * (p * difference + o * phase.cosc), t * (q * decay.phi + o * phase.sinc - p * phase.cosc)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_sine: Tensor, grad_cosine: Tensor) -> tuple[Tensor, None, None]:
        rate, omega, time = ctx.saved_tensors
        sine, cosine = response_slope(rate, omega, time)
        return (grad_sine * sine + grad_cosine * cosine).sum(1), None, None


def response_slope(rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of both harmonic responses by the rate, each [N, K]; arguments as ``harmonic_response``.

    From dK/da = (t e^{-at} - K)/(a + iω). As it stands it serves y >= 1; below, both terms of the difference are near
    t, and expanding them leaves only differences from one and one half, which are taken by series.
    """
    t = time.to(rate)
    decay, phase = _decay((rate * t)[:, None]), Phases(*(f.to(rate) for f in phases(omega, time)))
    x, y = phase.x, decay.y
    q, o, p, length = _weights(x, y)
    cosine_near = -q * decay.chi + 2 * o * (y * o * phase.sinc2 - q * decay.theta) + (q - o) * o * phase.cosc1
    sine_near = x * (-q * decay.chi2 + (q - o) * (q * decay.theta2 + o * phase.sinc2) + 2 * o * o * y * phase.cosc3)
    difference = phase.sinc - decay.phi
    sine, fall = p * difference + o * phase.cosc, torch.exp(-y) - (q * decay.phi + o * phase.sinc - p * phase.cosc)
    x, y = x / length, y / length
    sine_far, cosine_far = -(y * sine + x * fall) / length, (y * fall - x * sine) / length
    square = t * t
    return (
        square * torch.where(decay.small, sine_near, sine_far),
        square * torch.where(decay.small, cosine_near, cosine_far),
    )


def _weights(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q = y²/D, o = x²/D, p = xy/D and √D with D = x² + y², each [N, K]; at x = y = 0 q = 0, o = 1, √D = 1."""
    largest = torch.maximum(x.abs(), y.abs())  # divided out first: the squares of tiny rates underflow
    origin = largest == 0
    largest = torch.where(origin, 1.0, largest)
    x, y = torch.where(origin, 1.0, x / largest), y / largest
    squares = x * x + y * y
    return y * y / squares, x * x / squares, x * y / squares, largest * squares.sqrt()


def _exponential_series(y: Tensor) -> Tensor:
    """Σ_j (-y)^j / (j + 3)! for |y| <= 1."""
    total = torch.zeros_like(y)
    for j in reversed(range(_TERMS)):
        total = 1 / math.factorial(j + 3) - y * total
    return total


def _alternating_series(square: Tensor, first: int) -> Tensor:
    """Σ_j (-square)^j / (first + 2 j)! for square <= 1."""
    total = torch.zeros_like(square)
    for j in reversed(range(_TERMS // 2)):
        total = 1 / math.factorial(first + 2 * j) - square * total
    return total


def _exact_product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The float64 product and its rounding error (Dekker 1971), so that their sum is a · b to 106 bits."""
    product = a * b
    a_high = a * _SPLIT - (a * _SPLIT - a)
    b_high = b * _SPLIT - (b * _SPLIT - b)
    a_low, b_low = a - a_high, b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
