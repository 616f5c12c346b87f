"""ETGS in the parameters of its authors' code: a time constant in seconds, a scale of the source, and no logarithms."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError
from heatsplat.physics.frequencies import SEPARATION
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Seeds
from heatsplat.thermal.newton_harmonic import NewtonHarmonic

SHORTEST_S, SMALLEST = 1e-3, 1e-8  # bounds of the time constant and of γ in the authors' code


class ReleasedHarmonic(NewtonHarmonic):
    """The temperature of ``NewtonHarmonic`` in τ = C/h, γ = τ/C, A, B and T0, as ETGS was released.

    Learned are the numbers themselves, not logarithms: T = T_ambient + (T0 - T_ambient) e^{-t/τ} + Σ_k γ/(1 + ω_k² τ²)
    {A_k (sin ω_k t - ω_k τ cos ω_k t + ω_k τ e^{-t/τ}) + B_k (cos ω_k t + ω_k τ sin ω_k t - e^{-t/τ})}. Every Gaussian
    starts at the ambient temperature with τ = 60 s and γ = 1e-3; A and B start at 0. τ below 1 ms and γ below 1e-8 act as
    these bounds and get no gradient. A and γ are a gauge: one times what the other is divided by gives the same images
    and another penalty.

    Time counts from the first image, as in the paper; the authors' code counts that of the decay from there and that of the
    phases from midnight. Its T0 is so another number than ours; what temperatures it can show is the same.

    **Convention:** inside, as ``NewtonHarmonic``: spans and image units. Starts and learning rates are given in seconds
    and °C as released; an optimiser like Adam takes the same steps in either unit. The gains A and B keep their unit.

    Tensors: "initial_state" T0 in image units, "time_constant" τ in spans, "source_scale" γ in image units, each [N], and
    "source_gains" [N, 2, K].

    Args:
        frequencies, tau_min_s, frequency_gain, separation, source_penalty, penalty_reduction, ambient, clip: as in
            ``NewtonHarmonic``; the penalty is that of groups.
        time_constant_s, source_scale: τ in seconds and γ in °C before training.
        lr_initial_c, lr_time_constant_s, lr_source_scale, lr_gains: learning rates of T0 in °C, τ in seconds, γ in °C, and
            A and B.
        lr_ambient: learning rate of a learned ambient temperature, in image units.
        lr_end: factor on all of them at the last step, log-linear in between.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    def __init__(
        self,
        frequencies: int = 24,
        tau_min_s: float | None = 60.0,
        frequency_gain: float = 0.25,
        separation: float = SEPARATION,
        source_penalty: float = 1e-5,
        penalty_reduction: str = "sum",
        ambient: str | float = "measured",
        clip: str = "hard",
        time_constant_s: float = 60.0,
        source_scale: float = 1e-3,
        lr_initial_c: float = 0.1,
        lr_time_constant_s: float = 0.1,
        lr_source_scale: float = 1e-3,
        lr_gains: float = 2e-3,
        lr_ambient: float = 1e-3,
        lr_end: float = 1.0,
    ) -> None:
        super().__init__(
            frequencies,
            tau_min_s=tau_min_s,
            frequency_gain=frequency_gain,
            separation=separation,
            source_penalty=source_penalty,
            penalty_reduction=penalty_reduction,
            ambient=ambient,
            clip=clip,
            lr_ambient=lr_ambient,
            lr_end=lr_end,
        )
        if min(time_constant_s, source_scale) <= 0:
            raise ValueError(
                f"time_constant_s and source_scale must be above 0, got {time_constant_s} and {source_scale}"
            )
        self.param = "released"
        self.time_constant_s, self.source_scale = time_constant_s, source_scale
        self.lr_initial_c, self.lr_time_constant_s = lr_initial_c, lr_time_constant_s
        self.lr_source_scale, self.lr_gains = lr_source_scale, lr_gains

    def check(self, scene: SceneData) -> None:
        """As ``NewtonHarmonic``; raises SceneError also when the scene has no temperature range."""
        super().check(scene)
        if scene.thermal_range is None:
            raise SceneError(
                f"scene '{scene.name}' has no temperature range, and the released form of ETGS starts and steps in °C: give the "
                "range, or choose method=etgs, which works in image values"
            )

    def _bodies(self, initial: Tensor, seeds: Seeds) -> dict[str, PerGaussian]:
        span_s, span_k = self.clock.span_s, self.range.bounds.span_k
        same = torch.ones_like(initial)
        tensors = {
            "initial_state": (self.ambient.detach() * same, self.lr_initial_c / span_k),
            "time_constant": (self.time_constant_s / span_s * same, self.lr_time_constant_s / span_s),
        }
        if self.omega.numel() > 0:
            tensors["source_scale"] = (self.source_scale / span_k * same, self.lr_source_scale / span_k)
        return {name: self._tensor(start, lr) for name, (start, lr) in tensors.items()}

    def _lr_gains(self, harmonics: int) -> float:
        return self.lr_gains

    def _given_rate(self, splats: Splats) -> tuple[Tensor, None]:
        return splats["time_constant"].clamp_min(SHORTEST_S / self.clock.span_s).reciprocal(), None

    def _gain_factor(self, splats: Splats) -> Tensor:
        return splats["source_scale"].clamp_min(SMALLEST / self.range.bounds.span_k) * self._rate(splats)
