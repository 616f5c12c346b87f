"""Exact values of the harmonic responses, from their definition in so many digits that no stable form is needed."""

import math

import mpmath
import torch

DIGITS = 200  # the definition divides differences by rates down to 1e-45, twice
# Ranges of the hard cases: rate 1/s, angular frequency rad/s, time s.
RANGES = ((1e-12, 1e4), (1e-5, 3e2), (1e-3, 1e5))


def exact(rate, omega, time):
    """Responses to sin and cos and their derivatives by the rate, four mpmath numbers; rate + i omega must not be 0."""
    with mpmath.workdps(DIGITS):
        rate, omega, time = mpmath.mpf(rate), mpmath.mpf(omega), mpmath.mpf(time)
        pole = mpmath.mpc(rate, omega)
        decay = mpmath.exp(-rate * time)
        response = (mpmath.expj(omega * time) - decay) / pole
        slope = (time * decay - response) / pole
        return response.imag, response.real, slope.imag, slope.real


def joint_error(values, references):
    """Larger error of a pair (sin, cos) over the sum of both exact magnitudes."""
    both = abs(references[0]) + abs(references[1])
    return max(float(abs(value - exact) / both) for value, exact in zip(values, references, strict=True))


def own_error(values, references, phase):
    """Larger error of a pair (sin, cos), each over its own exact magnitude.

    Past the first radian of ``phase`` a value below a hundredth of both is near a zero crossing, where rounding the
    rate alone changes it by more, and is left out.
    """
    smallest = (abs(references[0]) + abs(references[1])) / 100 if phase > 1 else 0
    pairs = zip(values, references, strict=True)
    return max(float(abs(value / exact - 1)) for value, exact in pairs if abs(exact) > smallest)


def draw(count, seed):
    """Log-uniform rates (values of float32), frequencies and times over RANGES, three float64 tensors [count]."""
    generator = torch.Generator().manual_seed(seed)
    rate, omega, time = (
        low * torch.exp(torch.rand(count, generator=generator, dtype=torch.float64) * math.log(high / low))
        for low, high in RANGES
    )
    return rate.float().double(), omega, time
