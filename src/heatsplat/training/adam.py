"""Adam in one pass over all tensors, with gradients that wait unwritten for a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import nn

from heatsplat.kernels import adam as kernel
from heatsplat.kernels import gpu
from heatsplat.kernels.simd import LANES
from heatsplat.physics.fused import Unwritten

Stepped = tuple[dict[str, Any], torch.Tensor]  # a group and one of its parameters
SteppedByRows = tuple[dict[str, Any], torch.Tensor, Unwritten]  # and its gradient


class OnePassAdam(torch.optim.Adam):
    """torch's Adam, whose step is one kernel over all float32 tensors (heatsplat.kernels.adam, kernels.gpu.adam on CUDA).

    State and options are torch's own. torch steps tensor by tensor, which for small scenes takes longer than the arithmetic.
    Where there is no Triton on CUDA, or a tensor has another dtype, torch steps.

    A group may have one more option, "group_penalty": the weight of a penalty Σ_k √(Σ_i x_ik²) over the columns k of the
    last dimension of its tensors. Its gradient is that of a weight decay of weight / √(Σ_i x_ik²), and is added like that.

    From ``zero_grad`` to ``step`` parameters take gradients that are not written out, those of several views, too, as their
    attribute ``unwritten`` (``physics.fused.Unwritten``), unless ``takes_unwritten`` is False: then all are in ``grad``.
    """

    takes_unwritten = True
    _sums: np.ndarray | None = None

    def finite(self) -> bool | None:
        """Whether all that the last step wrote is finite and far from overflow; None where the kernel did not step."""
        return None if self._sums is None else math.isfinite(self._sums.sum(dtype=np.float64))

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forgets all gradients; ``set_to_none`` False is not known here, for nothing adds to a gradient of zeros."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None
                if self.takes_unwritten and _fits_kernel(parameter):
                    parameter.unwritten = Unwritten()

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step of all parameters that have a gradient; what ``closure`` returns, which is called first."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        stepped, by_rows = self._with_gradients()
        if all(_fits_kernel(x) and x.grad.dtype == x.dtype for _, x in stepped):
            self._step_in_kernel(stepped, by_rows)
            return loss
        for group, x, unwritten in by_rows:
            x.grad = unwritten.written(x.shape)
            stepped.append((group, x))
        if all(_fits_kernel(x, "cuda") and x.grad.dtype == x.dtype for _, x in stepped) and gpu.available():
            self._step_on_cuda(stepped)
        else:
            self._step_in_torch(stepped)
        self._sums = None
        return loss

    step.hooked = True  # or torch wraps it in a record for its profiler, with hooks that nobody sets here

    def _with_gradients(self) -> tuple[list[Stepped], list[SteppedByRows]]:
        """The parameters whose gradient is in ``grad``, and those whose gradient is not written out at all; what was waiting for
        either is taken from it."""
        stepped, by_rows = [], []
        for group in self.param_groups:
            for x in group["params"]:
                unwritten = x.__dict__.pop("unwritten", None)
                if unwritten and x.grad is None:
                    by_rows.append((group, x, unwritten))
                    continue
                if unwritten:
                    x.grad += unwritten.written(x.shape)
                if x.grad is not None:
                    stepped.append((group, x))
        return stepped, by_rows

    def _step_in_torch(self, stepped: list[Stepped]) -> None:
        for group, x in stepped:
            if group.get("group_penalty"):
                x.grad += group["group_penalty"] * x * _reciprocals(x.square().flatten(0, -2).sum(0).sqrt())
            if group["fused"] and self.state[x]:  # torch counts on the device there, and ours on the CPU
                self.state[x]["step"] = self.state[x]["step"].to(x.device)
        super().step()

    def _step_in_kernel(self, stepped: list[Stepped], by_rows: list[SteppedByRows]) -> None:
        tensors, rates, kept, tasks = [], [], [], 0
        decays = [np.array([group["weight_decay"] for group, _ in stepped], np.float32).repeat(LANES)]
        decayed = decays[0].size
        for row, (group, parameter) in enumerate(stepped):
            state, gradient, count = self._state_of(parameter), parameter.grad.contiguous(), parameter.numel()
            kept.append(gradient)  # its memory, until the kernel has read it
            decay, period = row * LANES, LANES
            if group.get("group_penalty") and count > 0:
                decays.append(np.tile(self._group_decay(group, parameter), LANES))
                decay, period = decayed, decays[-1].size
                decayed += period
            places = parameter, gradient, state["exp_avg"], state["exp_avg_sq"]
            tensors.append((*(tensor.data_ptr() for tensor in places), count, tasks, decay, period))
            tasks += -(-count // kernel.SHARE)
            rates.append(_counted(group, state))
        self._sums = np.zeros(tasks, np.float32)
        if tasks > 0:
            kernel.step(np.array(tensors), np.array(rates, np.float32), np.concatenate(decays), self._sums)
            if self._squares is not None and any(parameter is self._squares[0] for _, parameter in stepped):
                self._squares = None
        for group, parameter, unwritten in by_rows:
            decay = np.full(parameter.shape[-1], group["weight_decay"], np.float32)
            if group.get("group_penalty"):
                decay = self._group_decay(group, parameter)
            state = self._state_of(parameter)
            rate = np.array(_counted(group, state), np.float32)
            sums, squares = unwritten.step(parameter, state["exp_avg"], state["exp_avg_sq"], decay, rate)
            self._squares = parameter, parameter._version, squares
            self._sums = np.concatenate([self._sums, sums])

    def _step_on_cuda(self, stepped: list[Stepped]) -> None:
        from heatsplat.kernels.gpu import adam as on_cuda  # here, for Triton is not everywhere

        rows, counts, kept, programs = [], [], [], 0
        for group, parameter in stepped:
            state, gradient, count = self._state_of(parameter), parameter.grad.contiguous(), parameter.numel()
            rates = _counted(group, state)
            if count == 0:
                continue
            kept.append(gradient)  # its memory, until the kernel is queued
            places = [x.data_ptr() for x in (parameter, gradient, state["exp_avg"], state["exp_avg_sq"])]
            norms, columns = 0, 1
            if group.get("group_penalty"):
                kept.append(torch.linalg.vector_norm(parameter.detach().flatten(0, -2), dim=0))
                norms, columns = kept[-1].data_ptr(), parameter.shape[-1]
            pulls = group["weight_decay"], group.get("group_penalty", 0.0)
            # In the order of the columns of ``on_cuda.step``.
            rows.append((*places, norms, programs, count, columns, *rates, *pulls))
            counts.append(count)
            programs += on_cuda.blocks(count)
        if rows:
            device = kept[0].device
            tensors = torch.from_numpy(np.array(rows, np.float64)).to(device, non_blocking=True)
            on_cuda.step[(programs,)](tensors, _owners(tuple(map(on_cuda.blocks, counts)), device), BLOCK=on_cuda.BLOCK)

    _squares: tuple[torch.Tensor, int, np.ndarray] | None = None  # of the last tensor stepped by rows, until it changes

    def _group_decay(self, group: dict[str, Any], parameter: torch.Tensor) -> np.ndarray:
        """Decay of each column of a parameter with a penalty of groups."""
        known = self._squares
        if known is not None and known[0] is parameter and known[1] == parameter._version:
            sums = known[2]
        else:
            columns = parameter.shape[-1]
            sums = np.empty((-(-parameter.numel() // (kernel.SQUARED_ROWS * columns)), columns), np.float32)
            kernel.square_columns(parameter.detach().view(-1).numpy(), columns, sums)
        norms = np.sqrt(sums.sum(axis=0, dtype=np.float64).astype(np.float32))
        pulls = np.divide(1, norms, out=np.zeros_like(norms), where=norms > 0)
        return np.float32(group["weight_decay"]) + np.float32(group["group_penalty"]) * pulls

    def _state_of(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        """Moments and number of steps of a parameter, made at its first step."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state


@lru_cache(maxsize=4)
def _owners(programs: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """The row of each program's tensor, where tensors take so many of them; the same until Gaussians come or go."""
    return torch.from_numpy(np.repeat(np.arange(len(programs), dtype=np.int32), programs)).to(device)


def forget_gradients(parameter: torch.Tensor) -> None:
    """Forgets the gradients of a parameter, those that wait for more views, too."""
    parameter.grad = None
    if hasattr(parameter, "unwritten"):
        parameter.unwritten.clear()


def waiting_gradients(module: nn.Module) -> dict[str, dict[str, Any]]:
    """Gradients of a module that wait for those of more views, for a checkpoint: "gradients" and "unwritten", by name."""
    named = dict(module.named_parameters())
    unwritten = {name: x.unwritten for name, x in named.items() if hasattr(x, "unwritten")}
    return {
        "gradients": {name: x.grad.cpu() for name, x in named.items() if x.grad is not None},
        "unwritten": {name: found.state_dict() for name, found in unwritten.items() if found},
    }


def load_waiting_gradients(module: nn.Module, state: Mapping[str, Any]) -> None:
    """Gives the parameters of a module the gradients of ``waiting_gradients``, where a checkpoint has any."""
    for name, gradient in state.get("gradients", {}).items():
        parameter = module.get_parameter(name)
        parameter.grad = gradient.to(parameter.device)
    for name, views in state.get("unwritten", {}).items():
        parameter, found = module.get_parameter(name), Unwritten()
        found.load_state_dict(views)
        if _fits_kernel(parameter):
            parameter.unwritten = found
        else:
            parameter.grad = found.written(parameter.shape).to(parameter)


def _fits_kernel(parameter: torch.Tensor, device: str = "cpu") -> bool:
    """Whether a parameter is one that the kernel of a kind of device steps."""
    return parameter.dtype == torch.float32 and parameter.device.type == device and parameter.is_contiguous()


def _counted(group: dict[str, Any], state: dict[str, torch.Tensor]) -> tuple[float, ...]:
    """Counts a step of a parameter; its row of rates for the kernel."""
    if state["step"].is_cuda:  # of a checkpoint, by torch's rule for fused=True
        state["step"] = state["step"].cpu()
    done = state["step"].numpy()
    done += 1
    (beta1, beta2), count = group["betas"], float(done)
    return group["lr"] / (1 - beta1**count), beta1, beta2, 1 / math.sqrt(1 - beta2**count), group["eps"]


def _reciprocals(norms: torch.Tensor) -> torch.Tensor:
    """1 / norms, and 0 for a norm of 0, which pulls nowhere."""
    return torch.where(norms > 0, 1 / norms, 0.0)
