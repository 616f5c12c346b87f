"""A scene that does not change: every Gaussian emits one value, or one that depends on the direction of view (3DGS)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from heatsplat.contracts import KELVIN_AT_0_C, SceneData, ThermalRange
from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import Splats
from heatsplat.thermal.base import Emission, PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.harmonics import harmonics


class Static(ThermalModel):
    """Emission max(0, 1/2 + sum of spherical harmonics of the direction of view), as in 3DGS.

    Tensors: "sh0" [N, 1, C] and, from degree 1, "sh_rest" [N, B - 1, C]. Degree 0 computes no direction. With
    companions their channels follow those of the image, so that Gaussians have C channels in all.

    Args:
        degree: 0 (emission without direction) to 3.
        channels: of the image; 1 for thermal images, 3 for RGB and pseudo-colour.
        modality: the image that is explained, "thermal" or "rgb".
        degree_every: steps after which training adds the next degree; 0 trains all from the start.
        lr: learning rate of "sh0"; that of "sh_rest" is a twentieth.
        floor: False leaves values below zero as they are, for what comes after to decide.
        companions: further images on the same Gaussians, modality -> channels, such as {"rgb": 3}.
        shared_opacity: False gives each image opacities of its own.

    Raises:
        ValueError: the degree is not 0 to 3, or the image is a companion of itself.
    """

    def __init__(
        self,
        degree: int = 0,
        channels: int = 1,
        modality: str = "thermal",
        degree_every: int = 1000,
        lr: float = 2.5e-3,
        floor: bool = True,
        companions: Mapping[str, int] | None = None,
        shared_opacity: bool = True,
    ) -> None:
        super().__init__()
        self.bands = spherical_harmonics.band_count(degree)
        self.degree = degree
        self.active_degree = degree  # after training all are active; the bands never reached are zero
        companions = dict(companions or {})
        if modality in companions:
            raise ValueError(f"companions are images beside the {modality} one; leave {modality} out of them")
        self.modality, self.companions = modality, tuple(companions)
        self.modality_channels = (channels, *companions.values())
        self.shared_opacity = shared_opacity
        self.degree_every = degree_every
        self.lr, self.floor = lr, floor
        self.register_buffer("range_c", torch.full((2,), torch.nan, dtype=torch.float64))

    def prepare(self, scene: SceneData) -> None:
        if scene.thermal_range is not None:
            bounds = [scene.thermal_range.min_c, scene.thermal_range.max_c]
            self.range_c.copy_(torch.tensor(bounds, dtype=torch.float64))

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        channels = sum(self.modality_channels)
        count = seeds.means.shape[0]
        if seeds.values.shape != (count, channels):
            raise ValueError(
                f"{type(self).__name__} with channels={channels} needs seed values [{count}, {channels}], got "
                f"{list(seeds.values.shape)}; set channels to what the images have"
            )
        tensors = {"sh0": PerGaussian((seeds.values[:, None] - 0.5) / spherical_harmonics.C0, self.lr)}
        if self.degree > 0:
            tensors["sh_rest"] = PerGaussian(seeds.values.new_zeros(count, self.bands - 1, channels), self.lr / 20)
        return tensors

    def on_step(self, step: int) -> None:
        if self.degree_every > 0:
            self.active_degree = min(self.degree, step // self.degree_every)

    def features(self, splats: Splats, query: Query) -> Emission:
        rest = splats["sh_rest"] if self.active_degree > 0 else None
        values = harmonics(splats["sh0"], rest, splats.means, query, self.active_degree)
        return Emission((values + 0.5).clamp(min=0.0) if self.floor else values + 0.5)

    def temperature(self, splats: Splats, time_s: float) -> Tensor | None:
        if self.modality != "thermal" or self.modality_channels[0] != 1 or self.range_c.isnan().any():
            return None
        units = spherical_harmonics.C0 * splats["sh0"][:, 0, 0] + 0.5
        return ThermalRange(*self.range_c.tolist()).to_celsius(units) + KELVIN_AT_0_C

    def effects(self) -> dict[str, dict]:
        return {"view_dependence": {"degree": self.degree}} if self.degree > 0 else {}

    @property
    def cost(self) -> int:
        channels = sum(self.modality_channels)
        basis = {0: 0, 1: 12, 2: 27, 3: 48}[self.degree]  # normalising the direction and the polynomials in it
        return basis + self.bands * channels
