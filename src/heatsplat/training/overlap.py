"""What is done against many Gaussians in one pixel, with any density control: nothing, or resets of sizes and entropy."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from heatsplat.contracts import RenderOutput
from heatsplat.density.ops import Cloud
from heatsplat.same_bits import mean
from heatsplat.splats import ANCHORS, GAUSSIANS, NOTHING
from heatsplat.training.rng import generator_for

RECOVERY = 0.5  # share of the steps between two resets after which sizes have come back (ours)


class Overlap:
    """Does nothing: nothing is stored and nothing is computed.

    Attributes:
        rows: of which models (``ThermalModel.rows``) it knows the rows of the splats.
        planned: function of a step to that of the plan for which it stands (``Schedule.planned``), as the run tells it.
    """

    rows = frozenset({GAUSSIANS, ANCHORS, NOTHING})
    planned: Callable[[float], float] = staticmethod(lambda step: step)

    def signs_at(self, step: int, count: int, seed: int) -> Tensor | None:
        """Random signs [N] to be composited in this step (``rasterization``); None where ``entropy`` is not wanted."""
        return None

    def entropy(self, output: RenderOutput) -> Tensor:
        """A loss term, a scalar, where ``signs_at`` gave signs; here there are none, and it is 0."""
        return output.features.new_zeros(())

    def shrink(self, cloud: Cloud, step: int) -> bool:
        """Told after every training step; may reset sizes. Whether it did."""
        return False

    def settled(self, step: int) -> bool:
        """Whether images after ``step`` tell how good the Gaussians are: not shortly after a reset of sizes."""
        return True


class ShortLists(Overlap):
    """Resets sizes, and pulls blending weights apart, so that each Gaussian keeps to the pixels where it counts.

    A reset multiplies all semi-axes and forgets all of the optimiser's moments. Gaussians grow back only as far as the
    image wants them to. While a stage holds sizes still there is none.

    The entropy of a pixel is that of order 2, 1 - Σ w² - T²: w its blending weights, T the transmittance that is left. It is
    smallest where one Gaussian has all. The paper takes Shannon's, whose gradient needs the weight of each Gaussian in each
    pixel, from kernels made for it. Order 2 needs none: with random signs s, (Σ w s)² is Σ w² in the mean over signs, and
    Σ w s is an image of one more channel.

    Steps are those of the plan: where the end of a run is moved, resets and entropy are moved with it.

    Args:
        entropy: weight of the mean entropy of a pixel. 0: none.
        entropy_every: steps between two that have it.
        entropy_start, entropy_stop: first step with it, and the step from which on there is none.
        reset_factor: on all semi-axes at a reset. 1: no resets.
        reset_every: steps between resets, which fall on multiples of it.
        reset_start, reset_stop: first step at which there may be one, and the step from which on there is none.

    Raises:
        ValueError: an option is out of its range.

    Source: Speeding Up the Learning of 3D Gaussians with Much Shorter Gaussian Lists (CVPR 2026).
    """

    rows = frozenset({GAUSSIANS, ANCHORS})

    def __init__(
        self,
        entropy: float = 0.015,
        entropy_every: int = 2,
        entropy_start: int = 8000,
        entropy_stop: int = 25_500,
        reset_factor: float = 0.2,
        reset_every: int = 4000,
        reset_start: int = 8000,
        reset_stop: int = 16_500,
    ) -> None:
        if entropy < 0 or not 0 < reset_factor <= 1 or min(entropy_every, reset_every) < 1:
            raise ValueError(
                "overlap.entropy must not be negative, reset_factor lies in (0, 1], entropy_every and reset_every are at least "
                f"1, got {entropy}, {reset_factor}, {entropy_every}, {reset_every}"
            )
        self.weight, self.entropy_every = entropy, entropy_every
        self.entropy_start, self.entropy_stop = entropy_start, entropy_stop
        self.reset_factor, self.reset_every = reset_factor, reset_every
        self.reset_start, self.reset_stop = reset_start, reset_stop

    def signs_at(self, step: int, count: int, seed: int) -> Tensor | None:
        wanted = self.entropy_start <= self.planned(step) < self.entropy_stop and step % self.entropy_every == 0
        if self.weight == 0 or not wanted:
            return None
        return 2.0 * torch.randint(2, (count,), generator=generator_for(seed, step, "signs")) - 1.0

    def entropy(self, output: RenderOutput) -> Tensor:
        alone = output.signed.square() + (1.0 - output.alpha[0]).square()
        return self.weight * (1.0 - mean(alone))

    def _last_reset(self, step: int) -> float:
        """The steps of the plan after which sizes were reset last, up to ``step``; 0 before the first."""
        last = min(self.planned(step + 1), self.reset_stop - 1) // self.reset_every * self.reset_every
        return last if self.reset_factor < 1 and last >= self.reset_start else 0

    @torch.no_grad()
    def shrink(self, cloud: Cloud, step: int) -> bool:
        if not 0 < self._last_reset(step) > self.planned(step) or cloud.is_held("log_scales"):
            return False
        cloud.overwrite("log_scales", cloud.splats["log_scales"] + math.log(self.reset_factor))
        if cloud.optimizer is not None:
            cloud.optimizer.state.clear()
        return True

    def settled(self, step: int) -> bool:
        last = self._last_reset(step)
        return last <= 0 or self.planned(step + 1) - last >= int(RECOVERY * self.reset_every)
