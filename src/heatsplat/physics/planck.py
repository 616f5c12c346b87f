"""What a black body sends within a band of wavelengths, and the temperature behind it: Planck's law and its inverse."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable

FIRST_RADIATION = 1.191042972397188e-16  # W m²/sr, 2 h c²
SECOND_RADIATION = 0.014387768775039337  # m K, h c/k
TEMPERATURES_K = (1.0, 1e4)
ENTRIES = 8192  # of the table of the inverse: its error, 1e-14 of a temperature, falls with their fourth power
BLOCK = 1 << 16  # numbers at once, temperatures times nodes: an image's would not fit in the cache


@dataclass(frozen=True)
class Band:
    """A band of wavelengths in which a camera sees.

    The integral is Gauss and Legendre's in the wavenumber ν = 1/λ: with x = h c ν/(k T) it is one of
    2 h c² ν³ e^{-x}/(1 - e^{-x}), whose parts are positive and neither overflow nor cancel. 1 - e^{-x} is -expm1(-x), and
    where e^{-x} underflows, value and slope are 0. Inside is float64, as e^{-x} multiplies an error of x by x.

    **Convention:** kelvin and W/(m² sr). Temperatures outside 1 .. 10 000 K count as the nearest of the two.

    Args:
        shortest_um, longest_um: ends of the band in micrometres.
        nodes: of the integral. 64 keep all digits from 1 K on in the default band, 12 from 150 K on.

    Raises:
        ValueError: the band is empty, or there are no nodes.
    """

    shortest_um: float = 7.5
    longest_um: float = 14.0
    nodes: int = 64

    def __post_init__(self) -> None:
        if not 0 < self.shortest_um < self.longest_um < math.inf or self.nodes < 1:
            raise ValueError(
                "a band needs two rising positive wavelengths and at least 1 node, got "
                f"{self.shortest_um} .. {self.longest_um} µm and {self.nodes}"
            )

    def radiance(self, temperature_k: Tensor) -> Tensor:
        """Radiance of black bodies in W/(m² sr), of any shape and of the temperatures' type."""
        return _Radiance.apply(temperature_k, self)

    def temperature(self, radiance: Tensor) -> Tensor:
        """Temperatures in kelvin of black bodies of a radiance; its slope is one over that of ``radiance``.

        Less than the least that the type holds counts as that, and more than 10 000 K send counts as 10 000 K; there the
        slope is 0.
        """
        return _Temperature.apply(radiance, self)

    def with_slope(self, temperature_k: Tensor) -> tuple[Tensor, Tensor]:
        """Radiance and its slope in W/(m² sr K) at float64 temperatures of 1 .. 10 000 K, without a gradient."""
        wavenumbers, weights = (x.to(temperature_k.device) for x in self.rule)
        x = (SECOND_RADIATION * wavenumbers) / temperature_k[..., None]
        decay = torch.exp(-x)
        sent = weights * decay / -torch.expm1(-x)  # at a node
        return sent.sum(-1), (sent * x / -torch.expm1(-x)).sum(-1) / temperature_k

    def _each_with_slope(self, temperature_k: Tensor) -> tuple[Tensor, Tensor]:
        """``with_slope`` in blocks: of an image's temperatures, those of all nodes would be some hundred megabytes."""
        if temperature_k.device.type != "cpu":
            return self.with_slope(temperature_k)
        sent, slope = (torch.empty_like(temperature_k, memory_format=torch.contiguous_format) for _ in range(2))
        parts = (x.reshape(-1).split(max(1, BLOCK // self.nodes)) for x in (temperature_k, sent, slope))
        for given, of_sent, of_slope in zip(*parts, strict=True):
            for place, values in zip((of_sent, of_slope), self.with_slope(given), strict=True):
                place.copy_(values)
        return sent, slope

    @cached_property
    def rule(self) -> tuple[Tensor, Tensor]:
        """Wavenumbers in 1/m and weights with 2 h c² ν³ in them, both [nodes] float64."""
        places, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(self.nodes))
        low, high = 1e6 / self.longest_um, 1e6 / self.shortest_um
        wavenumbers = 0.5 * (low + high) + 0.5 * (high - low) * places
        return wavenumbers, 0.5 * (high - low) * weights * FIRST_RADIATION * wavenumbers**3

    @cached_property
    def _table(self) -> tuple[Tensor, Tensor]:
        """Logarithms of radiances, rising, and of each two neighbours the cubic between them, [n] and [4, n - 1] float64.

        The cubics give one over the temperature, which is almost a straight line of the logarithm (Wien's law), at shares of the
        way; n is at most ENTRIES. Ends and slopes are right.
        """
        temperatures = torch.logspace(*(math.log10(t) for t in TEMPERATURES_K), ENTRIES, dtype=torch.float64)
        radiances, slopes = self._each_with_slope(temperatures)
        there = radiances > torch.finfo(torch.float64).tiny
        temperatures, radiances, slopes = temperatures[there], radiances[there], slopes[there]
        logarithms, inverses = radiances.log(), 1 / temperatures
        by_logarithm = -radiances / (slopes * temperatures.square())
        gap, rise = logarithms.diff(), inverses.diff()
        first, last = gap * by_logarithm[:-1], gap * by_logarithm[1:]
        cubics = torch.stack((inverses[:-1], first, 3 * rise - 2 * first - last, first + last - 2 * rise))
        return logarithms, cubics

    def _sought(self, radiance: Tensor) -> tuple[Tensor, Tensor]:
        """Temperatures of radiances, float64, and which of these were within what can be inverted."""
        logarithms, cubics = (x.to(radiance.device) for x in self._table)
        lowest = max(torch.finfo(radiance.dtype).tiny, math.exp(self._table[0][0].item()))
        kept = radiance.double().clamp(lowest, math.exp(self._table[0][-1].item()))
        at = kept.log()
        left = (torch.searchsorted(logarithms, at.contiguous()) - 1).clamp(0, cubics.shape[1] - 1)
        share = (at - logarithms[left]) / (logarithms[left + 1] - logarithms[left])
        inverse = cubics[3][left]
        for power in (2, 1, 0):
            inverse = inverse * share + cubics[power][left]
        return (1 / inverse).clamp(*TEMPERATURES_K), kept == radiance


class _WithSlope(torch.autograd.Function):
    """A function of one number whose slope was found on the way, which is all that the way back needs."""

    @staticmethod
    @once_differentiable
    def backward(ctx, v_value: Tensor):
        (slope,) = ctx.saved_tensors
        return v_value * slope, None


class _Radiance(_WithSlope):
    """The sum over nodes."""

    @staticmethod
    def forward(ctx, temperature_k: Tensor, band: Band) -> Tensor:
        given = temperature_k.detach().double()
        kept = given.clamp(*TEMPERATURES_K)
        sent, slope = band._each_with_slope(kept)
        ctx.save_for_backward(torch.where(kept == given, slope, 0.0).to(temperature_k))
        return sent.to(temperature_k)


class _Temperature(_WithSlope):
    """The inverse, whose slope is that of an implicit function."""

    @staticmethod
    def forward(ctx, radiance: Tensor, band: Band) -> Tensor:
        found, inside = band._sought(radiance.detach())
        if ctx.needs_input_grad[0]:
            _, slope = band._each_with_slope(found)
            ctx.save_for_backward(torch.where(inside, 1 / slope, 0.0).to(radiance))
        return found.to(radiance)
