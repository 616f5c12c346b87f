"""Balances of heat: radiation, areas over volumes, and bodies that are much faster or slower than the weather's samples."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.stability.case import Case, log_uniform, uniform
from heatsplat.physics.ellipsoids import THOMSEN_POWER, projected_area_ratio, radiating_area_ratio
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.heat_flow import fourth_powers
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.responses import step_weights
from heatsplat.physics.surfaces import Drivers, Surface, power_excess

COUNT = 200
REFERENCE_K = 288.0
STIFF = 60  # bodies that are integrated in steps
AIR = (0.0, 20.0, -10.0, 5.0, 30.0, -20.0, 0.0, 10.0, -5.0)  # K above the reference at the samples
START = 25.0
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _powers() -> dict[str, Tensor]:
    cold = uniform("cold", 200.0, 400.0, COUNT)
    return {"warm": (cold + log_uniform("excess", 3e-5, 100.0, COUNT)).float().double(), "cold": cold}


def _fourth_powers(warm: Tensor, cold: Tensor) -> Tensor:
    return fourth_powers(warm, cold)


def _ellipsoid() -> dict[str, Tensor]:
    return {axis: log_uniform(f"axis {axis}", 1e-8, 1e3, COUNT) for axis in "abc"}


SUN = (0.6, 0.48, 0.64)  # direction, a unit vector


def _areas_ours(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    axes = torch.stack([a, b, c], 1)
    return radiating_area_ratio(axes), projected_area_ratio(axes, torch.tensor(SUN, dtype=a.dtype))


def _areas_printed(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    p, (x, y, z) = THOMSEN_POWER, SUN
    volume = 4 / 3 * math.pi * a * b * c
    surface = 4 * math.pi * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p)
    shadow = math.pi * ((b * c * x) ** 2 + (a * c * y) ** 2 + (a * b * z) ** 2).sqrt()
    return surface / volume, shadow / volume


def _areas_exact(a, b, c):
    import mpmath

    p, (x, y, z) = mpmath.mpf(THOMSEN_POWER), SUN
    surface = 3 * (((a * b) ** p + (a * c) ** p + (b * c) ** p) / 3) ** (1 / p) / (a * b * c)
    return surface, mpmath.mpf(3) / 4 * mpmath.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)


def _weights_printed(y: Tensor) -> tuple[Tensor, Tensor]:
    decay = torch.exp(-y)
    phi = (1 - decay) / y
    return phi - decay, 1 - phi


def _weights_exact(y):
    import mpmath

    decay = mpmath.exp(-y)
    phi = (1 - decay) / y
    return phi - decay, 1 - phi


def _bodies() -> dict[str, Tensor]:
    return {"rate": log_uniform("stiffness", 1e-9, 1e4, STIFF), "step": log_uniform("step", 0.01, 3600.0, STIFF)}


def _stepped_ours(rate: Tensor, step: Tensor) -> Tensor:
    found = []
    for r, seconds in zip(rate, step.tolist(), strict=True):
        times = seconds * torch.arange(len(AIR), dtype=torch.float64)
        climate = Climate(Drivers(times, REFERENCE_K, torch.tensor(AIR, dtype=torch.float64), up=UP))
        # In the dark; with what the linear balance of the study of work and precision has, whose kernel this is.
        surface = Surface(
            torch.full_like(r[None], START), r[None].log(), torch.zeros_like(r[None]), normals=UP.to(r)[None]
        )
        found.append(stepped_temperature(climate, surface, float(times[-1]))[0])
    return torch.stack(found)


def _stepped_printed(rate: Tensor, step: Tensor) -> Tensor:
    """Euler's explicit steps from sample to sample."""
    x = torch.full_like(rate, START)
    for air in AIR[:-1]:
        x = x + step * rate * (air - x)
    return x


def _stepped_exact(rate, step):
    import mpmath

    y, x = rate * step, mpmath.mpf(START)
    decay = mpmath.exp(-y)
    phi = (1 - decay) / y
    for air, after in zip(AIR[:-1], AIR[1:], strict=True):
        x = decay * x + (phi - decay) * air + (1 - phi) * after
    return (x,)


CASES = (
    Case(
        "Radiation between two almost equal temperatures",
        "200 .. 500 K, difference 3e-5 .. 100 K; slope by the warmer",
        "T⁴ - S⁴",
        "itself",
        _powers, lambda warm, cold: warm**4 - cold**4, _fourth_powers, lambda warm, cold: (warm**4 - cold**4,),
        by="warm", promise=6.0,
    ),
    Case(
        "Radiation of a surface near the reference temperature",
        "1e-9 .. 100 K above 288 K; slope by the excess",
        "((R + x)⁴ - R⁴)/(4 R³)",
        "itself",
        lambda: {"excess": log_uniform("above", 1e-9, 100.0, COUNT)},
        lambda excess: ((REFERENCE_K + excess) ** 4 - REFERENCE_K**4) / (4 * REFERENCE_K**3),
        lambda excess: power_excess(excess, REFERENCE_K),
        lambda excess: (((REFERENCE_K + excess) ** 4 - int(REFERENCE_K) ** 4) / (4 * int(REFERENCE_K) ** 3),),
        by="excess", promise=6.0,
    ),
    Case(
        "Areas of an ellipsoid over its volume",
        "semi-axes 1e-8 .. 1000 m; surface and shadow; slope by the first axis",
        "A and V apart (ThermoGS Eq. 6-9)",
        "their sum",
        _ellipsoid, _areas_printed, _areas_ours, _areas_exact, by="a", promise=12.0,
    ),
    Case(
        "Weights of the samples before and after a step",
        "a Δt 1e-13 .. 1e7",
        "φ = (1 - e^{-y})/y",
        "1",
        lambda: {"y": log_uniform("y", 1e-13, 1e7, COUNT)},
        _weights_printed, lambda y: step_weights(y, 1.0)[1:], _weights_exact,
        scale=lambda exact: 1, promise=4.0,
    ),
    Case(
        "Eight steps through weather that jumps by 50 K",
        "rate 1e-9 .. 1e4 1/s, steps of 0.01 s .. 1 h",
        "explicit Euler",
        "50 K",
        _bodies, _stepped_printed, _stepped_ours, _stepped_exact,
        constants=("step",), scale=lambda exact: 50, promise=20.0, types=("float32",),
    ),
)  # fmt: skip
