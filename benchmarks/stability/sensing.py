"""What a camera does to an image, and what lies between it and the scene (sensors, thermal.imaging_field)."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace

import torch
from torch import Tensor, nn

from benchmarks.stability.case import Case, log_uniform, uniform
from heatsplat.sensors.agc import EPSILON, GainControl
from heatsplat.thermal.atmospheric_field import octaves
from heatsplat.thermal.base import Query
from heatsplat.thermal.imaging_field import ImagingField
from heatsplat.thermal.static import Static

COUNT = 200
STRETCH, SHIFT = 1.75, -0.5
OCTAVE = 9


def _brightness() -> dict[str, Tensor]:
    near = log_uniform("dark", 1e-8, 0.5, COUNT)
    edges = torch.tensor([0.0, 1.0, -0.1, 1.1], dtype=torch.float64)
    return {"image": torch.cat([near, 1 - near, edges]).float().double()}


def _control(like: Tensor) -> GainControl:
    """Gain control of two images whose settings are opposite."""
    control = GainControl(stretch_max=2.0, shift_max=1.0)
    control.frame_ids = torch.tensor([0, 1])
    own = torch.tensor([math.log(STRETCH) / math.log(2.0), SHIFT], dtype=torch.float64).atanh()
    control.raw = nn.Parameter(torch.stack([own, -own]))
    control.bounds = control.bounds.new_tensor([math.log(2.0), 1.0], dtype=torch.float64)
    return control.to(like.dtype)


def _controlled_ours(image: Tensor) -> Tensor:
    return _control(image)(image[:, None, None], SimpleNamespace(frame_id=0))[:, 0, 0]


def _controlled_printed(image: Tensor) -> Tensor:
    return torch.sigmoid(STRETCH * torch.logit(image) + SHIFT)


def _controlled_exact(image):
    import mpmath

    def sigmoid(x):
        return 1 / (1 + mpmath.exp(-x))

    epsilon = mpmath.mpf(EPSILON)
    kept = min(max(image, epsilon), 1 - epsilon)
    logit = mpmath.log(kept / (1 - kept))
    return (image + sigmoid(STRETCH * logit + SHIFT) - kept,)


def _attenuated_ours(positive: bool, absorption: Tensor, distance: Tensor) -> Tensor:
    """What a field lets through whose network says the same everywhere."""
    field = ImagingField(Static(), exponent="positive" if positive else "printed", time="none").to(absorption.dtype)
    factors, nothing = [], torch.zeros_like(absorption[0])
    for a, d in zip(absorption, distance, strict=True):
        del field.head.bias  # a plain tensor takes the place of the parameter
        field.head.bias = torch.stack([a, nothing, d, nothing])
        factors.append(field.factor(torch.zeros(1, 3).to(a), Query())[0])
    return torch.stack(factors)


def _attenuated_exact(absorption, distance):
    import mpmath

    return (mpmath.exp(-4 * mpmath.tanh(absorption * distance / 4)),)


def _octave_exact(position):
    import mpmath

    return mpmath.sinpi(2**OCTAVE * position), mpmath.cospi(2**OCTAVE * position)


CASES = (
    Case(
        "Gain control of black, white and values beyond",
        "image 0, 1e-8 .. 1 - 6e-8, 1, -0.1, 1.1; s = 1.75, t = -0.5; slope by the image",
        "sigmoid(s logit I + t) (SupIR-GS Eq. 5)",
        "1",
        _brightness, _controlled_printed, _controlled_ours, _controlled_exact,
        by="image", scale=lambda exact: 1, slope_scale=lambda exact, slopes: 1, promise=12_000.0,
    ),
    Case(
        "A field with exploding exponents",
        "absorption 0.001 .. 1, distance -1e4 .. 1e4; slope by distance",
        "e^{-(μa + μs) d} (TI-3DGS Eq. 9)",
        "e⁴",
        lambda: {"absorption": log_uniform("mu", 1e-3, 1.0, COUNT), "distance": uniform("d", -1e4, 1e4, COUNT)},
        lambda absorption, distance: torch.exp(-absorption * distance),
        partial(_attenuated_ours, False), _attenuated_exact,
        by="distance", scale=lambda exact: math.e**4, slope_scale=lambda exact, slopes: math.e**4, promise=8.0,
    ),
    Case(
        "The finest octave of an encoded position",
        "p -0.9 .. 0.9, octave 2⁹; slope by p",
        "sin(2^k π p) (TI-3DGS Eq. 11)",
        "1; slope: 2⁹ π",
        lambda: {"position": uniform("p", -0.9, 0.9, COUNT)},
        lambda position: (torch.sin(2**OCTAVE * math.pi * position), torch.cos(2**OCTAVE * math.pi * position)),
        lambda position: tuple(octaves(position[:, None], OCTAVE + 1)[:, [OCTAVE, -1]].unbind(1)),
        _octave_exact,
        by="position", scale=lambda exact: 1, slope_scale=lambda exact, slopes: 2**OCTAVE * math.pi, promise=4.0,
    ),
)  # fmt: skip
