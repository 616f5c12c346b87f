"""Learning rates of the geometry and their decay; one Adam with one named group per tensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import nn

from heatsplat.contracts import check_numbers
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Rate
from heatsplat.training.adam import OnePassAdam
from heatsplat.training.decoupled import DecoupledDecay

PUBLISHED_STEPS = 30_000  # for which 3DGS and the methods that build on it chose their rates
FASTEST = 5.0  # times those rates: at eight times them a run of 1300 steps does worse than at four (docs/defaults.md)


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
            updates in it (``training.averaging``); 0: they stay as the last update left them; None: the share that the
            thermal model has (``ThermalModel.averaged``).
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
        averaged: float | None = 0.0,
        decoupled: DecoupledDecay | None = None,
    ) -> None:
        given = {
            "length_power": length_power,
            "means_end": means_end,
            "decay": decay,
            "eps": eps,
            "accumulate": accumulate,
        }
        for name, value in given.items():
            check_numbers(f"optim.{name}", value)
        if accumulate < 1:
            raise ValueError(f"optim.accumulate is a number of views and at least 1, got {accumulate}")
        if not 0 <= accumulate_from <= 1:
            raise ValueError(f"optim.accumulate_from is a share of the run, from 0 to 1, got {accumulate_from}")
        if averaged is not None and not 0 <= averaged <= 1:
            raise ValueError(f"optim.averaged is a share of the run, from 0 to 1, or null, got {averaged}")
        if steps < 1:
            raise ValueError(f"optim.steps must be at least 1, got {steps}")
        if min(means_end, decay, length_power) < 0:
            raise ValueError(
                f"optim.means_end, decay and length_power must not be negative, got {means_end}, {decay} and {length_power}"
            )
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
        """Parameter groups of the four geometry tensors."""
        rates = {
            "means": Rate(self.means, self.means_end, paced=True),
            "log_scales": Rate(self.log_scales, paced=True),
            "quats": Rate(self.quats, paced=True),
            "opacity_logits": Rate(self.opacity_logits),
        }
        groups = [self.group(name, splats[name], rate) for name, rate in rates.items()]
        groups[0]["lr"] *= extent
        return groups

    def group(self, name: str, parameter: nn.Parameter, rate: Rate, **more: Any) -> dict[str, Any]:
        """The optimiser's group of a parameter that learns at a rate, with ``more`` options of ``OnePassAdam``.

        "lr_end" is the factor on its "lr" at the last step, "held" the share of the progress in which it stays (``build``).
        """
        lr = rate.lr * (self.pace if rate.paced else 1.0)
        held = self.held(rate.held)
        return {"params": [parameter], "name": name, "lr": lr, "lr_end": rate.lr_end, "held": held} | more

    def held(self, share: float) -> float:
        """Share of the run in which a rate stays that is held for ``share`` of the shortest: none of a run of the papers' length.

        A rate that falls to a 500th by the papers' law is below a fifth of itself for three quarters of a run. Of 30,000 steps
        the rest is enough, of 2,000 it is not (docs/defaults.md).
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
