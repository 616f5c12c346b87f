"""A run that ends when its time is up, its schedule complete."""

from __future__ import annotations

import logging
import statistics
from collections import deque
from collections.abc import Mapping
from typing import Any

import pytorch_lightning as pl

from heatsplat.callbacks.timing import CostMeter
from heatsplat.contracts import SceneError

log = logging.getLogger("heatsplat")

SETTLED = 0.5  # share of a round after which no Gaussian is added (density.stop)
EARLY = 0.1  # share of the time in which the plan is followed as it is: first steps are slow
WINDOW = 0.05  # share of the time over which the pace is measured: a machine may become slower at any moment
LATE = 0.4  # share of a round from which on growing is left to end as it goes
OFF = 0.1  # share of the steps left by which the plan may miss the time before it is moved, while Gaussians grow
ROUND = 1 / 3  # share of its planned steps that the last of several rounds has, whatever the time
LOOKS = 400  # looks at the clock in a run of the planned length


class BudgetClock(pl.Callback):
    """Ends training when its seconds are over, and lets the schedule end with it.

    The plan says how many steps fit, by a calibration of a few of them. The steps that are left are always those for which
    there is time at the pace of the last steps, more or fewer than planned, and what is left of the schedule is spread over them
    (``Schedule.end_at``). While Gaussians grow, growing is spread with it (``DensityControl.retime``): a machine that has become
    slower makes fewer steps, with as many Gaussians in the end. What those that are still to come will add to a step is counted
    by the calibration.

    Rounds (``stages.restarts``) begin at steps of their own: of such a run only the last round is spread. A machine that is
    much slower than the calibration would have no time left for it; it then has a third of its steps, beyond the budget, with a
    warning: what it is there for was not trained at all otherwise.

    Seconds are those of the plan's clock, ``cost.train_seconds`` or ``cost.cpu_seconds``: evaluation, start-up and the steps of
    warm-up are outside. What came of the budget is in ``module.results.run["budget"]``, the log and the report. A resumed run
    keeps its plan and its schedule.

    Args:
        plan: the plan (``heatsplat.runs.budget.Plan.as_dict``).
        twice: what twice the time would buy, in a sentence.
    """

    def __init__(self, plan: Mapping[str, Any], twice: str) -> None:
        self.plan, self.twice = dict(plan), twice
        self.seconds = float(plan["train_s"])
        self._seen: deque[tuple[int, float, int]] = deque()  # step, seconds and Gaussians at the last looks
        self._meter: CostMeter | None = None
        self._moved: int | None = None  # step at which the plan was first moved while Gaussians grew
        self._every = max(1, int(plan["steps"]) // LOOKS)

    # The run ---------------------------------------------------------------------------------------------------------

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._meter = next((callback for callback in trainer.callbacks if isinstance(callback, CostMeter)), None)
        if self._meter is None:
            raise SceneError(
                "budget needs callbacks.costs, which measures time: keep callbacks.costs on, or leave budget out"
            )

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        step, schedule = trainer.global_step, module.schedule
        if step % self._every != 0 and step < schedule.end - self._every:
            return
        spent = self._spent()
        self._seen.append((step, spent, len(module.splats)))
        while len(self._seen) > 2 and spent - self._seen[1][1] > WINDOW * self.seconds:
            self._seen.popleft()
        if step < max(schedule.restarts, default=0):
            return
        least = _least(schedule)
        progress, step_s, left = schedule.round_progress(step), self._step_s(), self.seconds - spent
        if left <= 0 and step >= least:
            schedule.end_at(step, step)
        elif step_s is None:
            return
        elif progress >= SETTLED:
            schedule.end_at(step, max(step + left / step_s, least))
        elif spent >= EARLY * self.seconds and progress < LATE:
            self._move(module, step, max(step + left / (step_s * self._dearer(progress)), least))

    def _move(self, module: pl.LightningModule, step: int, end: float) -> None:
        """Spreads the rest of the schedule, and of growing, over the steps up to ``end``, unless it ends near there."""
        planned = module.schedule.end
        if abs(end - planned) > OFF * (planned - step):
            module.density.retime(module.schedule.round_step(step), (end - step) / (planned - step))
            module.schedule.end_at(step, end)
            self._moved = step if self._moved is None else self._moved

    def _spent(self) -> float:
        return getattr(self._meter, self.plan["clock"])

    def _dearer(self, progress: float) -> float:
        """How much longer than one of the last steps those that are left will take, for the Gaussians that are still to come.

        Their number is taken to grow evenly until the schedule has settled, to where its mean over the run is the plan's.
        """
        points, mean, slope = self.plan["points"], self.plan["gaussians"], 1e-3 * self.plan["gaussian_us"]
        _, *counts = (count for *_, count in self._seen)
        gaussians, lately = counts[-1], statistics.fmean(counts)
        last = max((mean - 0.5 * SETTLED * points) / (1 - 0.5 * SETTLED), gaussians)
        growing = SETTLED - progress
        ahead = (growing * 0.5 * (gaussians + last) + (1 - SETTLED) * last) / (1 - progress)
        lately_ms = self.plan["step_ms"] + slope * (lately - points)
        return 1 + slope * (ahead - lately) / lately_ms if lately_ms > 0 else 1.0

    def _step_s(self) -> float | None:
        """Seconds of one of the last steps; None before it is known."""
        if len(self._seen) < 2:
            return None
        (first, then, _), (last, now, _) = self._seen[0], self._seen[-1]
        return (now - then) / (last - first) if last > first and now > then else None

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.global_step < module.schedule.end:  # stopped by hand; the run that goes on has the rest of the time
            return
        spent, done = self._spent(), module.schedule.progress(trainer.global_step)
        whole = spent + self.plan["calibration_s"]
        found = {
            "asked_s": self.plan["asked_s"],
            "clock": self.plan["clock"],
            "calibration_s": self.plan["calibration_s"],
            "train_s": round(spent, 3),
            "off_percent": round(100 * (whole / self.plan["asked_s"] - 1), 2),
            "planned_steps": self.plan["steps"],
            "steps": trainer.global_step,
            "max_gaussians": self.plan["cap"],
            "learning_rate_decay": self.plan["decay"],
            "settings": self.plan["settings"],
            "moved_at_step": self._moved,
            "schedule_done": round(done, 4),
            "expected_psnr_on_demo_scenes": self.plan["expected_psnr"],
            "twice_gain_db": self.plan["twice_gain_db"],
            "twice_steps": self.plan["twice_steps"],
            "twice": self.twice,
            "notes": [*self.plan["reasons"], *self._beyond(trainer.global_step, module.schedule)],
        }
        module.results.run["budget"] = found
        log.info(
            "budget: %.1f s of %g s (%+.1f %%), %d steps of %d planned; by the plan, %s",
            whole, self.plan["asked_s"], found["off_percent"], trainer.global_step, self.plan["steps"], self.twice,
        )  # fmt: skip
        if done < 0.95:
            log.warning(
                "budget: training stopped when %.0f %% of its schedule was done; the pace was misjudged", 100 * done
            )

    def _beyond(self, steps: int, schedule: Any) -> list[str]:
        """A sentence, and a warning, where there was no time left for the last of several rounds."""
        if not schedule.restarts or steps > round(_least(schedule)) or self._spent() <= self.seconds:
            return []
        first = schedule.restarts[-1]
        told = (
            f"the machine was too slow for the {first} steps of earlier rounds, so the last one has {steps - first} of "
            f"{schedule.steps - first} planned steps, beyond the budget; give more time"
        )
        log.warning("budget: %s", told)
        return [told]

    # Resume ----------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        return {"moved": self._moved}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._moved = state["moved"]


def _least(schedule: Any) -> float:
    """Steps that a run of several rounds has at least; 0 of one."""
    begin = max(schedule.restarts, default=0)
    return begin + ROUND * (schedule.steps - begin) if begin else 0.0
