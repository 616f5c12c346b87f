"""Photometry that wanders from image to image, as a code per image and one per Gaussian ("Thermal is Always Wild")."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.layers import draw_uniform
from heatsplat.thermal.wrapper import Wrapper


class Embedded(Wrapper):
    """(1 + g) x + b of what is emitted, with g and b a network's answer to the codes of the image and of the Gaussian.

    A code per training image lets brightness differ between images; a code per Gaussian lets it differ more here than
    there. The last layer starts at zero: before training nothing changes. A view that was not
    trained on gets the mean code of all images, which is the scene without the wandering.

    Tensors, beside the emission's: "embedding" [N, F].

    Args:
        emission: what is emitted otherwise, one channel.
        frame_size: of the code of an image.
        feature_size: F.
        width: units of each of two hidden layers.
        bound: of |g| and |b|, the latter in image units.
        weight: of the penalty, the mean square of the codes of images about their mean.
        lr, lr_end: learning rate of the network and the codes of images, and the factor on it at the end of the run.
        lr_feature: that of the Gaussians' codes.

    Raises:
        ValueError: a size or the bound is not positive, or the emission does not have one channel.
    """

    own_beyond_record = "its photometry is the mean of the record's"

    def __init__(
        self,
        emission: ThermalModel,
        frame_size: int = 16,
        feature_size: int = 8,
        width: int = 32,
        bound: float = 0.5,
        weight: float = 1e-3,
        lr: float = 1e-3,
        lr_end: float = 0.1,
        lr_feature: float = 5e-3,
    ) -> None:
        if min(frame_size, feature_size, width) < 1 or bound <= 0:
            raise ValueError(f"sizes and bound must be positive, got {frame_size}, {feature_size}, {width}, {bound}")
        if emission.modality_channels != (1,):
            raise ValueError(f"the emission must have one channel, got {emission.modality_channels}")
        super().__init__({"emission": emission})
        self.frame_size, self.feature_size, self.bound, self.weight = frame_size, feature_size, bound, weight
        self.lr, self.lr_end, self.lr_feature = lr, lr_end, lr_feature
        self.codes = nn.Parameter(torch.zeros(0, frame_size))
        self.register_buffer("frame_ids", torch.zeros(0, dtype=torch.int64))  # of the training images
        # The first layer sees the code of an image once for all Gaussians and their codes apart.
        self.of_frame, self.of_feature = nn.Linear(frame_size, width, bias=False), nn.Linear(feature_size, width)
        self.hidden, self.head = nn.Linear(width, width), nn.Linear(width, 2)
        with torch.no_grad():
            self.head.weight.zero_()
            self.head.bias.zero_()

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.frame_ids = torch.tensor([frame.frame_id for frame in scene.train.frames])
        self.codes = nn.Parameter(torch.zeros(len(self.frame_ids), self.frame_size))

    @torch.no_grad()
    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        draw_uniform((self.of_frame, self.of_feature, self.hidden), seeds.generator)
        self.codes.copy_(0.1 * torch.randn(self.codes.shape, generator=seeds.generator))
        feature = 0.1 * torch.randn(len(seeds.means), self.feature_size, generator=seeds.generator)
        return super().per_gaussian(seeds) | {"embedding": PerGaussian(feature, self.lr_feature, paced=False)}

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        hidden = self.of_feature(query.rows(splats["embedding"])) + self.of_frame(self.code(query.frame_id))
        gain, level = (self.bound * self.head(self.hidden(hidden.relu()).relu()).tanh()).split(1, 1)
        return values + (gain * values + level)

    def code(self, frame_id: int | None) -> Tensor:
        """That of a training image, and of any other view the mean of all, [frame_size]."""
        own = (self.frame_ids == frame_id).nonzero() if frame_id is not None else ()
        return self.codes[int(own[0])] if len(own) else self.codes.mean(0)

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        terms = super().regularisers(splats)
        if self.weight == 0:
            return terms
        return terms | {"codes": self.weight * (self.codes - self.codes.mean(0)).square().mean()}

    def effects(self) -> dict[str, dict]:
        return super().effects() | {"frame_offset": {"codes": len(self.frame_ids)}}

    @property
    def cost(self) -> int:
        return super().cost + sum(layer.weight.numel() for layer in (self.of_feature, self.hidden, self.head)) + 2
