"""The contract of density control: what decides how many Gaussians there are, and where."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput, SceneData
from heatsplat.density.ops import Cloud
from heatsplat.splats import GAUSSIANS

ORIGIN = "intervals_from"  # of a plan that was moved: the step, not rounded, from which intervals are counted
ROUNDING = 1e-6  # of steps: what came with the step at which a plan is moved has come


@dataclass(frozen=True)
class DensityChange:
    """What one refinement did: Gaussians added and removed, and whether opacities were reset."""

    added: int = 0
    removed: int = 0
    opacity_reset: bool = False


class DensityControl:
    """Decides which Gaussians are duplicated, split and pruned: gsplat calls it a strategy.

    Its state is a dict of [N, ...] tensors kept outside, in the Cloud. The default does nothing at all, which is ``fixed``.

    Attributes:
        rows: what rows of the splats may be that it counts on (``heatsplat.splats``).
        cap_max: never more Gaussians than this, from the start on; it may be set during a run. None: no Gaussians are added.
        milestones, intervals: names of its attributes that are steps of the run, and numbers of steps (``retime``).
        shortest: what an interval has at least.
        initial_count: Gaussians at the start of the run, as the run tells it.
        opacities_until: step from which on a stage holds opacities still until the run ends, as the run tells it; infinity: none.
    """

    rows: frozenset[str] = frozenset({GAUSSIANS})
    cap_max: float | None = None
    milestones: tuple[str, ...] = ()
    intervals: tuple[str, ...] = ()
    shortest: int = 1
    initial_count: int = 0
    opacities_until: float = math.inf
    _times: dict[str, Any] = {}  # of those attributes, not rounded, once they were moved

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """Per-Gaussian statistics before the first step, each [count, ...]."""
        return {}

    def prepare(self, scene: SceneData, modality: str) -> None:
        """Takes what it needs of the scene, before anything is trained: how noisy its images are, how many there are."""
        return

    def absgrad_at(self, step: int) -> bool:
        """Whether ``observe`` wants the absolute gradients of single pixels in this step; False costs nothing."""
        return False

    def maps_at(self, step: int) -> int:
        """How many maps over pixels it wants summed by blending weights in this step (``pixel_maps``); 0 costs nothing."""
        return 0

    def pixel_maps(self, error: Tensor, target: Tensor, step: int) -> Tensor:
        """The maps [H, W, S], S = ``maps_at(step)``, here 0; ``observe`` finds their sums in ``output.weighted.sums``.

        Args:
            error: [H, W] absolute error of each pixel in image units, mean over channels, 0 where a pixel does not count; on
                the grid on which training renders.
            target: [H, W, C] the training image on that grid, in image units; NaN where a pixel does not count.
            step: training step.
        """
        return error.new_zeros(*error.shape, 0)

    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        """Takes what it needs from a rendered view after the backward pass. Changes ``state`` in place."""
        return

    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        """Adds and removes Gaussians after the optimiser's step, through ``cloud`` only. None when it did nothing.

        Args:
            cloud: splats with their optimiser moments and statistics.
            step: training step, counted from 0.
            extent: length unit of the scene (SceneData.extent).
            generator: for random draws at this step.
        """
        return None

    def retime(self, step: int, factor: float) -> None:
        """Moves the rest of its plan: what was to come n steps after ``step`` comes ``factor`` times n after it.

        What comes at intervals goes on from where it was between two of them: counted from the first step at another interval,
        the next could follow the last at once.
        """

        def moved(milestone: Any) -> Any:
            if milestone is None:
                return None
            if isinstance(milestone, list | tuple):
                return [moved(one) for one in milestone]
            return milestone if milestone <= step else step + factor * (milestone - step)

        now = {name: self._times.get(name, getattr(self, name)) for name in (*self.milestones, *self.intervals)}
        known = {name: now[name] for name in self.intervals if now[name] is not None}
        times = {name: moved(now[name]) for name in self.milestones}
        times |= {name: factor * interval for name, interval in known.items()}
        self.load_times(times | {ORIGIN: step + factor * (self._times.get(ORIGIN, 0) - step)})

    def _comes_after(self, name: str, number: int) -> int:
        """Steps after which what comes at an interval comes for the ``number``-th time."""
        return math.ceil(self._times.get(ORIGIN, 0) + number * self._interval(name) - ROUNDING)

    def _times_come(self, name: str, steps: float) -> int:
        """How often what comes at an interval has come after so many steps."""
        number = math.floor((steps - self._times.get(ORIGIN, 0)) / self._interval(name)) + 1
        while number > 0 and self._comes_after(name, number) > steps:
            number -= 1
        return max(number, 0)

    def _comes(self, name: str, step: int) -> bool:
        """Whether what comes at an interval comes with a step, counted from 0."""
        return step + 1 == self._comes_after(name, self._times_come(name, step + 1))

    def _interval(self, name: str) -> float:
        return max(self._times.get(name, getattr(self, name)), self.shortest)

    def times(self) -> dict[str, Any]:
        """Plain numbers for a checkpoint, from which ``load_times`` restores a plan that was moved; empty if it was not."""
        return dict(self._times)

    def load_times(self, times: Mapping[str, Any]) -> None:
        """Goes on with the plan of ``times``."""
        self._times = dict(times)
        for name in times.keys() & {*self.milestones, *self.intervals}:
            value = times[name]
            least = self.shortest if name in self.intervals else 0
            setattr(self, name, _rounded(value, least))

    def settled(self, step: int) -> bool:
        """Whether images after ``step`` tell how good the Gaussians are: not shortly after a reset of opacities."""
        return True


def ndc_gradient_norms(output: RenderOutput, camera: Camera, absolute: bool = False) -> Tensor | None:
    """Norms [n] of the gradients of the visible Gaussians' screen positions; None where none came back.

    **Convention:** per unit of normalised device coordinates, two units per image side; in the order of "visible_ids".

    Args:
        output: a rendered view after the backward pass.
        camera: that of the view.
        absolute: of the absolute gradients of single pixels, summed (AbsGS).
    """
    means2d = output.meta["means2d"]
    gradients = getattr(means2d, "absgrad", None) if absolute else means2d.grad
    if gradients is None:
        return None
    half_size = gradients.new_tensor([camera.width / 2, camera.height / 2])
    return (gradients[output.meta["visible_ids"]] * half_size).norm(dim=1)


def _rounded(value: Any, least: int) -> Any:
    if isinstance(value, list):
        return tuple(_rounded(one, least) for one in value)
    return None if value is None else max(round(value), least)


class Merging:
    """Says what is done to the Gaussians of a run once it is trained, before its test. The default leaves them as they are."""

    def check(self, module: Any) -> None:
        """Raises SceneError, before training, where the Gaussians of a training module cannot be merged."""
        return

    def __call__(self, module: Any, cloud: Cloud) -> dict[str, Any] | None:
        """Merges Gaussians of a trained module; what came of it, for the report. None when it did nothing.

        Args:
            module: ``training.scene_model.SceneModel`` with its scene.
            cloud: its Gaussians with their moments, through which alone they come and go.
        """
        return None
