"""Planck's law within a band, and the temperature behind a radiance (physics.planck)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from benchmarks.stability.case import Case, log_uniform
from heatsplat.physics.planck import FIRST_RADIATION, SECOND_RADIATION, Band

COUNT, SEEN = 60, 8
WIDTH = 2.0  # of a drawn band: its longest wavelength over its shortest
SLIGHT = 1e-30  # W/(m² sr), which float32 holds with all digits
NEGLIGIBLE = 1e-125  # of a sum


def _bodies() -> dict[str, Tensor]:
    return {
        "temperature": log_uniform("black body", 1.0, 1e4, COUNT),
        "wavelength": log_uniform("wavelength", 1.0, 1000.0, COUNT),
    }


def _bands(wavelength: Tensor) -> list[Band]:
    return [Band(x, WIDTH * x) for x in wavelength.tolist()]


def _sent_ours(temperature: Tensor, wavelength: Tensor) -> Tensor:
    return torch.stack([band.radiance(t) for band, t in zip(_bands(wavelength), temperature, strict=True)])


def _sent_printed(temperature: Tensor, wavelength: Tensor) -> Tensor:
    """At the product's own nodes, so that nothing but the form differs."""
    sums = []
    for band, t in zip(_bands(wavelength), temperature, strict=True):
        wavenumbers, weights = (x.to(t) for x in band.rule)
        sums.append((weights / (torch.exp(SECOND_RADIATION * wavenumbers / t) - 1)).sum())
    return torch.stack(sums)


@lru_cache
def _bernoulli(n: int):
    import mpmath

    return mpmath.bernoulli(n) / (mpmath.factorial(n) * (n + 3))


def _head(x):
    """∫_0^x u³/(e^u - 1) du for x below 2 π."""
    power, square = x**3, x * x
    total, n = power * (_bernoulli(0) + x * _bernoulli(1)), 2
    while abs(term := _bernoulli(n) * (power := power * square)) > NEGLIGIBLE * total:
        total, n = total + term, n + 2
    return total


def _tail(x):
    """∫_x^∞ u³/(e^u - 1) du."""
    import mpmath

    first = power = mpmath.exp(-x)
    total, n, cube = mpmath.mpf(0), 1, x**3
    while (term := power * (cube + (3 * x * x + (6 * x + mpmath.mpf(6) / n) / n) / n) / n) > NEGLIGIBLE * total:
        total, power, n = total + term, power * first, n + 1
    return total


def _exponents(temperature, short_um, long_um) -> tuple:
    """h c/(λ k T) at the long and the short end of a band."""
    import mpmath

    return tuple(mpmath.mpf(SECOND_RADIATION) * 10**6 / (end * temperature) for end in (long_um, short_um))


def _sent_exact(temperature, short_um, long_um):
    """By series, of Bernoulli numbers for warm bodies and of tails for cold ones."""
    import mpmath

    low, high = _exponents(temperature, short_um, long_um)
    integral = _head(high) - _head(low) if high < 3 else _tail(low) - _tail(high)
    return mpmath.mpf(FIRST_RADIATION) * (temperature / mpmath.mpf(SECOND_RADIATION)) ** 4 * integral


def _radiances() -> dict[str, Tensor]:
    return {"radiance": Band().radiance(log_uniform("seen", 12.0, 9900.0, SEEN)).float().double()}


def _seen_printed(radiance: Tensor) -> Tensor:
    """Planck's law at the middle of the band, solved for the temperature."""
    short, long = Band().shortest_um * 1e-6, Band().longest_um * 1e-6
    middle = 0.5 * (short + long)
    return SECOND_RADIATION / middle / torch.log(1 + FIRST_RADIATION / middle**5 * (long - short) / radiance)


def _seen_exact(radiance):
    import mpmath

    band = Band()
    ends = mpmath.mpf(band.shortest_um), mpmath.mpf(band.longest_um)
    found = mpmath.mpf(band.temperature(torch.tensor(float(radiance), dtype=torch.float64)).item())
    step = found
    while abs(step) > 1e-70 * found:  # Newton's steps, each of which doubles the digits
        sent, (low, high) = _sent_exact(found, *ends), _exponents(found, *ends)
        front = mpmath.mpf(FIRST_RADIATION) * (found / mpmath.mpf(SECOND_RADIATION)) ** 4
        slope = (4 * sent + front * (low**4 / mpmath.expm1(low) - high**4 / mpmath.expm1(high))) / found
        step = (sent - radiance) / slope
        found -= step
    return (found,)


CASES = (
    Case(
        "Band radiance of a black body",
        "1 .. 10 000 K, bands from 1 .. 1000 µm to twice that; slope by the temperature",
        "1/(e^{hc/λkT} - 1)",
        "itself + 1e-30 W/(m² sr)",
        _bodies, _sent_printed, _sent_ours,
        lambda temperature, wavelength: (_sent_exact(temperature, wavelength, WIDTH * wavelength),),
        by="temperature", constants=("wavelength",), promise=150.0,
        scale=lambda exact: exact[0] + SLIGHT, slope_scale=lambda exact, slopes: slopes[0] + SLIGHT,
    ),
    Case(
        "Temperature of a black body from its radiance within 7.5 to 14 µm",
        "radiance of 12 .. 9900 K; slope by the radiance",
        "Planck's law at the middle of the band",
        "itself",
        _radiances, _seen_printed, lambda radiance: Band().temperature(radiance), _seen_exact,
        by="radiance", promise=40.0,
    ),
)  # fmt: skip
