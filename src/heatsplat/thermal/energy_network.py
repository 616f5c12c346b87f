"""ThermoGS: a network of place, time and weather gives temperatures and materials, held to a balance of heat."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.contracts import WEATHER_COLUMNS, SceneData, SceneError, Weather
from heatsplat.physics.ellipsoids import SMALLEST_AXIS_M
from heatsplat.physics.units import DAY_S
from heatsplat.same_bits import mean, sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal import heat_terms
from heatsplat.thermal.base import KELVIN_RANGE, PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.coordinates import (
    Box,
    Clock,
    ImageRange,
    octaves,
    sees_hours,
    slow_octaves,
)
from heatsplat.thermal.land_cover import ATTRIBUTES, CLASSES, check_labels, reference, typical
from heatsplat.thermal.network_options import NetworkOptions
from heatsplat.thermal.residual_network import ResidualNetwork
from heatsplat.thermal.weather_drive import columns_at, remembered, value_at

log = logging.getLogger(__name__)

LATENT = "latent_heat"
CODE_PERIOD = 2.0  # of ``octaves``
# Least and greatest value of each attribute: no surface lies outside, and no head can leave them.
LIMITS = {
    "emissivity": (0.0, 1.0),
    "absorptivity": (0.0, 1.0),
    "convection": (0.0, 50.0),  # W/(m² K); wind over 15 m/s
    "capacity": (0.5e6, 6.0e6),  # J/(m³ K); water has 4.2e6
}
# Multiples of these, without their whole part, fill [0, 1) evenly however many are taken, and pairs of both the square.
GOLDEN, PLASTIC = 0.6180339887498949, 0.7548776662466927
TRAVELS = (
    "bounds_k",
    "clock.record",
    "daily",
    "slow_octaves",
    "weather_mean",
    "weather_scale",
    "feature_mean",
    "feature_scale",
)  # with the network


@dataclass(frozen=True)
class _Seen:
    """What the last view with a gradient has evaluated: Gaussians, their share of the input, hidden values, T."""

    ids: Tensor
    base: Tensor
    hidden: Tensor
    units: Tensor
    time_s: float


class EnergyNetwork(ThermalModel):
    """Temperature T_min + (T_max - T_min) sigmoid(...) of a residual network of time, place, feature and weather.

    For ``first_steps`` every Gaussian emits one value, the same at every time, while geometry and opacity settle; from
    there on (with ``stages=frozen_geometry``) the network emits and they stand still. Further heads give emissivity,
    absorptivity, convection coefficient and volumetric heat capacity of every Gaussian at every time. Four penalties
    (``heat_terms``) tie them together, for an interval that starts at the time of the view (or anywhere in the weather
    record) and ends 1 to 10 minutes
    later (earlier, at the end of the record) and for at most ``sampled`` of the Gaussians in view. Interval and
    sample are functions of the step. The head for latent heat is the paper's; as its balance has no such term, no loss
    reaches it.

    The weather is that of the scene's record at the time in question; a frame's own ``environment`` is not looked at.

    **Convention:** kelvin, seconds and metres in the balance; emission in image units. Attributes in the units of
    ``land_cover.ATTRIBUTES``.

    Tensors: "first_value" [N]; "feature" [N, F] where features are learned or given; "label" [N] where labels are used.

    Args:
        width, blocks: of the network, two layers per block.
        position_frequencies: octaves of the place; 0 leaves it out (places in one scene tell nothing of another).
        time_frequencies: octaves of the time (paper: 10).
        time: "record" encodes the share of the record that has passed (paper), "day" the share of 24 hours, "none" leaves
            time to the weather. "scene" takes "day" where the weather record is longer than a day, so that hours come
            again, else "record".
        frames_per_cycle: training images to a cycle of an octave of time, at least: the network does not see faster ones,
            with which it would learn images one by one; None takes all octaves (paper).
        features: "learned" per Gaussian, "given" by the scene's points, "labels" (one number per class), or "none".
        feature_size: F of learned or given features.
        attributes: "inferred" by the network at every moment (paper), "constant" by it throughout, or those of the class "table"
            (Tab. 6).
        weights: of smooth, physical, ode and pinn; 0 leaves a term out.
        first_steps: steps of the first stage.
        ramp_steps: steps after them over which the penalties grow to their weight.
        interval_s: shortest and longest interval in seconds.
        collocation: the penalties' intervals begin at the time of the "view" (paper), or anywhere in the weather "record", also
            where no image is.
        past_h: time constants in hours of means of the past weather that the network sees beside the present one (none in the
            paper).
        body: what the balance is of: "ellipsoid" (paper), or "surface", slabs that face as the surfaces do.
        depth_m: thickness of such slabs.
        sampled: Gaussians in view that penalties are evaluated for, at most.
        projected_area: "exact" or "printed" (Eq. 8), the area that sunlight falls on.
        surface_area: "printed" (Eq. 6) or "consistent", the area that air cools.
        sky: "none" lets bodies radiate into empty space (paper); a law of ``physics.sky`` gives them a clear sky.
        smallest_axis_m: axes of Gaussians count as at least this in the balance.
        margin: T_min and T_max lie this share of the scene's range outside it, so that the sigmoid reaches the ends.
        network: checkpoint of another run whose network is taken, held still unless ``fine_tune``.
        fine_tune: trains that network on.
        lr, lr_end: learning rate of the network and the factor on it at the end of the run.
        lr_feature, lr_first: learning rates of learned features and of the first stage's value.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    narrowest_range_k = KELVIN_RANGE
    beyond_record = "the network sees the weather of that moment, and a clock of the record stays at its nearest moment"

    def __init__(
        self,
        width: int = 64,
        blocks: int = 2,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        time: str = "scene",
        frames_per_cycle: float | None = 4.0,
        features: str = "learned",
        feature_size: int = 8,
        attributes: str = "inferred",
        weights: Mapping[str, float] | None = None,
        first_steps: int = 0,
        ramp_steps: int = 0,
        interval_s: tuple[float, float] = (60.0, 600.0),
        collocation: str = "view",
        past_h: Sequence[float] = (),
        body: str = "ellipsoid",
        depth_m: float = 0.05,
        sampled: int = 2048,
        projected_area: str = "exact",
        surface_area: str = "printed",
        sky: str = "none",
        smallest_axis_m: float = SMALLEST_AXIS_M,
        margin: float = 0.1,
        network: str | None = None,
        fine_tune: bool = False,
        lr: float = 1e-3,
        lr_end: float = 0.01,
        lr_feature: float = 2.5e-3,
        lr_first: float = 2.5e-3,
    ) -> None:
        super().__init__()
        self.options = NetworkOptions(
            width=width,
            blocks=blocks,
            position_frequencies=position_frequencies,
            time_frequencies=time_frequencies,
            time=time,
            frames_per_cycle=frames_per_cycle,
            features=features,
            feature_size=feature_size,
            attributes=attributes,
            weights=weights,
            first_steps=first_steps,
            ramp_steps=ramp_steps,
            interval_s=interval_s,
            collocation=collocation,
            past_h=tuple(past_h),
            body=body,
            depth_m=depth_m,
            sampled=sampled,
            projected_area=projected_area,
            surface_area=surface_area,
            sky=sky,
            smallest_axis_m=smallest_axis_m,
            margin=margin,
        )
        self.balance = self.options.balance()
        self.first_steps = first_steps
        self.path = None if network is None else Path(network).expanduser()
        self.lr, self.lr_end = 0.0 if network is not None and not fine_tune else lr, lr_end
        self.lr_feature, self.lr_first = lr_feature, lr_first
        labelled, given = self.options.labelled, features == "given"
        wanted = {"metres": self.options.balanced, "labels": labelled, "point_features": given}
        self.needs = frozenset({"time", "thermal_range", "weather"} | {name for name, asked in wanted.items() if asked})

        lowest, highest = torch.tensor(list(LIMITS.values())).T
        self.register_buffer("lowest", lowest, persistent=False)
        self.register_buffer("highest", highest, persistent=False)
        start = torch.logit((typical() - lowest) / (highest - lowest))
        heads = {"temperature": torch.zeros(1)}
        if self.options.inferred:
            heads |= {"attributes": start, LATENT: torch.zeros(1)}
        timed = 2 * time_frequencies if time != "none" else 0
        columns = len(WEATHER_COLUMNS) * (1 + len(past_h))
        self.network = ResidualNetwork(self.options.own_inputs, timed + columns, width, blocks, heads)

        self.register_buffer("emits", torch.tensor(True))  # the network, not the value of the first stage
        self.box, self.clock, self.range = Box(), Clock(), ImageRange()
        self.register_buffer("daily", torch.tensor(time == "day"))  # the network sees the hour of the day
        self.register_buffer("slow_octaves", torch.tensor(time_frequencies))  # those of time that it sees
        self.register_buffer("bounds_k", torch.tensor([0.0, 1.0], dtype=torch.float64))  # T_min, and T_max - T_min
        self.register_buffer("weather_mean", torch.zeros(columns, dtype=torch.float64))
        self.register_buffer("weather_scale", torch.zeros(columns, dtype=torch.float64))
        self.register_buffer("feature_mean", torch.zeros(self.options.features_each))
        self.register_buffer("feature_scale", torch.ones(self.options.features_each))
        self.weather: Weather | None = None
        self._past: Tensor | None = None  # [T, k] of the record's samples
        self.metres_per_unit = 1.0
        self._step = 0
        self._seen: _Seen | None = None
        self._points: dict[str, Tensor] = {}
        self._stored: dict[str, Tensor] | None = None

    # What the contract asks -----------------------------------------------------------------------------

    def check(self, scene: SceneData) -> None:
        """Raises SceneError, with the way out, where the scene lacks what the balance or the table needs."""
        without = {
            "metres": "areas and volumes of Gaussians need metres: give the data set metres_per_unit, or leave the "
            "balance out with thermal.weights.ode=0 thermal.weights.pinn=0",
            "labels": "the table of materials needs the land-cover class of every point: give the data set labels, or do "
            "without with thermal.weights.physical=0, thermal.attributes=inferred and thermal.features=learned",
            "point_features": "features are to be given by the data set, which has none: thermal.features=learned",
            "weather": "the network sees the weather and the balance is driven by it: give the data set a weather record",
        }
        for name in sorted(self.needs - scene.metadata):
            if name in without:
                raise SceneError(f"scene '{scene.name}' lacks '{name}': {without[name]}")
        super().check(scene)
        if self.options.labelled:
            check_labels(scene.labels, len(scene.points), scene.name)
            if not self.options.inferred and bool((scene.labels < 0).any()):
                raise SceneError(
                    f"scene '{scene.name}' has points without a class, for which the table has no attributes: label them, "
                    "or set thermal.attributes=inferred"
                )
        shape = (len(scene.points), self.options.features_each)
        if self.options.features == "given" and scene.point_features.shape != shape:
            raise SceneError(
                f"scene '{scene.name}' gives features {list(scene.point_features.shape)} for {len(scene.points)} points; "
                f"set thermal.feature_size={scene.point_features.shape[-1]} and give one row per point"
            )
        if self.options.balanced:
            self.balance.check(scene)

    def prepare(self, scene: SceneData) -> None:
        self.weather, self.metres_per_unit = scene.weather, scene.metres_per_unit or 1.0
        self._past = remembered(scene.weather, self.options.past_h)
        for constants in (self.box, self.clock, self.range):
            constants.prepare(scene)
        self.daily.fill_(sees_hours(self.options.time, scene))
        slowest = self.clock.span_s / DAY_S if self.daily else 0.5
        frames = len(set(scene.train.times_s))
        self.slow_octaves.fill_(
            slow_octaves(self.options.time_frequencies, frames, self.options.frames_per_cycle, slowest)
        )
        for frame in (*scene.test.frames, *scene.val.frames):
            scene.weather.at(frame.time_s)  # refuses now what would fail after training
        columns = torch.stack([self._weather_at(time) for time in scene.train.times_s])
        spread = columns.std(0, unbiased=False)
        there = ~columns[0].isnan()
        self.weather_mean.copy_(torch.where(there, columns.mean(0), 0.0))
        # A column that never changes tells nothing; a missing one counts as absent: both are multiplied by zero.
        self.weather_scale.copy_(torch.where(there & (spread > 1e-9), 1.0 / spread.clamp(min=1e-9), 0.0))
        if missing := self._missing_columns:
            log.warning("the weather of scene '%s' has no %s: the network does without", scene.name, ", ".join(missing))
        lower, width = self.range.lowest_k, self.range.bounds.span_k
        bounds = [lower - self.options.margin * width, (1 + 2 * self.options.margin) * width]
        self.bounds_k.copy_(torch.tensor(bounds, dtype=torch.float64))
        self._points = {"means": scene.points.float()}
        if self.options.labelled:
            self._points["label"] = scene.labels.float()
        if self.options.features == "given":
            given = scene.point_features.float()
            self.feature_mean.copy_(given.mean(0))
            self.feature_scale.copy_(given.std(0, correction=0).clamp(min=1e-6))
            self._points["feature"] = given
        if self.path is not None:
            self._stored = self._network_of_another_run()

    @torch.no_grad()
    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        value = seeds.values[:, 0]
        # Not paced: one value for all times has to be a mean over images that differ, and must not follow single ones.
        tensors = {"first_value": PerGaussian(value.clone(), self.lr_first, paced=False)}
        _, nearest = cKDTree(self._points["means"].numpy()).query(seeds.means.numpy(), workers=1)
        nearest = torch.from_numpy(nearest)
        if self.options.labelled:
            tensors["label"] = PerGaussian(self._points["label"][nearest], 0.0)
        if self.options.features == "given":
            tensors["feature"] = PerGaussian(self._points["feature"][nearest], 0.0)
        if self.options.balanced:
            tensors |= self.balance.per_gaussian(seeds)
        self.network.draw(seeds.generator)
        if self.options.features == "learned":
            feature = 0.1 * torch.randn(len(value), self.options.features_each, generator=seeds.generator)
            spread = value.std(correction=0).clamp(min=1e-3)  # of a single Gaussian it is 0
            feature[:, 0] = (value - mean(value)) / spread  # warm and cold differ from the start
            tensors["feature"] = PerGaussian(feature, self.lr_feature)
        self.network.heads["temperature"].bias.fill_(self._raw_of(mean(value)))
        if self._stored is not None:
            own = self.state_dict()
            for name, stored in self._stored.items():
                own[name].copy_(stored)
        return tensors

    def on_step(self, step: int) -> None:
        self._step = step
        self.emits.fill_(step >= self.first_steps)

    def features(self, splats: Splats, query: Query) -> Tensor:
        if not self._network_emits:
            return query.rows(splats["first_value"]).clamp(min=0.0)[:, None]
        base = self._base(splats, query.ids)
        hidden = self.network(base, self._moment(query.time_s))
        units = self._units(hidden)
        if torch.is_grad_enabled() and self.training:
            ids = torch.arange(len(splats), device=units.device) if query.ids is None else query.ids
            self._seen = _Seen(ids, base, hidden, units, query.time_s)
        return self._image_values(units)[:, None]

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """Those of "smooth", "physical", "ode" and "pinn" that are on, of the Gaussians last seen with a gradient."""
        seen, self._seen = self._seen, None
        weights = {name: self._ramp * weight for name, weight in self.options.penalties.items()}
        if seen is None or not len(seen.ids) or self._ramp == 0 or not weights:
            return {}
        stride = -(-len(seen.ids) // self.options.sampled)
        rows = torch.arange(self._step % stride, len(seen.ids), stride, device=seen.ids.device)
        ids, base = seen.ids[rows], seen.base[rows]
        terms = {}
        if "physical" in weights:
            body = self._body(splats, ids, base, seen.hidden[rows])
            terms["physical"] = heat_terms.to_reference(body, reference(splats["label"].detach()[ids].long()))
        if set(weights) - {"physical"}:
            start_s, hidden, now = seen.time_s, seen.hidden[rows], seen.units[rows]
            if self.options.collocation == "record":
                first_s, last_s = self._ends
                start_s = first_s + (last_s - first_s) * math.fmod(self._step * PLASTIC, 1.0)
                hidden = self.network(base, self._moment(start_s))
                now = self._units(hidden)
            terms |= self._terms_over(self._interval(start_s), start_s, splats, ids, base, hidden, now)
        return {name: weights[name] * term for name, term in terms.items()}

    def _terms_over(
        self, interval: float, start_s: float, splats: Splats, ids: Tensor, base: Tensor, hidden: Tensor, now: Tensor
    ) -> dict[str, Tensor]:
        """Those of "smooth", "ode" and "pinn" that are on, over so many seconds; none of an interval of 0.

        Args:
            start_s: when it begins.
            ids: [n] Gaussians.
            base, hidden: [n, width] the network's share of what belongs to them, and its hidden values at the start.
            now: [n] their temperatures at the start, in units of the network.
        """
        terms, wanted = {}, self.options.penalties
        if interval == 0:
            return terms
        first_s, last_s = self._ends
        end_s = min(max(start_s + interval, first_s), last_s)  # the sum may round to a hair outside
        at_end = self.network(base, self._moment(end_s))
        later = self._units(at_end)
        if "smooth" in wanted:
            terms["smooth"] = heat_terms.change(now, later)
        if self.options.balanced:
            areas = self.balance.areas(splats, ids, self.metres_per_unit)
            first_rate = self._rate(now, self._body(splats, ids, base, hidden), areas, start_s)
            if "ode" in wanted:
                middle_s = 0.5 * (start_s + end_s)
                middle = self._body(splats, ids, base, self.network(base, self._moment(middle_s)))
                rate = self._rate(now + interval / 2 * first_rate, middle, areas, middle_s)
                terms["ode"] = heat_terms.integration(now, later, rate, interval)
            if "pinn" in wanted:
                rate = 0.5 * (first_rate + self._rate(later, self._body(splats, ids, base, at_end), areas, end_s))
                terms["pinn"] = heat_terms.difference_quotient(now, later, rate, interval, self.options.interval_s[1])
        return terms

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        return self.range.kelvin(self.features(splats, Query(ids, time_s=time_s))[:, 0])

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Emissivity, absorptivity, convection and capacity at the time of the query; nothing in the first stage."""
        if not self._network_emits:
            return {}
        base = self._base(splats, query.ids)
        return self._body(splats, query.ids, base, self.network(base, self._moment(query.time_s)))

    def prior(self, splats: Splats) -> dict[str, Tensor]:
        """Attributes of the classes, each [N]; NaN where there is no class. Empty for models that use no labels."""
        if not self.options.labelled:
            return {}
        return dict(zip(ATTRIBUTES, reference(splats["label"].detach().long()).unbind(1), strict=True))

    def effects(self) -> dict[str, dict]:
        missing = self._missing_columns
        used = [name for name in WEATHER_COLUMNS if name not in missing]
        effects = {"relaxation": {"network_sees": used, "left_out": missing, "time": self._time}}
        if self.options.balanced:
            effects |= self.balance.effects(self.weather)
            effects["radiation"]["materials"] = "inferred" if self.options.inferred else "table"
        return effects

    @property
    def cost(self) -> int:
        code = 6 * self.options.position_frequencies  # sines
        return self.network.cost + self.network.heads["temperature"].weight.numel() + code

    # The network ----------------------------------------------------------------------------------------

    @property
    def _network_emits(self) -> bool:
        taken_over = self.path is not None and not self.training
        return taken_over or bool(self.emits)

    @property
    def _time(self) -> str:
        return self.options.time if self.options.time == "none" else "day" if self.daily else "record"

    @property
    def _missing_columns(self) -> list[str]:
        if self.weather is None:
            return []
        return [name for name in WEATHER_COLUMNS if getattr(self.weather, name) is None]

    @property
    def _ramp(self) -> float:
        return min(1.0, (self._step - self.first_steps + 1) / (self.options.ramp_steps + 1))

    def _interval(self, time_s: float) -> float:
        """Seconds from the view to the other end of the interval: forward, or back where the record ends."""
        shortest, longest = self.options.interval_s
        wanted = shortest + (longest - shortest) * math.fmod(self._step * GOLDEN, 1.0)
        first_s, last_s = self._ends
        return wanted if time_s + wanted <= last_s else max(-wanted, first_s - time_s)

    @property
    def _ends(self) -> tuple[float, float]:
        """First and last second of the weather record."""
        return float(self.weather.times_s[0]), float(self.weather.times_s[-1])

    def _base(self, splats: Splats, ids: Tensor | None) -> Tensor:
        """What the network's first layer makes of all that belongs to the Gaussians, [n, width]."""
        rows = Query(ids).rows
        parts = []
        if self.options.position_frequencies:
            parts.append(octaves(self.box.places(rows(splats.means.detach())), self.options.position_frequencies))
        if self.options.features == "labels":
            labels = rows(splats["label"].detach())[:, None]
            parts.append((labels == torch.arange(len(CLASSES), device=labels.device)).to(self.network.own.weight))
        elif self.options.features_each:
            parts.append((rows(splats["feature"]) - self.feature_mean) / self.feature_scale)
        return self.network.own(torch.cat(parts, 1))

    def _moment(self, time_s: float) -> Tensor:
        """Encoded time and weather of a moment, as the network sees them."""
        mean, scale = self.weather_mean.cpu(), self.weather_scale.cpu()
        weather = torch.where(scale > 0, (self._weather_at(time_s).nan_to_num() - mean) * scale, 0.0)
        parts = [weather]
        if self.options.time != "none":
            share = 2.0 * math.fmod(time_s / DAY_S, 1.0) if self.daily else self._share_of_record(time_s)
            phase = torch.tensor([[share]], dtype=torch.float64)
            parts.append(octaves(phase, self.options.time_frequencies, self.slow_octaves)[0])
        return torch.cat(parts).to(self.network.own.weight)

    def _share_of_record(self, time_s: float) -> float:
        """What the network sees of a moment as the share of the images' record that has passed.

        The balance holds also where a penalty's interval reaches beyond the images. Where penalties ask for more than two such
        records, in which the code of time repeats, the clock stays from half a record before and behind the images on: two
        moments of different weather would be one.
        """
        if not self.training:
            return self.clock.within(time_s)
        (first_s, last_s), share = self._ends, self.clock.spans(time_s)
        if self.options.collocation == "view":
            reach_s = self.options.interval_s[1]
            first_s = max(first_s, self.clock.first_s - reach_s)
            last_s = min(last_s, self.clock.first_s + self.clock.span_s + reach_s)
        whole = self.clock.spans(last_s) - self.clock.spans(first_s)
        return share if whole < CODE_PERIOD else min(max(share, -0.25 * CODE_PERIOD), 0.75 * CODE_PERIOD)

    def _units(self, hidden: Tensor) -> Tensor:
        """Temperatures between T_min (0) and T_max (1), [n]."""
        return sigmoid(self.network.heads["temperature"](hidden)[:, 0])

    def _image_values(self, units: Tensor) -> Tensor:
        lower, width = self.range.lowest_k, self.range.bounds.span_k
        coldest, span = self.bounds_k.tolist()
        return (coldest - lower) / width + (span / width) * units

    def _raw_of(self, value: Tensor) -> Tensor:
        """What the head must give for an image value."""
        lower, width = self.range.lowest_k, self.range.bounds.span_k
        coldest, span = self.bounds_k.tolist()
        return torch.logit(((lower + width * value - coldest) / span).clamp(0.05, 0.95))

    def _weather_at(self, time_s: float) -> Tensor:
        """Present and past weather at a moment, as the network sees it before it is scaled."""
        present = columns_at(self.weather, time_s)
        return torch.cat([present, value_at(self.weather, self._past, time_s)]) if self.options.past_h else present

    def _body(self, splats: Splats, ids: Tensor | None, base: Tensor, hidden: Tensor) -> dict[str, Tensor]:
        """The four attributes, each [n], from hidden values [n, width] or from the table."""
        if self.options.attributes == "constant":
            hidden = self.network(base, torch.zeros_like(self.network.shared.weight[0]))
        if self.options.inferred:
            values = self.lowest + (self.highest - self.lowest) * sigmoid(self.network.heads["attributes"](hidden))
        else:
            values = reference(Query(ids).rows(splats["label"].detach()).long())
        return dict(zip(ATTRIBUTES, values.unbind(1), strict=True))

    def _rate(self, units: Tensor, body: dict[str, Tensor], areas: dict[str, Tensor], time_s: float) -> Tensor:
        """dT/dt of the balance at temperatures ``units``, in ranges per second, [n]."""
        coldest, span = self.bounds_k.tolist()
        return self.balance.rate(coldest + span * units, body, areas, self.weather, time_s) / span

    # The network of another run --------------------------------------------------------------------------

    def _network_of_another_run(self) -> dict[str, Tensor]:
        """Weights of the network in a checkpoint, and what its inputs and outputs are measured in."""
        if not self.path.is_file():
            raise SceneError(f"thermal.network: there is no checkpoint at {self.path}")
        weights = torch.load(self.path, map_location="cpu", weights_only=True).get("state_dict", {})
        own = self.state_dict()
        wanted = [name for name in own if name.startswith("network.") or name in TRAVELS]
        stored = {name: weights[f"thermal.{name}"] for name in wanted if f"thermal.{name}" in weights}
        differ = [name for name in wanted if name not in stored or stored[name].shape != own[name].shape]
        if differ:
            raise SceneError(
                f"thermal.network: the network of {self.path} is another one ({', '.join(differ[:4])} differ or are "
                "missing); give the width, blocks, frequencies and features of that run"
            )
        return stored
