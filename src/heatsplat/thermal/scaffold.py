"""Scaffold-GS: anchors on a grid, from whose features networks make a few Gaussians each, anew for every view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from heatsplat.contracts import Camera, SceneData
from heatsplat.same_bits import mean, sigmoid
from heatsplat.splats import ANCHORS, Splats
from heatsplat.thermal.base import Geometry, PerGaussian, Query, Rate, Seeds, ThermalModel
from heatsplat.thermal.layers import draw_uniform

MARGIN = 0.15  # of the image's sides, by which an anchor may lie outside and still have Gaussians inside
NEAREST = 0.01  # camera z in extents from which on an anchor is looked at
HEADS = ("opacity", "shape", "value")


@dataclass(frozen=True)
class Decoded(Geometry):
    """A geometry with what the networks read of the anchors in view [a, F + 4], which the values need, too."""

    inputs: Tensor


class Scaffold(ThermalModel):
    """Anchors x_a, each with k Gaussians at x_a + O_i l_a that networks describe (Scaffold-GS, CVPR 2024, Eq. 3-9).

    Three networks of one hidden layer see the anchor's feature, the direction from the camera to it and its distance, and
    answer for all k at once: opacities in (-1, 1), of which those below zero are no Gaussians; semi-axes as shares in (0, 1)
    of three sizes of the anchor, and rotations; image values in (0, 1).

    Anchors are rows of the splats: their "means" stand still (optim.means=0) and "log_scales" are those three sizes; "quats"
    and "opacity_logits" wait for no one, as in the public code. Further tensors: "feature" [N, F], "offsets" [N, k, 3] (O)
    and "log_reach" [N, 3] (ln l).

    Where it departs from the public code: distances are in extents of the scene, the volume in extents³ and the learning
    rate of offsets is not multiplied by the extent, so that no number depends on the unit of the world.

    Args:
        gaussians: k.
        feature_size: F, and units of each hidden layer.
        channels: of the image; 1 for thermal images, 3 for RGB.
        modality: "thermal" or "rgb".
        distance: False leaves the distance out of what the networks see (public code since 2024-04; the paper has it).
        volume: weight of the mean product of semi-axes of the Gaussians of anchors in view.
        lr_feature, lr_offsets, lr_reach: learning rates of the anchors' tensors.
        lr_opacity, lr_shape, lr_value: those of the networks.
        ends: factors on the rates of offsets and of the three networks, in this order, at the end of the run.

    Raises:
        ValueError: a size is not positive.
    """

    rows = ANCHORS
    inseparable = "they are made anew for every view, from anchors"
    stays_here = "opacities, sizes, rotations and values of its Gaussians change with the view"
    beyond_record = "every Gaussian emits what it emits at all times"

    def __init__(
        self,
        gaussians: int = 10,
        feature_size: int = 32,
        channels: int = 1,
        modality: str = "thermal",
        distance: bool = True,
        volume: float = 0.01,
        lr_feature: float = 7.5e-3,
        lr_offsets: float = 1e-2,
        lr_reach: float = 7e-3,
        lr_opacity: float = 2e-3,
        lr_shape: float = 4e-3,
        lr_value: float = 8e-3,
        ends: tuple[float, float, float, float] = (0.01, 0.01, 1.0, 0.00625),
    ) -> None:
        super().__init__()
        if min(gaussians, feature_size, channels) < 1:
            raise ValueError(
                f"gaussians, feature_size and channels must be at least 1, got {gaussians}, {feature_size}, {channels}"
            )
        self.per_row, self.modality, self.modality_channels = gaussians, modality, (channels,)
        self.distance, self.volume = distance, volume
        self.rates = {"feature": lr_feature, "offsets": lr_offsets, "log_reach": lr_reach}
        self.end_offsets, *network_ends = ends
        self.network_rates = dict(zip(HEADS, map(Rate, (lr_opacity, lr_shape, lr_value), network_ends), strict=True))
        answers = zip(HEADS, (1, 7, channels), strict=True)
        seen = feature_size + 3 + distance
        self.networks = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Linear(seen, feature_size), nn.ReLU(), nn.Linear(feature_size, count * gaussians)
                )
                for name, count in answers
            }
        )
        self.register_buffer("extent", torch.ones(()))
        self._volumes: Tensor | None = None  # of the last geometry with a gradient, mean product of semi-axes

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        self.extent.fill_(scene.extent)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """Anchors start alike: networks tell them apart by the view alone until features have learned."""
        draw_uniform((net[i] for net in self.networks.values() for i in (0, 2)), seeds.generator)
        count, size = len(seeds.means), self.networks["value"][2].in_features
        return {
            "feature": PerGaussian(torch.zeros(count, size), self.rates["feature"]),
            "offsets": PerGaussian(torch.zeros(count, self.per_row, 3), self.rates["offsets"], lr_end=self.end_offsets),
            "log_reach": PerGaussian(seeds.log_scales.clone(), self.rates["log_reach"]),
        }

    def geometry(self, splats: Splats, query: Query) -> Geometry:
        """The Gaussians of the anchors in view; those of other anchors have no opacity and no rotation, which hides them."""
        with torch.no_grad():
            in_view = self._in_view(splats.means, query.camera)
            rows = in_view.nonzero().squeeze(1)
        inputs = self._inputs(splats, query.camera, rows)
        opacities = torch.tanh(self.networks["opacity"](inputs)).clamp(min=0.0)
        shape = self.networks["shape"](inputs).unflatten(1, (self.per_row, 7))
        scales = splats["log_scales"][rows].exp()[:, None] * sigmoid(shape[..., :3])
        means = splats.means[:, None] + splats["offsets"] * splats["log_reach"].exp()[:, None]
        if self.volume > 0 and torch.is_grad_enabled():
            self._volumes = mean((scales / self.extent).prod(2)) if len(rows) else scales.sum()

        def spread(values: Tensor) -> Tensor:
            """Rows of all Gaussians [k N, ...] from those of the anchors in view [a, k, ...]; zeros elsewhere."""
            every = values.new_zeros(len(splats), *values.shape[1:])
            return every.index_copy(0, rows, values).flatten(0, 1)

        return Decoded(
            means.flatten(0, 1),
            spread(shape[..., 3:]),
            spread(scales),
            spread(opacities)[None],
            inputs,
            in_view=in_view,
        )

    def features(self, splats: Splats, query: Query) -> Tensor:
        made = query.geometry if isinstance(query.geometry, Decoded) else self.geometry(splats, query)
        rows = made.in_view.nonzero().squeeze(1)
        values = sigmoid(self.networks["value"](made.inputs)).view(-1, self.modality_channels[0])
        first = torch.full((len(splats),), -1, device=values.device)
        first[rows] = torch.arange(len(rows), device=values.device)
        ids = torch.arange(len(splats) * self.per_row, device=values.device) if query.ids is None else query.ids
        place = first[ids // self.per_row] * self.per_row + ids % self.per_row
        if query.ids is None:  # who asks for all gets zeros for what is not in view
            return values.new_zeros(len(ids), values.shape[1]).index_copy(0, (place >= 0).nonzero()[:, 0], values)
        return values.index_select(0, place)

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        volumes, self._volumes = self._volumes, None
        return {} if volumes is None else {"volume": self.volume * volumes}

    def rate_of(self, name: str) -> Rate:
        return self.network_rates[name.split(".")[1]]

    def effects(self) -> dict[str, dict]:
        return {"view_dependence": {"anchors": self.per_row}}

    @property
    def cost(self) -> int:
        """Of an anchor, as are all rows."""
        return sum(layer.weight.numel() for network in self.networks.values() for layer in (network[0], network[2]))

    # Anchors --------------------------------------------------------------------------------------------

    def _in_view(self, anchors: Tensor, camera: Camera) -> Tensor:
        """Which anchors [N] the camera may see, a margin about the image included."""
        pixels, depths = camera.project(anchors)
        size = pixels.new_tensor([camera.width, camera.height])
        inside = ((pixels >= -MARGIN * size) & (pixels <= (1 + MARGIN) * size)).all(1)
        return inside & (depths > NEAREST * self.extent)

    def _inputs(self, splats: Splats, camera: Camera, rows: Tensor) -> Tensor:
        """What the networks see of anchors: feature, direction from the camera and, if asked for, distance in extents."""
        away = (splats.means[rows] - camera.center.to(splats.means)) / self.extent
        distances = away.norm(dim=1, keepdim=True).clamp(min=1e-12)
        seen = [splats["feature"][rows], away / distances]
        return torch.cat([*seen, distances] if self.distance else seen, dim=1)
