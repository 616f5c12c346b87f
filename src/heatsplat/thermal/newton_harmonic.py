"""ETGS: every Gaussian relaxes to the ambient temperature and is heated by a sum of harmonics, in closed form."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, check_option
from heatsplat.physics.first_look import RELAXES, first_rates
from heatsplat.physics.frequencies import SEPARATION, default_tau_min, frequency_grid
from heatsplat.physics.fused import visible_temperature
from heatsplat.physics.relaxation import relax
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds
from heatsplat.thermal.relaxing import Relaxing
from heatsplat.thermal.sparse_sources import SparseSources

log = logging.getLogger(__name__)

PARAMS = ("rate", "faithful")
PENALTIES = ("group", "ridge")
REDUCTIONS = ("sum", "mean_over_gaussians")
UNITS = ("image", "si")
SLOWEST = 100.0  # spans: time constants beyond this are shown as this
LOG_RATES = (-80.0, 30.0)  # of the rate per span: from never to at once, while squares still fit float32


class NewtonHarmonic(Relaxing):
    """Emission of C dT/dt = -h (T - T_ambient) + Σ_k A_k sin ω_k t + B_k cos ω_k t (ETGS, ICLR 2026, Eq. 3-9).

    Only h/C, A/C and B/C reach the image: scaling C, h, A and B together changes nothing but the penalty on A and B,
    which an optimiser can so evade. ``param="rate"`` learns the three ratios; ``param="faithful"`` learns the paper's
    four and fixes the scale by a weak prior that keeps C near 1.

    The penalty on A and B (on A/C and B/C in rate form) is the paper's sum of squares, "ridge", or that of the authors'
    code, "group": Σ_k √(Σ_i A_ik² + B_ik²). Its pull on a frequency is the stronger the less all Gaussians together make
    of it, so that a scene keeps the few frequencies that it needs.

    **Convention:** inside, time is counted in observed spans and temperature in image units, 0 at Tmin and 1 at Tmax;
    so are rates and gains, and so is the penalty unless asked otherwise. A scene without a range is modelled in image
    values, with no temperature in kelvin.

    Tensors: "initial_state" [N], "source_gains" [N, 2, K] (sin, cos; absent without frequencies) and "log_rate" [N], or
    "log_capacity" [N] and "log_conductance" [N] in faithful form. With ``drop_sources_at``, "source_gains" becomes sparse
    (see Splats) at those steps: what has no row only relaxes, and costs neither its harmonics nor their memory.

    Args:
        frequencies: harmonics asked for; K, those that the grid holds, may be fewer. 0 is pure relaxation, without any
            tensor of a source.
        param: "rate" or "faithful".
        tau_min_s: shortest time constant, bounds the frequencies; None takes max(median gap of the times, span / 200).
        frequency_gain: steady-state amplitude below which a frequency is left out, in (0, 1].
        separation: cycles over the record by which frequencies differ at least (``frequency_grid``).
        penalty: "group" or "ridge".
        source_penalty: its weight; 0 leaves it out.
        penalty_reduction: over Gaussians, of the squares: "mean_over_gaussians" or "sum" (the paper and the authors' code),
            which grows with their number and, in units of the scene, suppresses the source it should only tame.
        penalty_units: what A and B are counted in by the penalty: "image", image units per span, or "si", °C per second
            (the paper's, times C in faithful form).
        gauge_l2: weight of the prior (log C)² in faithful form.
        ambient: "measured" (the scene's, else learned), "learned" (from the measured one, if any) or a number in °C.
        clip: how values outside the range are shown: "straight_through" clamps values but lets gradients pass, so that
            a Gaussian outside comes back; "hard" stops its gradient (the paper's Eq. 9); "none" shows them as they are.
        lr_initial, lr_rate, lr_ambient: learning rates.
        lr_source: that of a whole source; each of its K harmonics has lr_source / K. A step of Adam moves every gain by
            its rate, so that a step moves the temperature by as much whatever K is.
        lr_end: factor on them at the last step, log-linear in between.
        drop_sources_at: steps at which Gaussians lose a source that they do not need (see SparseSources); none by default.
        source_floor: how closely relaxation alone must tell their temperature, in standard deviations of the noise.
        source_noise: that standard deviation in image units; None estimates it from training images.

    Raises:
        ValueError: an option is unknown.
    """

    beyond_record = "heat sources are off, and every Gaussian relaxes to the ambient temperature at its own rate"

    def __init__(
        self,
        frequencies: int = 24,
        param: str = "rate",
        tau_min_s: float | None = None,
        frequency_gain: float = math.sqrt(0.5),
        separation: float = SEPARATION,
        penalty: str = "group",
        source_penalty: float = 1e-3,
        penalty_reduction: str = "mean_over_gaussians",
        penalty_units: str = "image",
        gauge_l2: float = 1e-5,
        ambient: str | float = "measured",
        clip: str = "straight_through",
        lr_initial: float = 2.5e-3,
        lr_source: float = 0.16,
        lr_rate: float = 5e-3,
        lr_ambient: float = 1e-3,
        lr_end: float = 0.1,
        drop_sources_at: Sequence[int] = (),
        source_floor: float = 30.0,
        source_noise: float | None = None,
    ) -> None:
        super().__init__(ambient, clip, lr_ambient, lr_end)
        check_option("param", param, PARAMS)
        check_option("penalty", penalty, PENALTIES)
        check_option("penalty_reduction", penalty_reduction, REDUCTIONS)
        check_option("penalty_units", penalty_units, UNITS)
        self.frequencies, self.param = frequencies, param
        self.tau_min_s, self.frequency_gain, self.separation = tau_min_s, frequency_gain, separation
        self.grouped, self.source_penalty, self.gauge_l2 = penalty == "group", source_penalty, gauge_l2
        self.over_mean, self.in_si = penalty_reduction == "mean_over_gaussians", penalty_units == "si"
        self.lr_initial, self.lr_source, self.lr_rate = lr_initial, lr_source, lr_rate
        self.sources = SparseSources(drop_sources_at, source_floor, source_noise) if drop_sources_at else None
        self.register_buffer("omega", torch.zeros(0, dtype=torch.float64))  # radians per span

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        times = torch.tensor(scene.train.times_s, dtype=torch.float64)
        if times.max() > times.min():
            tau_min_s = default_tau_min(times) if self.tau_min_s is None else self.tau_min_s
            grid = frequency_grid(times, self.frequencies, tau_min_s, self.frequency_gain, self.separation)
            self.omega = grid * self.clock.span_s
        else:
            log.warning("scene '%s' shows one moment only: the model has no heat source", scene.name)
        if scene.thermal_range is None and self.in_si:
            raise SceneError(
                f"thermal.penalty_units=si counts heat sources in °C per second, but scene '{scene.name}' has no temperature "
                "range; use thermal.penalty_units=image"
            )
        if scene.thermal_range is None:
            log.warning("scene '%s' has no temperature range: heat is modelled in image values, not in °C", scene.name)
        if self.sources is not None and self.omega.numel() > 0:
            self.sources.prepare(scene, self.modality)

    @torch.no_grad()
    def rows_to_drop(self, splats: Splats, step: int) -> Iterator[tuple[str, Tensor, Mapping[str, Tensor]]]:
        """At the steps of ``drop_sources_at``, the sources of Gaussians that relaxation alone can tell."""
        if self.sources is None or self.omega.numel() == 0 or step not in self.sources.drop_at:
            return
        gone, initial, log_rate = self.sources.needless(
            lambda time_s: self._state(splats, time_s, None), self.ambient, self.clock.span_s
        )
        instead = {"initial_state": initial}
        if self.param == "rate":
            instead["log_rate"] = log_rate
        else:
            instead["log_conductance"] = log_rate + splats["log_capacity"]
        places = splats.places("source_gains")
        had = torch.ones_like(gone) if places is None else places >= 0
        stay, before = int((had & ~gone).sum()), int(had.sum())
        log.info("%d of %d heat sources stay, for %d Gaussians", stay, before, len(gone))
        yield "source_gains", gone, instead

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        initial = seeds.values.mean(1)
        self.guess_ambient(initial)
        tensors, harmonics = self._bodies(initial, seeds), self.omega.numel()
        if harmonics > 0:
            gains = initial.new_zeros(len(initial), 2, harmonics)
            weight, unit = self.source_penalty, self._penalty_unit()
            ridge, group = (0.0, weight * unit) if self.grouped else (weight * unit**2, 0.0)
            declared = self._tensor(gains, self._lr_gains(harmonics), ridge, paced=False)
            tensors["source_gains"] = replace(declared, group=group)
        return tensors

    def _tensor(self, initial: Tensor, lr: float, l2: float = 0.0, paced: bool = True) -> PerGaussian:
        return PerGaussian(initial, lr, l2, self.over_mean, self.lr_end, paced)

    def _first_rates(self, seeds: Seeds) -> Tensor:
        """Rates per span [N] to start with, of what training views show over time."""
        if seeds.looks is None or seeds.looks_s is None:
            return seeds.values.new_full((len(seeds.values),), RELAXES)
        spans = (seeds.looks_s - self.clock.first_s) / self.clock.span_s
        return first_rates(seeds.looks.mean(2), spans, self.ambient.detach())

    def _bodies(self, initial: Tensor, seeds: Seeds) -> dict[str, PerGaussian]:
        """What Gaussians that are first seen at ``initial`` [N] carry beside their gains."""
        log_rate = self._first_rates(seeds).log()
        tensors = {"initial_state": self._tensor(initial, self.lr_initial)}
        if self.param == "rate":
            return tensors | {"log_rate": self._tensor(log_rate, self.lr_rate)}
        tensors["log_capacity"] = self._tensor(torch.zeros_like(initial), self.lr_rate, self.gauge_l2)
        return tensors | {"log_conductance": self._tensor(log_rate, self.lr_rate)}

    def _penalty_unit(self) -> float:
        """A gain of 1 image unit per span in the units of the penalty."""
        return self.range.bounds.span_k / self.clock.span_s if self.in_si else 1.0

    def _lr_gains(self, harmonics: int) -> float:
        return self.lr_source / harmonics

    def _state(self, splats: Splats, time_s: float | None, ids: Tensor | None) -> Tensor:
        """Temperature in image units of the Gaussians ``ids``, [n], not clipped.

        A sum of harmonics says nothing of a source outside the record that it was fitted to. There only relaxation is left,
        from the state at the end of the record and towards that at its start (``physics.relaxation`` bounds how far back).
        """
        spans, within = self.clock.spans(time_s), self.clock.within(time_s)
        if spans == within:
            return self._recorded(splats, spans, ids)
        with torch.no_grad():
            state = self._recorded(splats, within, ids)
            beyond = torch.tensor(spans - within, dtype=torch.float64, device=state.device)
            return relax(beyond, self.ambient, state, Query(ids).rows(self._rate(splats)))

    def _given_rate(self, splats: Splats) -> tuple[Tensor, tuple[float, float] | None]:
        """h/C of every Gaussian per span, [N]; or its logarithm, and the bounds within which that is taken."""
        faithful = self.param == "faithful"
        return splats["log_conductance"] - splats["log_capacity"] if faithful else splats["log_rate"], LOG_RATES

    def _rate(self, splats: Splats) -> Tensor:
        """h/C of every Gaussian per span, [N]."""
        rate, log_bounds = self._given_rate(splats)
        return rate if log_bounds is None else rate.clamp(*log_bounds).exp()

    def _gain_factor(self, splats: Splats) -> Tensor | None:
        """What gains are multiplied by to drive a temperature, [N], 1/C; None is 1."""
        return torch.exp(-splats["log_capacity"]) if self.param == "faithful" else None

    def _recorded(self, splats: Splats, spans: float, ids: Tensor | None) -> Tensor:
        """As ``_state`` at a time within the record, counted in spans."""
        source = self.omega.numel() > 0
        rate, log_bounds = self._given_rate(splats)
        return visible_temperature(
            torch.tensor(spans, dtype=torch.float64),
            self.ambient,
            splats["initial_state"],
            rate,
            self.omega,
            splats["source_gains"] if source else None,
            self._gain_factor(splats) if source else None,
            ids,
            splats.places("source_gains") if source else None,
            log_bounds,
        )

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Time constant C/h in seconds, at most ``SLOWEST`` spans, which no record tells from more; and with a source and a
        range of temperatures the root mean square of the heating A/C, B/C, in °C per hour."""
        values = {"time_constant_s": self.clock.span_s / query.rows(self._rate(splats)).clamp(min=1.0 / SLOWEST)}
        if self.omega.numel() > 0 and self.range.bounds is not None:
            ids = torch.arange(len(splats), device=self.omega.device) if query.ids is None else query.ids
            rms = (splats["source_gains"].square().sum((1, 2)) / 2).sqrt()
            heating = splats.dense("source_gains", rms, ids) * (3600.0 * self.range.bounds.span_k / self.clock.span_s)
            factor = self._gain_factor(splats)
            values["source_c_per_h"] = heating if factor is None else heating * factor[ids]
        return values

    def effects(self) -> dict[str, dict]:
        effects = {"relaxation": {"param": self.param, "ambient": self.ambient_is}}
        if self.omega.numel() > 0:
            effects["harmonic_source"] = {"frequencies": self.omega.numel()}
        return effects

    @property
    def cost(self) -> int:
        # One exponential and 4 operations for relaxation; per frequency 3 weights, 2 responses of 3 and 2 gains.
        return 12 + 11 * self.omega.numel()
