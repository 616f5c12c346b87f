"""Learning rates of the geometry and their decay; one Adam with one named group per tensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import nn

from heatsplat.contracts import check_numbers
from heatsplat.kernels import adam as kernel
from heatsplat.kernels import gpu
from heatsplat.kernels.simd import LANES
from heatsplat.physics.fused import Unwritten
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian
from heatsplat.training.decoupled import DecoupledDecay

PUBLISHED_STEPS = 30_000  # for which 3DGS and the methods that build on it chose their rates
FASTEST = 5.0  # times those rates: at eight times them a run of 1300 steps does worse than at four (docs/presets.md)


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
        if all(_fits_kernel(x) and x.grad.dtype == x.dtype for _, x in stepped):
            self._step_in_kernel(stepped, by_rows)
        else:
            for group, x, unwritten in by_rows:
                x.grad = unwritten.written(x.shape)
                stepped.append((group, x))
            if all(_fits_kernel(x, "cuda") and x.grad.dtype == x.dtype for _, x in stepped) and gpu.available():
                self._step_on_cuda(stepped)
            else:
                for group, x in stepped:
                    if group.get("group_penalty"):
                        x.grad += group["group_penalty"] * x * _reciprocals(x.square().flatten(0, -2).sum(0).sqrt())
                    if group["fused"] and self.state[x]:  # torch counts on the device there, and ours on the CPU
                        self.state[x]["step"] = self.state[x]["step"].to(x.device)
                super().step()
            self._sums = None
        return loss

    step.hooked = True  # or torch wraps it in a record for its profiler, with hooks that nobody sets here

    def _step_in_kernel(
        self,
        stepped: list[tuple[dict[str, Any], torch.Tensor]],
        by_rows: list[tuple[dict[str, Any], torch.Tensor, Unwritten]],
    ) -> None:
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

    def _step_on_cuda(self, stepped: list[tuple[dict[str, Any], torch.Tensor]]) -> None:
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


def penalties(item: PerGaussian, count: int) -> dict[str, float]:
    """Options of a group of ``OnePassAdam`` that make the penalties of a tensor of ``count`` Gaussians."""
    count = count if item.l2_mean else 1
    group = {"group_penalty": item.group / math.sqrt(count)} if item.group > 0 else {}
    return {"weight_decay": 2 * item.l2 / count} | group


class Optimisation:
    """The optimiser's settings (defaults of 3D Gaussian Splatting).

    Args:
        means, log_scales, quats, opacity_logits: learning rates; that of the means is multiplied by the scene's extent.
        length_power: how much faster parameters of Gaussians and networks learn in a run shorter than the 30 000 steps for
            which the papers chose their rates: (30 000 / steps) ** length_power times, at most five. Longer runs learn at
            those rates. Opacities are left out: they saturate.
        steps: planned length of the run.
        means_end: factor on the means' learning rate at the last step; log-linear in between.
        decay: share of the decay of all learning rates that a run goes through: at the last step each has fallen to
            its "lr_end" to this power. 1 is what the methods' papers do in 30 000 steps; 0 leaves rates as they are.
        betas, eps: of Adam.
        accumulate: views whose gradients are summed for one update, rounded; 1: every view has an update of its own.
        accumulate_from: share of the run, or of each of its rounds, after which that begins.
        averaged: share of the run, or of the last of its rounds, at whose end parameters become their mean over the
            updates in it (``training.averaging``); 0: they stay as the last update left them.
        decoupled: decay of opacities and sizes beside Adam, or None.

    Raises:
        ValueError: an option is out of its range, or ``decoupled`` is no such decay.
    """

    def __init__(
        self,
        means: float = 1.6e-4,
        means_end: float = 0.01,
        log_scales: float = 5e-3,
        quats: float = 1e-3,
        opacity_logits: float = 5e-2,
        length_power: float = 0.0,
        steps: int = PUBLISHED_STEPS,
        decay: float = 1.0,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        accumulate: float = 1,
        accumulate_from: float = 0.5,
        averaged: float = 0.0,
        decoupled: DecoupledDecay | None = None,
    ) -> None:
        if accumulate < 1:
            raise ValueError(f"optim.accumulate is a number of views and at least 1, got {accumulate}")
        if not 0 <= averaged <= 1:
            raise ValueError(f"optim.averaged is a share of the run, from 0 to 1, got {averaged}")
        if min(means_end, decay) < 0:
            raise ValueError(f"optim.means_end and decay must not be negative, got {means_end} and {decay}")
        check_numbers("optim.betas", betas, 2)
        if not all(0 <= beta < 1 for beta in betas) or eps <= 0:
            raise ValueError(f"optim.betas must lie in [0, 1) and optim.eps above 0, got {list(betas)} and {eps}")
        if not isinstance(decoupled, DecoupledDecay | None):
            raise ValueError(f"optim.decoupled must be the settings of optim=adamw, or null, got {decoupled}")
        self.pace = min(max(PUBLISHED_STEPS / steps, 1.0) ** length_power, FASTEST)
        self.means, self.means_end, self.decay = means, means_end, decay
        self.log_scales, self.quats, self.opacity_logits = log_scales, quats, opacity_logits
        self.betas, self.eps = tuple(betas), eps
        self.accumulate, self.accumulate_from, self.decoupled = round(accumulate), accumulate_from, decoupled
        self.averaged = averaged

    def geometry_groups(self, splats: Splats, extent: float) -> list[dict[str, Any]]:
        """Parameter groups of the four geometry tensors; "lr_end" is the factor on a rate at the last step."""
        rates = {
            "means": self.pace * self.means * extent,
            "log_scales": self.pace * self.log_scales,
            "quats": self.pace * self.quats,
            "opacity_logits": self.opacity_logits,
        }
        ends = {"means": self.means_end}
        return [
            {"params": [splats[name]], "name": name, "lr": lr, "lr_end": ends.get(name, 1.0)}
            for name, lr in rates.items()
        ]

    def held(self, share: float) -> float:
        """Share of the run in which a rate stays that is held for ``share`` of the shortest: none of a run of the papers' length.

        A rate that falls to a 500th by the papers' law is below a fifth of itself for two thirds of a run. Of 30,000 steps the
        rest is enough, of 2,000 it is not (docs/presets.md).
        """
        return share * (1 - self.pace**-2)

    def updates(self, step: int, progress: float) -> bool:
        """Whether parameters change after ``step``, at which ``progress`` of its round is done; else its gradients wait."""
        return self.accumulate == 1 or progress < self.accumulate_from or (step + 1) % self.accumulate == 0

    def build(self, groups: list[dict[str, Any]], progress: Callable[[float], float]):
        """The optimiser over all groups, and the scheduler to call after every step.

        Args:
            groups: each with "name", "params", "lr" and, where the rate changes, "lr_end": the factor on it at the last
                step, log-linear in between or, after a share "held" of the progress in which it stays, in the rest.
            progress: function of a step to the share of the decay that is done (``Schedule.round_progress``).
        """
        optimizer = OnePassAdam(groups, betas=self.betas, eps=self.eps, fused=True)
        progress = lru_cache(maxsize=1)(progress)  # all groups ask for the same step

        def factor(end: float, held: float) -> Callable[[int], float]:
            if held == 0:
                return lambda step: end ** progress(step)
            return lambda step: end ** (max(progress(step) - held, 0.0) / (1 - held))

        factors = [
            factor(group.get("lr_end", 1.0) ** self.decay, group.get("held", 0.0)) for group in optimizer.param_groups
        ]
        return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, factors)
