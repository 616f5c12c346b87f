"""ThermalGS-style: a network of a Gaussian's own feature and of time gives how far its temperature is from its mean."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.atmospheric_field import octaves
from heatsplat.thermal.base import Emission, Geometry, PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.layers import draw_uniform

ENCODER = ("moment", "code")  # parameters of the time encoder begin so


class TimeMlp(ThermalModel):
    """max(0, emission + ΔT), with ΔT a network's answer to a feature of the Gaussian and a code of the time.

    A reimplementation in the style of ThermalGS (Remote Sensing 2025, 17(2), 335), which has no public code: the paper ties
    Gaussians to a mesh of colour images and takes features from a network of its own; here geometry settles in a first
    stage, or is that of another run, and features are learned. ΔT is exactly 0 at first, and absent for ``first_steps``.

    Tensors: the emission's, and "feature" [N, F]. Time counts in spans of the training record.

    Args:
        emission: what splats emit without ΔT; it must not cut values below zero off (``Static``: floor=False).
        feature_size: F, numbers per Gaussian that are learned.
        width: of the two hidden layers of the network.
        code_size: numbers that the time encoder, a layer with ReLU and a linear one, gives.
        time_frequencies: octaves of time that the encoder sees beside time itself.
        first_steps: steps of the first stage.
        lr: learning rate of the network.
        lr_time: that of the time encoder.
        lr_end: factor on both at the end of the run.
        lr_feature: learning rate of features.

    Raises:
        ValueError: a size is not positive.
    """

    def __init__(
        self,
        emission: ThermalModel,
        feature_size: int = 16,
        width: int = 64,
        code_size: int = 16,
        time_frequencies: int = 4,
        first_steps: int = 0,
        lr: float = 2.5e-3,
        lr_time: float = 1e-3,
        lr_end: float = 1.0,
        lr_feature: float = 2.5e-3,
    ) -> None:
        super().__init__()
        if min(feature_size, width, code_size, time_frequencies) < 1:
            raise ValueError(
                "feature_size, width, code_size and time_frequencies must be at least 1, got "
                f"{feature_size}, {width}, {code_size}, {time_frequencies}"
            )
        self.emission = emission
        self.needs = emission.needs | {"time"}
        self.modality, self.companions = emission.modality, emission.companions
        self.modality_channels, self.shared_opacity = emission.modality_channels, emission.shared_opacity
        self.feature_size, self.time_frequencies, self.first_steps = feature_size, time_frequencies, first_steps
        self.lr, self.lr_time, self.lr_end, self.lr_feature = lr, lr_time, lr_end, lr_feature
        self.moment, self.code = nn.Linear(1 + 2 * time_frequencies, code_size), nn.Linear(code_size, code_size)
        # The first layer sees the code of a time once for all Gaussians and their features apart.
        self.of_code, self.of_feature = nn.Linear(code_size, width, bias=False), nn.Linear(feature_size, width)
        self.hidden, self.head = nn.Linear(width, width), nn.Linear(width, 1)
        with torch.no_grad():
            self.head.weight.zero_()
            self.head.bias.zero_()
        self.register_buffer("clock", torch.tensor([0.0, 1.0], dtype=torch.float64))  # origin and span of time
        self.register_buffer("span_k", torch.full((), torch.nan))
        self.register_buffer("changes", torch.tensor(first_steps == 0))

    def prepare(self, scene: SceneData) -> None:
        self.check(scene)
        self.emission.prepare(scene)
        self.clock.copy_(torch.tensor(scene.record, dtype=torch.float64))
        if scene.thermal_range is not None:
            self.span_k.fill_(scene.thermal_range.span_k)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((self.moment, self.code, self.of_code, self.of_feature, self.hidden), seeds.generator)
        feature = 0.1 * torch.randn(len(seeds.means), self.feature_size, generator=seeds.generator)
        return self.emission.per_gaussian(seeds) | {"feature": PerGaussian(feature, self.lr_feature)}

    def on_step(self, step: int) -> None:
        self.emission.on_step(step)
        self.changes.fill_(step >= self.first_steps)

    def features(self, splats: Splats, query: Query) -> Emission:
        emitted = self.emission.features(splats, query).features
        if self.changes:
            channels = self.modality_channels[0]
            change = self.change(query.rows(splats["feature"]), query.time_s)[:, None].to(emitted)
            emitted = torch.cat((emitted[:, :channels] + change, emitted[:, channels:]), 1)
        return Emission(emitted.clamp(min=0.0))

    def geometry(self, splats: Splats, query: Query) -> Geometry | None:
        return self.emission.geometry(splats, query)

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        return self.emission.regularisers(splats)

    def temperature(self, splats: Splats, time_s: float) -> Tensor | None:
        level = self.emission.temperature(splats, time_s)
        if level is None or not self.changes:
            return level
        with torch.no_grad():
            return level + self.span_k * self.change(splats["feature"], time_s)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        return self.emission.attributes(splats, query)

    def effects(self) -> dict[str, dict]:
        return self.emission.effects()

    def rate_of(self, name: str) -> tuple[float, float]:
        if name.startswith("emission."):
            return self.emission.rate_of(name.removeprefix("emission."))
        return self.lr_time if name.startswith(ENCODER) else self.lr, self.lr_end

    @property
    def cost(self) -> int:
        products = sum(layer.weight.numel() for layer in (self.of_feature, self.hidden, self.head))
        return self.emission.cost + products

    def change(self, features: Tensor, time_s: float | None) -> Tensor:
        """ΔT in image units of Gaussians with ``features`` [n, F] at a time, [n].

        Raises:
            ValueError: there is no time.
        """
        if time_s is None:
            raise ValueError("ThermalGS needs the time at which a scene is seen: give time_s")
        origin, span = self.clock.tolist()
        when = torch.tensor([[(float(time_s) - origin) / span]], dtype=torch.float64, device=self.clock.device)
        moment = torch.cat((when, octaves(when, self.time_frequencies)), 1)[0].to(features)
        code = self.code(self.moment(moment).relu())
        hidden = (self.of_feature(features) + self.of_code(code)).relu()
        return self.head(self.hidden(hidden).relu())[:, 0]
