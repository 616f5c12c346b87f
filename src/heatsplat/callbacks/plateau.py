"""Stops a run early once more training gains less than noise lets anyone see."""

from __future__ import annotations

import logging
import math
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.callbacks.budget import BudgetClock
from heatsplat.contracts import SceneError
from heatsplat.physics.noise import noise_of_views

log = logging.getLogger("heatsplat")


class Plateau(pl.Callback):
    """Ends training when the last tenth of the plan gained little; what is left of the schedule runs out in a short tail.

    After every tenth of the planned steps, each training view's mean squared error in it is set against that in the tenth
    before. The camera's variance, judged from the images, is no error of the model and is taken away from both. The run is on
    a plateau where what was gained or lost and one standard error of it (over the views) are below ``min_gain`` of what is left
    (errors that rise are no plateau: Gaussians or the camera are still being rearranged), or where what is left is below
    ``min_gain`` of the camera's variance: held-out images of this camera would not show it.
    Learning rates are still high then. So the rest of the plan is spread over ``tail`` (``Schedule.end_at``), and no Gaussians
    are added in it.

    No run is stopped before its last round or stage has had two tenths of the plan, nor where opacities or sizes would be
    reset in the tail, which is too short to mend them.

    What came of it is in ``module.results.run["early_stop"]`` and so in the report. A resumed run stops where the uninterrupted
    one does.

    Args:
        after: share of the plan before which no run is stopped.
        min_gain: share of the error that a tenth of the plan must gain, above 0.
        tail: share of the planned steps over which the rest of the plan is spread.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, after: float = 0.3, min_gain: float = 0.02, tail: float = 0.1) -> None:
        if not (0 <= after < 1 and min_gain > 0 and 0 < tail <= 1):
            raise ValueError(
                "callbacks.plateau.after must lie in [0, 1), min_gain above 0 and tail in (0, 1], "
                f"got {after}, {min_gain} and {tail}"
            )
        self.after, self.min_gain, self.tail = after, min_gain, tail
        self._variance = 0.0
        self._now: dict[int, tuple[Any, int]] = {}  # frame_id -> sum of squared errors of its visits, and their number
        self._before: dict[int, float] = {}  # frame_id -> mean in the tenth before
        self._found: dict[str, Any] | None = None

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if any(isinstance(callback, BudgetClock) for callback in trainer.callbacks):
            raise SceneError("callbacks=plateau and budget= both move the end of the run: leave one out")
        if not module.resolution.whole:
            raise SceneError(
                "callbacks=plateau judges whole images, and steps of schedule=lattice see parts: leave it out"
            )
        self._variance = noise_of_views(module.scene.train, module.modality) ** 2

    @torch.no_grad()
    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: dict[str, Any], batch: Any, *_: Any
    ) -> None:
        if self._found is not None:
            return
        view, schedule, step = batch, module.schedule, trainer.global_step
        prediction, image = outputs["prediction"], view.image(module.modality)
        if view.counts and len(prediction) >= len(image):  # a coarse start tells nothing of full size
            total, visits = self._now.get(view.frame.frame_id, (0.0, 0))
            error = squared_error(prediction, image, view.known)
            self._now[view.frame.frame_id] = (total + error, visits + 1)
        tenth = max(1, round(schedule.steps / 10))
        if step % tenth:
            return
        now = {frame: float(total) / visits for frame, (total, visits) in self._now.items()}
        settled = self._settled(module, step - 1)
        changed = module.stages.last_change(schedule.steps)
        ready = not changed or step >= changed + 2 * tenth
        if settled and ready and schedule.progress(step) >= self.after and step < schedule.end:
            self._judge(module, step, now)
        # Errors shortly after a reset of opacities say nothing of what training gains.
        self._before, self._now = (now if settled else {}), {}

    def _judge(self, module: pl.LightningModule, step: int, now: dict[int, float]) -> None:
        """Moves the end of the run where it is on a plateau."""
        both = sorted(self._before.keys() & now.keys())
        if len(both) < 2:
            return
        gains = torch.tensor([self._before[frame] - now[frame] for frame in both], dtype=torch.float64)
        left = max(sum(now[frame] for frame in both) / len(both) - self._variance, 0.0)
        gain, unsure = gains.mean().item(), (gains.std() / math.sqrt(len(both))).item()
        flat = abs(gain) + unsure < self.min_gain * left
        hidden = left < self.min_gain * self._variance
        if not (flat or hidden):
            return
        schedule = module.schedule
        planned = schedule.end
        end = min(planned, step + self.tail * schedule.steps)
        if not all(self._settled(module, later) for later in range(step, math.ceil(end))):
            return  # asked again after the next tenth
        schedule.end_at(step, end)
        self._found = {
            "at_step": step,
            "planned_steps": planned,
            "steps": schedule.end,
            "gaussians": len(module.splats),
            "gained_percent": round(100 * gain / left, 3) if left else None,
            "standard_error_percent": round(100 * unsure / left, 3) if left else None,
            "residual": math.sqrt(left),
            "camera_noise": math.sqrt(self._variance),
            "why": "the last tenth gained too little" if flat else "what is left is below the noise of the camera",
        }
        self._hold(module)
        log.info(
            "plateau at step %d: %s; training ends at step %d of %d", step, self._found["why"], schedule.end, planned
        )

    @staticmethod
    def _settled(module: pl.LightningModule, step: int) -> bool:
        """Whether images after ``step`` tell how good the Gaussians are, and not how far they are from a reset."""
        return all(part.settled(module.schedule.round_step(step)) for part in (module.density, module.overlap))

    def _hold(self, module: pl.LightningModule) -> None:
        """Lets no more Gaussians come, for there is no time for them to settle."""
        if module.density.cap_max is not None:
            module.density.cap_max = min(module.density.cap_max, self._found["gaussians"])

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._found is None:
            return
        if module.schedule.end == self._found["steps"]:  # resumed in the tail
            self._hold(module)
        else:  # a run that goes on for longer than the one that was judged
            self._found, self._before, self._now = None, {}, {}

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._found is not None:
            module.results.run["early_stop"] = self._found

    # Resume ----------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        now = {frame: (float(total), visits) for frame, (total, visits) in self._now.items()}
        return {"now": now, "before": dict(self._before), "found": self._found}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._now, self._before, self._found = dict(state["now"]), dict(state["before"]), state["found"]


def squared_error(prediction: Tensor, image: Tensor, mask: Tensor | None) -> Tensor:
    """Mean squared difference of the pixels that count, on the grid of ``image`` [H, W, C]; finer predictions are averaged."""
    if prediction.shape != image.shape:
        prediction = functional.adaptive_avg_pool2d(prediction.permute(2, 0, 1), image.shape[:2]).permute(1, 2, 0)
    squares = (prediction - image).double().square().mean(-1)
    return (squares if mask is None else squares[mask]).mean()
