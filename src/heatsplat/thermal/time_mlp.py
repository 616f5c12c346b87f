"""ThermalGS-style: a network of a Gaussian's own feature and of time gives how far its temperature is from its mean."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Rate, Seeds, ThermalModel
from heatsplat.thermal.coordinates import Clock, ImageRange, octaves
from heatsplat.thermal.layers import Head, draw_uniform
from heatsplat.thermal.wrapper import Wrapper

ENCODER = ("moment", "code")  # parameters of the time encoder begin so


class TimeMlp(Wrapper):
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

    paced = True
    own_beyond_record = "what the network adds stays as at the nearest moment of the record"

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
        super().__init__({"emission": emission}, needs={"time"})
        if min(feature_size, width, code_size, time_frequencies) < 1:
            raise ValueError(
                "feature_size, width, code_size and time_frequencies must be at least 1, got "
                f"{feature_size}, {width}, {code_size}, {time_frequencies}"
            )
        self.feature_size, self.time_frequencies, self.first_steps = feature_size, time_frequencies, first_steps
        self.lr, self.lr_time, self.lr_end, self.lr_feature = lr, lr_time, lr_end, lr_feature
        self.moment, self.code = nn.Linear(1 + 2 * time_frequencies, code_size), nn.Linear(code_size, code_size)
        # The first layer sees the code of a time once for all Gaussians and their features apart.
        self.of_code, self.of_feature = nn.Linear(code_size, width, bias=False), nn.Linear(feature_size, width)
        self.hidden, self.head = nn.Linear(width, width), Head(width, 1)
        with torch.no_grad():
            self.head.weight.zero_()
            self.head.bias.zero_()
        self.clock, self.range = Clock(), ImageRange()
        self.register_buffer("changes", torch.tensor(first_steps == 0))

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.clock.prepare(scene)
        self.range.prepare(scene)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((self.moment, self.code, self.of_code, self.of_feature, self.hidden), seeds.generator)
        feature = 0.1 * torch.randn(len(seeds.means), self.feature_size, generator=seeds.generator)
        return super().per_gaussian(seeds) | {"feature": PerGaussian(feature, self.lr_feature)}

    def on_step(self, step: int) -> None:
        super().on_step(step)
        self.changes.fill_(step >= self.first_steps)

    def features(self, splats: Splats, query: Query) -> Tensor:
        return super().features(splats, query).clamp(min=0.0)

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        if not self.changes:
            return values
        return values + self.change(query.rows(splats["feature"]), query.time_s)[:, None].to(values)

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        level = super().temperature(splats, time_s, ids)
        if level is None or not self.changes:
            return level
        with torch.no_grad():
            return level + self.range.bounds.span_k * self.change(Query(ids).rows(splats["feature"]), time_s)

    def rate_of(self, name: str) -> Rate:
        own = super().rate_of(name)
        return own._replace(lr=self.lr_time) if name.startswith(ENCODER) else own

    @property
    def cost(self) -> int:
        products = sum(layer.weight.numel() for layer in (self.of_feature, self.hidden, self.head))
        return super().cost + products

    def change(self, features: Tensor, time_s: float | None) -> Tensor:
        """ΔT in image units of Gaussians with ``features`` [n, F] at a time, [n]; that of the record's end beyond it.

        Raises:
            ValueError: there is no time.
        """
        when = torch.tensor([[self.clock.within(time_s)]], dtype=torch.float64, device=features.device)
        moment = torch.cat((when, octaves(when, self.time_frequencies)), 1)[0].to(features)
        code = self.code(self.moment(moment).relu())
        hidden = (self.of_feature(features) + self.of_code(code)).relu()
        return self.head(self.hidden(hidden).relu())[:, 0]
