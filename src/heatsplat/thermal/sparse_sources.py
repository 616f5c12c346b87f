"""Which Gaussians need a heat source: those whose temperature over the record relaxation alone cannot tell."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, evenly_spread
from heatsplat.physics.noise import MIN_NOISE, noise_of_views

log = logging.getLogger(__name__)

MOMENTS = 64  # of the record at which temperatures are compared, at most
RATES = torch.logspace(-2, 2, 512, dtype=torch.float64)  # per span; neighbours tell at most 4e-4 of the start apart
CHUNK = 8192  # Gaussians fitted at a time: 30 MB


class SparseSources:
    """At stated steps, finds the sources that are not needed and what relaxation tells in their place.

    A source is not judged by its own heat. Source and relaxation stand in for one another: on a synthetic scene that
    only cools, harmonics learned a median of 29 times the noise, which Gaussians' rates and their neighbours make up for.
    Judged is the temperature as a whole: the relaxation (initial state and rate) closest to it is found, and where it
    keeps within ``floor`` times the noise (root mean square over the record), the source goes and that relaxation stays.
    Taking the source alone would leave an error of all its heat.

    Args:
        drop_at: training steps; late enough that temperatures are learned and the number of Gaussians has settled.
        floor: in standard deviations of the camera's noise. One Gaussian of several in a pixel is known less well than the
            pixel: after the closest relaxation, a median of 15 is left where a scene only cools and of 49 in a heated one.
            A floor near 1 so drops nothing; 30 dropped 91 % and 25 % without loss, 60 dropped 66 % of the heated one's for
            1.3 dB.
        noise: that standard deviation in image units; None estimates it from training images, where detail of the scene
            makes it larger than it is.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, drop_at: Sequence[int], floor: float = 30.0, noise: float | None = None) -> None:
        if any(step < 0 for step in drop_at) or floor < 0 or (noise is not None and noise < 0):
            raise ValueError(
                "drop_sources_at, source_floor and source_noise must not be negative, "
                f"got {list(drop_at)}, {floor} and {noise}"
            )
        self.drop_at, self.floor, self.noise = frozenset(drop_at), floor, noise
        self.times_s: list[float] = []

    def prepare(self, scene: SceneData, modality: str) -> None:
        """Takes moments of the record and, unless it is given, the noise from the training views."""
        times = sorted(set(scene.train.times_s))
        self.times_s = [times[i] for i in evenly_spread(len(times), MOMENTS)]
        if self.noise is None:
            self.noise = noise_of_views(scene.train, modality)
            if self.noise <= MIN_NOISE:
                log.warning(
                    "neighbouring pixels of scene '%s' are equal, so its noise is unknown and no source is dropped; "
                    "give source_noise in image units (a third of a quantisation step at least)",
                    scene.name,
                )

    def needless(
        self, temperature: Callable[[float], Tensor], ambient: Tensor, span_s: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussians without need of a source, [N] bool, and for all the closest initial state and log of rate per span.

        Args:
            temperature: function from seconds to temperatures [N] in image units, not clipped.
            ambient: [] in image units.
            span_s: unit of time of rates.
        """
        above = torch.stack([temperature(time) for time in self.times_s]).double() - ambient.double()
        times = torch.tensor(self.times_s, dtype=torch.float64, device=above.device)
        times = (times - times[0]) / span_s  # the initial state is that of the first training image
        results = [relaxation_of(part, times) for part in above.split(CHUNK, dim=1)]
        start, rate, error = (torch.cat(parts) for parts in zip(*results, strict=True))
        return error <= self.floor * self.noise, (start + ambient).float(), rate.log().float()


def relaxation_of(above: Tensor, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Start and rate of the decay start e^{-rate t} closest to each column of ``above`` [F, n], and its rms error; [n] each.

    For a given rate the best start is a projection, so that only rates are searched.

    Args:
        above: float64.
        times: [F] float64, in the unit of time of rates.
    """
    rates = RATES.to(times.device)
    decays = torch.exp(-rates[:, None] * times)
    decays = decays / decays.norm(dim=1, keepdim=True)
    best = (decays @ above).abs().argmax(dim=0)
    decay = torch.exp(-rates[best] * times[:, None])
    start = (decay * above).sum(0) / decay.square().sum(0)
    return start, rates[best], (above - start * decay).square().mean(0).sqrt()
