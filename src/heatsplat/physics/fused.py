"""Temperatures of the Gaussians in view: the closed form of relaxation.py for rows of per-Gaussian tensors.

On a CPU it runs in a fused kernel (heatsplat.kernels.relaxation), as it does in float32 on CUDA (heatsplat.kernels.gpu),
elsewhere in plain torch.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import gpu
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
    log_bounds: tuple[float, float] | None = None,
) -> Tensor:
    """Temperature at a time of the Gaussians ``ids``, [n]; only their rows are read.

    Not every Gaussian needs a source: with ``places``, those without a row of gains relax, and cost no more than that.

    **Convention:** units as in ``relaxation.temperature``.

    Args:
        time: [] float64, best on the CPU.
        ambient: [].
        initial, rate: [N].
        omega: [K] float64.
        gains: [M, 2, K] strengths of the sources sin ωt and cos ωt, one row of memory per Gaussian; None is no source.
        inverse_capacity: [N] multiplies the sources of a Gaussian; None is 1.
        ids: [n] int64 Gaussians, each at most once; None is all of them.
        places: [N] int64, the row of ``gains`` of every Gaussian, in their order, -1 for one that has no source; None is
            M = N, a row each.
        log_bounds: where given, ``rate`` holds logarithms of rates, which are taken within these bounds.

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
    if _fits_kernel(rate, omega):
        return _VisibleTemperature.apply(
            time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places, log_bounds
        )
    if rate.is_cuda and rate.dtype == torch.float32 and gpu.available():
        on_cpu = _on_cpu(omega)
        if _no_omega_vanishes(on_cpu):
            return _VisibleTemperatureOnCuda.apply(
                time, ambient, initial, rate, on_cpu, gains, inverse_capacity, ids, places, log_bounds
            )
    rate = rate if log_bounds is None else rate.clamp(*log_bounds).exp()
    return _reference(time.to(rate.device), ambient, initial, rate, omega, gains, inverse_capacity, ids, places)


def _fits_kernel(rate: Tensor, omega: Tensor) -> bool:
    """Whether the CPU's kernel can be used: on a CPU, and no ω of (almost) zero."""
    return rate.device.type == "cpu" and rate.dtype in NUMPY_TYPES and _no_omega_vanishes(omega)


def _on_cpu(omega: Tensor) -> Tensor:
    """A copy on the CPU, kept with a tensor until that changes: every step reads it, and would wait for the device."""
    kept = omega.__dict__.get("on_cpu")
    if kept is None or kept[0] != omega._version:
        kept = omega.on_cpu = omega._version, omega.cpu()
    return kept[1]


def _no_omega_vanishes(omega: Tensor) -> bool:
    return omega.numel() == 0 or np.abs(omega.numpy()).min() >= SMALLEST_OMEGA


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


class Unwritten:
    """A gradient of gains [M, 2, K] that nobody has written out: of each view and row, one number times its responses.

    A leaf that has one as its attribute ``unwritten`` gets its gradients there in place of ``grad``, those of several views
    one beside the other; so an optimiser asks for them that steps the gains with them (``step``). Everybody else finds in
    ``grad`` what ``written`` gives.
    """

    def __init__(self) -> None:
        self._views: list[tuple[Tensor, np.floating, np.ndarray]] = []

    def __len__(self) -> int:
        """Number of views."""
        return len(self._views)

    def add(self, rows: Tensor, time: np.floating, table: np.ndarray) -> None:
        """Adds a view: what ``kernels.backward`` left, at a time with its table of frequencies."""
        self._views.append((rows, time, table))

    def clear(self) -> None:
        """Forgets all views."""
        self._views = []

    def change_rows(self, change: Callable[[Tensor], Tensor]) -> None:
        """Follows gains whose rows come, go or are forgotten: ``change`` is given tensors [M, 2] of numbers of the rows."""
        self._views = [(change(rows.T).T.contiguous(), time, table) for rows, time, table in self._views]

    def written(self, shape: torch.Size) -> Tensor:
        """The gradient of all views, of the gains' ``shape``; zeros in rows out of view."""
        v_gains = _gain_gradients[self._views[0][0].dtype].take(shape)
        with kernels.threads_for(len(v_gains)):
            kernels.write_gains(*self._arrays(len(v_gains)), v_gains.numpy())
        return v_gains

    def step(
        self, gains: Tensor, first: Tensor, second: Tensor, decay: np.ndarray, rates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Adam's step of the gains in place; sums of what was written, and of its squares by column [.., K] (step_gains)."""
        blocks = -(-len(gains) // kernels.BLOCK)
        sums, squares = np.empty(blocks, np.float32), np.empty((blocks, gains.shape[2]), np.float32)
        tensors = [tensor.detach().numpy() for tensor in (gains, first, second)]
        with kernels.threads_for(len(gains)):
            kernels.step_gains(*self._arrays(len(gains)), *tensors, np.tile(decay, LANES), rates, sums, squares)
        return sums, squares

    def state_dict(self) -> dict[str, Tensor]:
        """The views as tensors, for a checkpoint; ``load_state_dict`` takes them back."""
        return {name: torch.from_numpy(array) for name, array in zip(_STATE, self._arrays(), strict=True)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Puts the views of a checkpoint in place of its own."""
        rows, times, tables = (state[name] for name in _STATE)
        self._views = list(zip(rows, times.numpy(), tables.numpy(), strict=True))

    def _arrays(self, count: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, times and tables of all views, as ``write_gains`` takes them; of ``count`` gains, or they are read beside."""
        rows, times, tables = zip(*self._views, strict=True)
        if count is not None and any(one.shape[1] != count for one in rows):
            raise RuntimeError(f"gradients that wait have {[one.shape[1] for one in rows]} rows, the gains {count}")
        if len(rows) == 1:
            return rows[0].numpy()[None], np.array(times), tables[0][None]
        return torch.stack(rows).numpy(), np.array(times), np.stack(tables)


_STATE = ("rows", "times", "tables")
_NO_SLOPES = {kind: np.empty((0, 0), kind) for kind in NUMPY_TYPES.values()}


class _VisibleTemperature(torch.autograd.Function):
    """The kernel. Gradients have all rows, zero in those out of view: that is what the optimiser reads."""

    @staticmethod
    def forward(ctx, time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places, log_bounds) -> Tensor:
        count = rate.shape[0]
        ids = torch.arange(count) if ids is None else ids
        gains = rate.new_empty(count, 2, 0) if gains is None else gains
        scale = rate.new_empty(0) if inverse_capacity is None else inverse_capacity
        places = ids.new_empty(0) if places is None else places
        seconds, frequencies = time.item(), gains.shape[2]
        limit = BACKWARD_TIME_CONSTANTS / -seconds if seconds < 0 else math.inf
        kind = NUMPY_TYPES[rate.dtype]
        table = np.empty((kernels.TABLE_ROWS, -(-frequencies // LANES) * LANES), kind)
        values = rate.new_empty(ids.shape[0])
        slopes = _NO_SLOPES[kind]
        if any(ctx.needs_input_grad):
            slopes = np.empty((kernels.SLOPES, len(ids)), kind)
            ctx.save_for_backward(initial, rate, gains, places, scale, ids)
            ctx.slopes, ctx.table, ctx.time = slopes, table, kind(seconds)
        bounds = np.array(() if log_bounds is None else log_bounds, kind)
        arrays = [x.detach().contiguous().numpy() for x in (rate, initial, gains, places, scale, ids)]
        rate, initial, gains, places, scale, ids = arrays
        with kernels.threads_for(len(ids)):
            kernels.fill_table(omega.numpy()[:frequencies], seconds, table)
            kernels.forward(
                rate, bounds, initial, kind(ambient.item()), gains, places, scale, ids, kind(seconds), kind(limit), table,
                values.numpy(), slopes,
            )  # fmt: skip
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, v_values: Tensor):
        initial, rate, gains, places, scale, ids = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        v_initial, v_rate, v_scale = (torch.zeros_like(x) for x in (initial, rate, scale))
        v_ambient = rate.new_empty(-(-ids.shape[0] // kernels.BLOCK))
        rows = rate.new_zeros(2, gains.shape[0] if wanted[5] and gains.numel() > 0 else 0)
        arrays = [x.detach().contiguous().numpy() for x in (ids, places, scale, v_values)]
        ids, places, scale, v_values = arrays
        outputs = [x.numpy() for x in (v_rate, v_initial, v_ambient, v_scale, rows)]
        with kernels.threads_for(len(ids)):
            kernels.backward(ids, places, scale, ctx.time, ctx.slopes, v_values, *outputs)
        v_gains = None
        if wanted[5]:
            v_gains = torch.zeros_like(gains) if gains.numel() == 0 else None
        if rows.numel() > 0:
            waiting = getattr(gains, "unwritten", None)
            unwritten = Unwritten() if waiting is None else waiting
            unwritten.add(rows, ctx.time, ctx.table)
            if waiting is None:
                v_gains = unwritten.written(gains.shape)
        v_ambient = v_ambient.sum() if wanted[1] else None
        v_scale = v_scale if wanted[6] else None
        return None, v_ambient, v_initial, v_rate, None, v_gains, v_scale, None, None, None


class _VisibleTemperatureOnCuda(torch.autograd.Function):
    """The same in two launches and a table of frequencies that is made on the CPU. Gradients have all rows here too."""

    @staticmethod
    def forward(ctx, time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places, log_bounds) -> Tensor:
        from heatsplat.kernels.gpu import relaxation as on_cuda  # here, for Triton is not everywhere

        count = rate.shape[0]
        ids = torch.arange(count, device=rate.device) if ids is None else ids
        seconds, frequencies = time.item(), 0 if gains is None else gains.shape[2]
        table = np.empty((kernels.TABLE_ROWS, max(frequencies, 1)), np.float32)
        kernels.fill_table(omega.numpy()[:frequencies], seconds, table)
        table = torch.from_numpy(table).to(rate.device, non_blocking=True)
        values, sloping = rate.new_empty(len(ids)), any(ctx.needs_input_grad)
        slopes = rate.new_empty(on_cuda.SLOPES, len(ids) if sloping else 0)
        low, high = (0.0, 0.0) if log_bounds is None else log_bounds
        initial, rate, ids = initial.contiguous(), rate.contiguous(), ids.contiguous()
        gains, scale, places = (None if x is None else x.contiguous() for x in (gains, inverse_capacity, places))
        has = {"HEATED": frequencies > 0, "PLACED": places is not None, "SCALED": scale is not None}
        size = {"BLOCK": on_cuda.BLOCK, "WIDTH": max(16, 1 << (frequencies - 1).bit_length())}
        if len(ids) > 0:
            on_cuda.forward[on_cuda.programs(len(ids))](
                rate, initial, ambient, gains, places, scale, ids, table, values, slopes, len(ids), frequencies,
                table.shape[1], seconds, BACKWARD_TIME_CONSTANTS / -seconds if seconds < 0 else math.inf, low, high,
                BOUNDED=log_bounds is not None, SLOPING=sloping, **has, **size,
            )  # fmt: skip
        ctx.save_for_backward(rate, initial, gains, scale, places, ids, table, slopes)
        ctx.seconds, ctx.options = seconds, has | size
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, v_values: Tensor):
        from heatsplat.kernels.gpu import relaxation as on_cuda

        rate, initial, gains, scale, places, ids, table, slopes = ctx.saved_tensors
        grid = on_cuda.programs(len(ids))
        v_ambient = rate.new_empty(grid)
        v_rate, v_initial, v_scale, v_gains = (
            None if x is None else torch.zeros_like(x) for x in (rate, initial, scale, gains)
        )
        if len(ids) > 0:
            on_cuda.backward[grid](
                slopes, v_values.contiguous(), places, scale, ids, table, v_rate, v_initial, v_ambient, v_scale, v_gains,
                len(ids), 0 if gains is None else gains.shape[2], table.shape[1], ctx.seconds, **ctx.options,
            )  # fmt: skip
        v_ambient = v_ambient.sum() if ctx.needs_input_grad[1] else None
        return None, v_ambient, v_initial, v_rate, None, v_gains, v_scale, None, None, None
