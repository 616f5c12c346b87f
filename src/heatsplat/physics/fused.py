"""Temperatures of the Gaussians in view: the closed form of relaxation.py for rows of per-Gaussian tensors.

On a CPU it runs in a fused kernel (heatsplat.kernels.relaxation), elsewhere in plain torch.
"""

from __future__ import annotations

import math
import sys

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from heatsplat.kernels import relaxation as kernels
from heatsplat.kernels.simd import LANES
from heatsplat.physics.relaxation import BACKWARD_TIME_CONSTANTS, harmonic_response, relax

SMALLEST_OMEGA = 1e-15  # below it the kernel's a² + ω² could vanish in float32
CACHE_LINE = 64  # bytes; rows of gains are read by whole lines
NUMPY_TYPES = {torch.float32: np.float32, torch.float64: np.float64}


def visible_temperature(
    time: Tensor,
    ambient: Tensor,
    initial: Tensor,
    rate: Tensor,
    omega: Tensor,
    gains: Tensor | None = None,
    inverse_capacity: Tensor | None = None,
    ids: Tensor | None = None,
    places: Tensor | None = None,
) -> Tensor:
    """Temperature at a time of the Gaussians ``ids``, [n]; only their rows are read.

    Not every Gaussian needs a source: with ``places``, those without a row of gains relax, and cost no more than that.

    **Convention:** units as in ``relaxation.temperature``.

    Args:
        time: [] float64.
        ambient: [].
        initial, rate: [N].
        omega: [K] float64.
        gains: [M, 2, K] strengths of the sources sin ωt and cos ωt, one row of memory per Gaussian; None is no source.
        inverse_capacity: [N] multiplies the sources of a Gaussian; None is 1.
        ids: [n] int64 Gaussians, each at most once; None is all of them.
        places: [N] int64, the row of ``gains`` of every Gaussian, in their order, -1 for one that has no source; None is
            M = N, a row each.

    Raises:
        ValueError: the shape of the gains or of the places does not fit.
    """
    count = rate.shape[0]
    if gains is not None:
        rows = gains.shape[0] if places is not None else count
        if gains.shape != (rows, 2, omega.shape[0]):
            raise ValueError(f"gains must have shape {[rows, 2, omega.shape[0]]}, got {list(gains.shape)}")
        if places is not None and (places.shape != (count,) or places.dtype != torch.int64):
            raise ValueError(f"places must be int64 of shape {[count]}, got {places.dtype} of {list(places.shape)}")
        if places is not None and rows == 0:
            gains = places = inverse_capacity = None
        elif rows == count:  # in the order of the Gaussians: each has its own
            places = None
    arguments = (time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places)
    if _fits_kernel(rate, omega):
        return _VisibleTemperature.apply(*arguments)
    return _reference(*arguments)


def _fits_kernel(rate: Tensor, omega: Tensor) -> bool:
    """Whether the kernel can be used: on a CPU, and no ω of (almost) zero."""
    if rate.device.type != "cpu" or rate.dtype not in NUMPY_TYPES:
        return False
    return omega.numel() == 0 or omega.abs().min().item() >= SMALLEST_OMEGA


def _reference(time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places) -> Tensor:
    """The plain form and the oracle of the kernel."""

    def rows(tensor: Tensor | None, ids: Tensor | None) -> Tensor | None:
        return tensor if tensor is None or ids is None else tensor.index_select(0, ids)

    initial, rate, scale, places = (rows(x, ids) for x in (initial, rate, inverse_capacity, places))
    if gains is None:
        return relax(time, ambient, initial, rate)
    if places is None:
        return relax(time, ambient, initial, rate) + _heat(time, rate, omega, rows(gains, ids), scale)
    heated = (places >= 0).nonzero().squeeze(1)
    heat = _heat(time, rows(rate, heated), omega, rows(gains, rows(places, heated)), rows(scale, heated))
    return relax(time, ambient, initial, rate).index_add(0, heated, heat)


def _heat(time: Tensor, rate: Tensor, omega: Tensor, gains: Tensor, scale: Tensor | None) -> Tensor:
    """What the sources add to the temperature, [n]."""
    sine, cosine = harmonic_response(rate, omega, time)
    heat = (gains[:, 0] * sine + gains[:, 1] * cosine).sum(1)
    return heat if scale is None else heat * scale


class _SpareMemory:
    """Memory of one tensor, lent again once nothing uses it any more.

    A new tensor of this size (20 MB for 100,000 Gaussians) comes as untouched pages, whose first touch costs more than
    the kernel that fills them.
    """

    def __init__(self, dtype: type) -> None:
        self._array = np.empty(0, dtype)
        self._references_unused = self._references()

    def _references(self) -> int:
        # A tensor made of an array keeps one reference to it for as long as anything shares its storage.
        return sys.getrefcount(self._array)

    def take(self, shape: torch.Size) -> Tensor:
        """A tensor of that shape with undefined values."""
        if self._array.shape != tuple(shape) or self._references() > self._references_unused:
            line = CACHE_LINE // self._array.itemsize
            memory = np.empty(shape.numel() + line, self._array.dtype)
            start = -(memory.ctypes.data // memory.itemsize) % line
            self._array = memory[start : start + shape.numel()].reshape(tuple(shape))
        return torch.from_numpy(self._array)


_gain_gradients = {dtype: _SpareMemory(plain) for dtype, plain in NUMPY_TYPES.items()}


class _VisibleTemperature(torch.autograd.Function):
    """The kernel. Gradients have all rows, zero in those out of view: that is what the optimiser reads."""

    @staticmethod
    def forward(ctx, time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places) -> Tensor:
        count = rate.shape[0]
        ids = torch.arange(count) if ids is None else ids
        gains = rate.new_empty(count, 2, 0) if gains is None else gains
        scale = rate.new_empty(0) if inverse_capacity is None else inverse_capacity
        places = ids.new_empty(0) if places is None else places
        tensors = tuple(x.contiguous() for x in (rate, initial, gains, places, scale, ids))
        ctx.save_for_backward(*tensors)
        seconds, frequencies = time.item(), gains.shape[2]
        limit = BACKWARD_TIME_CONSTANTS / -seconds if seconds < 0 else math.inf
        kind = NUMPY_TYPES[rate.dtype]
        ctx.table = np.empty((kernels.TABLE_ROWS, -(-frequencies // LANES) * LANES), kind)
        ctx.numbers = kind(ambient.item()), kind(seconds), kind(limit)
        values = rate.new_empty(ids.shape[0])
        with kernels.threads_for(ids.shape[0]):
            kernels.fill_table(omega.numpy()[:frequencies], seconds, ctx.table)
            kernels.forward(*_kernel_arguments(ctx, tensors), values.numpy())
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, v_values: Tensor):
        tensors = ctx.saved_tensors
        rate, initial, gains, places, scale, ids = tensors
        v_rate, v_initial, v_scale = (torch.zeros_like(x) for x in (rate, initial, scale))
        v_gains = _gain_gradients[rate.dtype].take(gains.shape)
        v_ambient = rate.new_empty(-(-ids.shape[0] // kernels.BLOCK))
        outputs = (v_rate, v_initial, v_ambient, v_gains, v_scale)
        with kernels.threads_for(ids.shape[0]):
            rows = ids
            if places.shape[0] > 0 and ids.shape[0] < rate.shape[0]:
                rows = places[ids]
                rows = rows[rows >= 0]
            # Clearing all of it would double the memory traffic.
            if gains.numel() > 0 and rows.shape[0] < gains.shape[0]:
                kernels.clear_others(rows.numpy(), np.empty(gains.shape[0], np.bool_), v_gains.numpy())
            gradient = v_values.contiguous().numpy()
            kernels.backward(*_kernel_arguments(ctx, tensors), gradient, *(x.numpy() for x in outputs))
        v_ambient = v_ambient.sum() if ctx.needs_input_grad[1] else None
        v_gains = v_gains if ctx.needs_input_grad[5] else None
        v_scale = v_scale if ctx.needs_input_grad[6] else None
        return None, v_ambient, v_initial, v_rate, None, v_gains, v_scale, None, None


def _kernel_arguments(ctx, tensors: tuple[Tensor, ...]) -> tuple:
    """What both kernels take first, in their order."""
    rate, initial, gains, places, scale, ids = (x.detach().numpy() for x in tensors)
    ambient, time, limit = ctx.numbers
    return rate, initial, ambient, gains, places, scale, ids, time, limit, ctx.table
