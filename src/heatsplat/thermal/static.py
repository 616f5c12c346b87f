"""A scene that does not change: every Gaussian emits one value, or one that depends on the direction of view (3DGS)."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from heatsplat.contracts import SceneData, check_option
from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.coordinates import ImageRange
from heatsplat.thermal.view_harmonics import BASIS_COST, active_degree, spherical_harmonics_of

MODALITIES = ("thermal", "rgb")


class Static(ThermalModel):
    """Emission max(0, 1/2 + sum of spherical harmonics of the direction of view), as in 3DGS.

    Tensors: "sh0" [N, 1, C] and, from degree 1, "sh_rest" [N, B - 1, C]. Degree 0 computes no direction. With
    companions their channels follow those of the image, so that Gaussians have C channels in all.

    Args:
        sh_degree: 0 (emission without direction) to 3.
        channels: of the image; 1 for thermal images, 3 for RGB and pseudo-colour.
        modality: the image that is explained, "thermal" or "rgb".
        sh_degree_interval: steps after which training adds the next degree; 0 trains all from the start.
        lr: learning rate of "sh0"; that of "sh_rest" is a twentieth.
        floor: False leaves values below zero as they are, for what comes after to decide.
        companions: further images on the same Gaussians, modality -> channels, such as {"rgb": 3}.
        shared_opacity: False gives each image opacities of its own.
        prefix: before the names of its tensors, for a model beside another whose tensors are called the same.

    Raises:
        ValueError: an option is unknown or out of its range, or the image is a companion of itself.
    """

    beyond_record = "every Gaussian emits what it emits at all times"

    def __init__(
        self,
        sh_degree: int = 0,
        channels: int = 1,
        modality: str = "thermal",
        sh_degree_interval: int = 1000,
        lr: float = 2.5e-3,
        floor: bool = True,
        companions: Mapping[str, int] | None = None,
        shared_opacity: bool = True,
        prefix: str = "",
    ) -> None:
        super().__init__()
        self.bands = spherical_harmonics.band_count(sh_degree)
        self.sh_degree = sh_degree
        self.active_degree = sh_degree  # after training all are active; the bands never reached are zero
        companions = dict(companions or {})
        if modality in companions:
            raise ValueError(f"companions are images beside the {modality} one; leave {modality} out of them")
        check_option("modality", modality, MODALITIES)
        for name in companions:
            check_option("companions", name, MODALITIES)
        counts = {"channels": channels} | {f"companions.{name}": count for name, count in companions.items()}
        for key, count in counts.items():
            if not isinstance(count, int) or count < 1:
                raise ValueError(f"{key} must be a whole number, 1 or more, got {count}")
        if sh_degree_interval < 0:
            raise ValueError(f"sh_degree_interval must be a number of steps, or 0, got {sh_degree_interval}")
        self.modality, self.companions = modality, tuple(companions)
        self.modality_channels = (channels, *companions.values())
        self.shared_opacity = shared_opacity
        self.sh_degree_interval = sh_degree_interval
        self.lr, self.floor = lr, floor
        self.sh0, self.sh_rest = f"{prefix}sh0", f"{prefix}sh_rest"
        self.range = ImageRange()

    def prepare(self, scene: SceneData) -> None:
        self.range.prepare(scene)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        channels = sum(self.modality_channels)
        count = seeds.means.shape[0]
        if seeds.values.shape != (count, channels):
            raise ValueError(
                f"{type(self).__name__} with channels={channels} needs seed values [{count}, {channels}], got "
                f"{list(seeds.values.shape)}; set channels to what the images have"
            )
        tensors = {self.sh0: PerGaussian((seeds.values[:, None] - 0.5) / spherical_harmonics.C0, self.lr)}
        if self.sh_degree > 0:
            tensors[self.sh_rest] = PerGaussian(seeds.values.new_zeros(count, self.bands - 1, channels), self.lr / 20)
        return tensors

    def on_step(self, step: int) -> None:
        self.active_degree = active_degree(step, self.sh_degree, self.sh_degree_interval)

    def features(self, splats: Splats, query: Query) -> Tensor:
        rest = splats[self.sh_rest] if self.active_degree > 0 else None
        values = spherical_harmonics_of(splats[self.sh0], rest, splats.means, query, self.active_degree)
        return (values + 0.5).clamp(min=0.0) if self.floor else values + 0.5

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        if self.modality != "thermal" or self.modality_channels[0] != 1:
            return None
        return self.range.kelvin(spherical_harmonics.C0 * Query(ids).rows(splats[self.sh0])[:, 0, 0] + 0.5)

    def effects(self) -> dict[str, dict]:
        return {"view_dependence": {"degree": self.sh_degree}} if self.sh_degree > 0 else {}

    @property
    def cost(self) -> int:
        return BASIS_COST[self.sh_degree] + self.bands * sum(self.modality_channels)
