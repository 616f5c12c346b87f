"""NTR-Gaussian: cooling by convection and radiation, integrated over the last hour with coefficients from networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm

from heatsplat.contracts import SceneData, check_option
from heatsplat.physics.units import DAY_S, STEFAN_BOLTZMANN
from heatsplat.same_bits import mean, sigmoid, softplus
from heatsplat.splats import Splats
from heatsplat.thermal.base import KELVIN_RANGE, PerGaussian, Query, Rate, Seeds, ThermalModel
from heatsplat.thermal.clipping import clipped
from heatsplat.thermal.coordinates import (
    Box,
    Clock,
    ImageRange,
    check_frames_per_cycle,
    octaves,
    sees_hours,
    slow_octaves,
)
from heatsplat.thermal.layers import Head, draw_uniform

TIMES = ("scene", "record", "day")
EXCHANGE = 10.0  # W/m²/K, unit of the exchange coefficient
STORAGE = 1.0e5  # J/m²/K, unit of the heat capacity: 5 cm of ground
ATTRIBUTE_NETWORKS = ("of_feature", "of_place", "of_state", "attribute_")  # what their parameters' names begin with
FIRST_COOLING = 0.25  # of the scene's range by radiation in a window, at most, with the networks as they start


class NtrGaussian(ThermalModel):
    """T(t) = T_net(s) - ∫_s^t [e σ T_net⁴ + h (T_net - T_env)] / c dt', by the trapezoid rule over at most ``window_s``.

    T_net is a network of place and time, T_env (and wind) one of time, and e, h, c are networks of T_net, T_env, wind,
    time and a feature of the Gaussian, c of its place too (NTR-Gaussian, CVPR 2025, section 3). For ``first_steps``
    every Gaussian emits one value while geometry settles, as in ``energy_network``; then geometry rests.

    Where it departs from the published code, which has σ = 5.76e-8 (two digits swapped): the integral starts from T_net
    at the window's start s and not at time 0; seconds, kelvin and W/m² throughout; e within (0, 1); the rendering of
    T_net beside that of T is replaced by a penalty on their difference per Gaussian, which needs no second image.

    **Convention:** kelvin and seconds inside, emission in image units.

    Args:
        width: of the layers of T_net; the attribute networks have half of it.
        nodes: of the trapezoid rule (paper: 6).
        window_s: longest window of the integral in seconds (paper: 3600).
        position_frequencies, time_frequencies: octaves of the encodings (paper: 10).
        time: "record" encodes the share of the record that has passed (paper), "day" the share of 24 hours; "scene" takes "day"
            where the scene has a weather record of more than a day, else "record".
        frames_per_cycle: training images to a cycle of an octave of time, at least: the networks do not see faster ones; None
            takes all octaves (paper).
        feature_size: numbers per Gaussian that are learned (paper: 32 from Feature-3DGS).
        first_steps: steps of the first stage.
        consistency: weight of the mean (T - T_net)², image units.
        environment: weight of the mean (T_env - ambient)², image units.
        variation: weight of the total variation in time of T_env, wind and T_net.
        integral: weight of the mean squared integral, image units (paper: 0.002).
        normalised: whether hidden values of the attribute networks are normalised in each Gaussian (LayerNorm; published code).
        lr, lr_end: learning rate of the networks and the factor on it at the end of the run.
        lr_attributes: learning rate of the attribute networks.
        lr_feature, lr_first: learning rates of features and of the first stage's value.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    needs = frozenset({"time", "thermal_range"})
    narrowest_range_k = KELVIN_RANGE
    paced = True
    beyond_record = "the networks see the hour, or the nearest moment of a record without weather of more than a day"

    def __init__(
        self,
        width: int = 32,
        nodes: int = 6,
        window_s: float = 3600.0,
        position_frequencies: int = 10,
        time_frequencies: int = 10,
        time: str = "scene",
        frames_per_cycle: float | None = 4.0,
        feature_size: int = 8,
        first_steps: int = 0,
        consistency: float = 1.0,
        environment: float = 1.0,
        variation: float = 1.0,
        integral: float = 0.002,
        normalised: bool = False,
        lr: float = 1.6e-3,
        lr_attributes: float = 1.6e-3,
        lr_end: float = 0.1,
        lr_feature: float = 2.5e-3,
        lr_first: float = 2.5e-3,
    ) -> None:
        super().__init__()
        if width < 2 or nodes < 2 or window_s <= 0 or min(position_frequencies, time_frequencies, feature_size) < 1:
            raise ValueError(
                "width and nodes must be at least 2, the encodings and feature_size at least 1 and window_s positive, got "
                f"{width}, {nodes}, {position_frequencies}, {time_frequencies}, {feature_size}, {window_s}"
            )
        if min(first_steps, consistency, environment, variation, integral) < 0:
            raise ValueError(
                "first_steps and the weights consistency, environment, variation and integral must not be negative, got "
                f"{first_steps}, {consistency}, {environment}, {variation} and {integral}"
            )
        check_option("time", time, TIMES)
        check_frames_per_cycle(frames_per_cycle)
        self.nodes, self.window_s, self.time, self.frames_per_cycle = nodes, window_s, time, frames_per_cycle
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        self.feature_size, self.first_steps = feature_size, first_steps
        self.weights = {
            "consistency": consistency,
            "environment": environment,
            "variation": variation,
            "integral": integral,
        }
        self.lr, self.lr_end, self.lr_feature, self.lr_first = lr, lr_end, lr_feature, lr_first
        half = max(width // 2, 2)
        places, times = 6 * position_frequencies, 2 * time_frequencies
        # Layers see a Gaussian's place and feature once per view and the time once per node; their sums meet here.
        self.place, self.moment = nn.Linear(places, width), nn.Linear(times, width, bias=False)
        self.hidden, self.temperature_head = nn.Linear(width, width), Head(width, 1)
        self.env = nn.Sequential(
            nn.Linear(times, width), nn.ReLU(), nn.Linear(width, half), nn.ReLU(), nn.Linear(half, 2)
        )
        self.of_feature, self.of_place = nn.Linear(feature_size, 3 * half), nn.Linear(places, half)
        self.of_state = nn.Linear(3 + times, 3 * half)
        self.attribute_heads = nn.Parameter(torch.zeros(3, half))
        if normalised:
            self.attribute_norm = nn.ParameterList(
                [nn.Parameter(torch.ones(3, half)), nn.Parameter(torch.zeros(3, half))]
            )
        self.normalised, self.lr_attributes = normalised, lr_attributes
        self.clock, self.box, self.range = Clock(), Box(), ImageRange()
        self.register_buffer("daily", torch.tensor(time == "day"))  # the networks see the hour of the day
        self.register_buffer("slow_octaves", torch.tensor(time_frequencies))  # those of time that the networks see
        self.register_buffer("ambient", torch.full((), 0.5))
        self.register_buffer("emits", torch.tensor(first_steps == 0))
        self._terms: dict[str, Tensor] = {}

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        for constants in (self.clock, self.box, self.range):
            constants.prepare(scene)
        frames = len(set(scene.train.times_s))
        self.daily.fill_(sees_hours(self.time, scene))
        slowest = self.clock.span_s / DAY_S if self.daily else 0.5
        self.slow_octaves.fill_(slow_octaves(self.time_frequencies, frames, self.frames_per_cycle, slowest))
        bounds = scene.thermal_range
        self.ambient.fill_(0.5 if scene.ambient_c is None else bounds.to_unit(scene.ambient_c))

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((module for module in self.modules() if isinstance(module, nn.Linear)), seeds.generator)
        feature = 0.1 * torch.randn(len(seeds.means), self.feature_size, generator=seeds.generator)
        tensors = {"feature": PerGaussian(feature, self.lr_feature)}
        if self.first_steps > 0:
            # Not paced: one value for all times has to be a mean over images that differ, and must not follow single ones.
            tensors["first_value"] = PerGaussian(seeds.values.mean(1), self.lr_first, paced=False)
        return tensors

    def on_step(self, step: int) -> None:
        self.emits.fill_(step >= self.first_steps)

    def features(self, splats: Splats, query: Query) -> Tensor:
        if not self.emits:
            return query.rows(splats["first_value"]).clamp(min=0.0)[:, None]
        units = self._units(splats, query.ids, float(query.time_s))
        return clipped(units, "straight_through")[:, None]

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """The penalties of the Gaussians that were last evaluated with a gradient; those of weight 0 are absent."""
        terms, self._terms = self._terms, {}
        return {f"ntr/{name}": self.weights[name] * term for name, term in terms.items() if self.weights[name] > 0}

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor:
        with torch.no_grad():
            if not self.emits:
                return self.range.kelvin(Query(ids).rows(splats["first_value"]))
            return self.range.kelvin(self._units(splats, ids, time_s))

    def rate_of(self, name: str) -> Rate:
        own = super().rate_of(name)
        return own._replace(lr=self.lr_attributes) if name.startswith(ATTRIBUTE_NETWORKS) else own

    def effects(self) -> dict[str, dict]:
        return {"relaxation": {"nodes": self.nodes, "window_s": self.window_s}, "radiation": {}, "convection": {}}

    @property
    def cost(self) -> int:
        per_view = self.place.weight.numel() + self.of_feature.weight.numel() + self.of_place.weight.numel()
        per_node = self.hidden.weight.numel() + self.of_state.out_features * 4 + 30
        return per_view + self.nodes * per_node

    # The integral ---------------------------------------------------------------------------------------

    @property
    def _storage(self) -> float:
        """Unit of the heat capacity in J/m²/K, of the record and range that it was trained on."""
        # A scene that hardly cools stores much heat. Otherwise the integral starts at many ranges, where it never learns.
        sent = 0.5 * STEFAN_BOLTZMANN * self.range.lowest_k**4 * min(self.clock.span_s, self.window_s)
        return max(STORAGE, sent / (FIRST_COOLING * self.range.bounds.span_k))

    def _units(self, splats: Splats, ids: Tensor | None, time_s: float) -> Tensor:
        """Temperatures [n] in image units at ``time_s``, or at the moment of the record that is nearest if hours do not count."""
        if not self.daily:
            time_s = min(max(time_s, self.clock.first_s), self.clock.first_s + self.clock.span_s)
        rows = (lambda tensor: tensor) if ids is None else (lambda tensor: tensor.index_select(0, ids))
        means, feature = rows(splats.means).detach(), rows(splats["feature"])
        code = octaves(self.box.places(means), self.position_frequencies)
        start = time_s - self.window_s if self.daily else max(self.clock.first_s, time_s - self.window_s)
        times = torch.linspace(start, time_s, self.nodes, dtype=torch.float64)
        shares = 2.0 * (times / DAY_S) if self.daily else (times - self.clock.first_s) / self.clock.span_s
        moments = octaves(shares[:, None], self.time_frequencies, self.slow_octaves).to(code)
        env, wind = self.env(moments).sigmoid().unbind(1)
        units = self._network(self.place(code), moments)
        rates = self._rates(units, env, wind, moments, feature, code)
        step = (time_s - start) / (self.nodes - 1)
        integral = step * (rates.sum(1) - 0.5 * (rates[:, 0] + rates[:, -1]))
        if torch.is_grad_enabled() and self.training and len(units):  # a mean over no Gaussian in view is NaN
            self._terms = {
                "consistency": mean((units[:, 0] - integral - units[:, -1]).square()),
                "environment": (env - self.ambient).square().mean(),
                "variation": sum(mean(values.diff(dim=-1).abs()) for values in (env, wind, units)),
                "integral": mean(integral.square()),
            }
        return units[:, 0] - integral

    def _network(self, place: Tensor, moments: Tensor) -> Tensor:
        """T_net in image units at all nodes, [n, nodes]."""
        hidden = (place[:, None] + self.moment(moments)[None]).relu()
        return sigmoid(self.temperature_head(self.hidden(hidden).relu())[..., 0])

    def _rates(
        self, units: Tensor, env: Tensor, wind: Tensor, moments: Tensor, feature: Tensor, code: Tensor
    ) -> Tensor:
        """How fast Gaussians cool at all nodes, [n, nodes] in image units per second."""
        weight = self.of_state.weight
        shared = torch.cat((env[:, None], wind[:, None], moments), 1) @ weight[:, 1:].T + self.of_state.bias
        own = self.of_feature(feature)
        own = torch.cat(
            (own[:, : -self.of_place.out_features], own[:, -self.of_place.out_features :] + self.of_place(code)), 1
        )
        hidden = (units[..., None] * weight[:, 0] + shared[None] + own[:, None]).unflatten(2, (3, -1))
        if self.normalised:
            gain, bias = self.attribute_norm
            hidden = gain * layer_norm(hidden, hidden.shape[-1:]) + bias
        raw = (hidden.relu() * self.attribute_heads).sum(-1)
        emissivity, exchange = sigmoid(raw[..., 0]), EXCHANGE * softplus(raw[..., 1])
        storage = self._storage * (softplus(raw[..., 2]) + 0.05)  # 5 kJ/m²/K at least: a sheet of metal
        span = self.range.bounds.span_k
        flux = emissivity * STEFAN_BOLTZMANN * self.range.kelvin(units).square().square() + exchange * span * (
            units - env
        )
        return flux / (storage * span)
