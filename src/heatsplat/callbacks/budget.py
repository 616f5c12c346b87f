"""A run that ends when its time is up, its schedule complete."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import pytorch_lightning as pl

from heatsplat.callbacks.timing import CostMeter
from heatsplat.contracts import SceneError

log = logging.getLogger("heatsplat")

SETTLED = 0.5  # share of the schedule after which no Gaussian is added and the rest may be stretched (density.stop)
GROWING = 0.6  # share of the time that the schedule up to there may take; else no more Gaussians come
PRESSED = 0.7  # share of the time after which the schedule is shrunk, settled or not
EARLY = 0.1  # share of the time in which growing is left alone: few Gaussians have come, and first steps are slow
WINDOW = 0.05  # share of the time over which the pace is measured: a machine may become slower at any moment
LOOKS = 400  # looks at the clock in a run of the planned length


class BudgetClock(pl.Callback):
    """Ends training when its seconds are over, and lets the schedule end with it.

    The plan says how many steps fit. While Gaussians grow it is followed, since the growth was planned in steps. After that
    the steps that are left are those for which there is time at the pace of the last steps, more or fewer than planned,
    and what is left of the schedule (learning rates) is spread over them: with progress p after step s of an end S, each
    step adds (1 - p) / (S - s), which is 1 / S as long as all goes as planned.

    Where a scene calls for more Gaussians than expected, or the machine is slower, growing would eat the time in which they
    settle: as long as the growing half would take more than six tenths of the time, no more Gaussians come
    (``density.cap_max``); the first tenth of the time is left alone. Where seven tenths of the time are gone before it ends,
    the schedule is shrunk at once.

    Seconds are those of ``cost.train_seconds``: evaluation, start-up and the steps of warm-up are outside. What came of the
    budget is in ``module.results.run["budget"]``, the log and the report. A resumed run keeps its plan and its clock.

    Args:
        plan: the plan (``heatsplat.runs.budget.Plan.as_dict``).
        twice: what twice the time would buy, in a sentence.
    """

    def __init__(self, plan: Mapping[str, Any], twice: str) -> None:
        self.plan, self.twice = dict(plan), twice
        self.seconds = float(plan["train_s"])
        self._from = (0, 0.0)  # step and progress at which the end was last set
        self._end = float(plan["steps"])
        self._seen: deque[tuple[int, float]] = deque()
        self._meter: CostMeter | None = None
        self._policies: list[tuple[Any, int]] = []  # what adds Gaussians, and how many it may have by the plan
        self._held: int | None = None  # step at which growing was first held back
        self._every = max(1, int(plan["steps"]) // LOOKS)

    # The schedule ----------------------------------------------------------------------------------------------------

    def progress(self, step: float) -> float:
        """Share of the schedule that is done after so many steps, 0 to 1."""
        start, done = self._from
        if self._end <= start:  # there was no time left for the rest
            return done
        return min(done + (1.0 - done) * (step - start) / (self._end - start), 1.0)

    def end_at(self, step: int, end: float) -> None:
        """Spreads what is left of the schedule after ``step`` over the steps up to ``end``."""
        self._from, self._end = (step, self.progress(step)), max(end, step)

    def _rate(self, factor: Callable[[float], float], length: int) -> Callable[[float], float]:
        """A factor on a learning rate, made for a run of ``length`` steps, that follows the progress."""
        return lambda step: factor(self.progress(step) * length)

    # The run ---------------------------------------------------------------------------------------------------------

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._meter = next((callback for callback in trainer.callbacks if isinstance(callback, CostMeter)), None)
        if self._meter is None:
            raise SceneError("budget needs the clock of callbacks.costs; leave callbacks.costs on, or budget out")
        for config in trainer.lr_scheduler_configs:
            factors = getattr(config.scheduler, "lr_lambdas", [])
            config.scheduler.lr_lambdas = [self._rate(factor, trainer.max_steps) for factor in factors]
        parts = (module.density, getattr(module.density, "recipe", None))
        self._policies = [(part, part.cap_max) for part in parts if hasattr(part, "cap_max")]
        self._set_length(trainer)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        step = trainer.global_step
        if step % self._every == 0 or step >= self._end - self._every:
            spent = self._spent()
            self._seen.append((step, spent))
            while len(self._seen) > 2 and spent - self._seen[1][1] > WINDOW * self.seconds:
                self._seen.popleft()
            if self.progress(step) >= SETTLED or spent >= PRESSED * self.seconds:
                self._retime(step, spent)
                self._set_length(trainer)
            else:
                self._hold(step, spent, len(module.splats))
        if step >= round(self._end):
            trainer.should_stop = True

    def _spent(self) -> float:
        return self._meter.state_dict()["seconds"]["train"]

    def _retime(self, step: int, spent: float) -> None:
        """Sets the end to where the time will be over at the pace of the last steps."""
        left, step_s = self.seconds - spent, self._step_s()
        if left <= 0:
            self.end_at(step, step)
        elif step_s is not None:
            self.end_at(step, step + left / step_s)

    def _hold(self, step: int, spent: float, count: int) -> None:
        """Lets no Gaussian come beyond ``count`` as long as growing takes too much of the time; see the class."""
        step_s = self._step_s()
        if step_s is None or not self._policies or spent < EARLY * self.seconds:
            return
        growing = spent + step_s * (SETTLED - self.progress(step)) * self._end
        held = growing > GROWING * self.seconds
        for policy, planned in self._policies:
            policy.cap_max = min(planned, count) if held else planned
        if held and self._held is None:
            self._held = step

    def _step_s(self) -> float | None:
        """Seconds of one of the last steps; None before it is known."""
        if len(self._seen) < 2:
            return None
        (first, then), (last, now) = self._seen[0], self._seen[-1]
        return (now - then) / (last - first) if last > first and now > then else None

    def _set_length(self, trainer: pl.Trainer) -> None:
        """Tells the trainer how long the run is: losses and the line on the screen ask it."""
        trainer.fit_loop.epoch_loop.max_steps = max(round(self._end), 1)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.global_step < round(self._end):  # stopped by hand; the rest of the time is for the run that goes on
            return
        spent, done = self._spent(), self.progress(trainer.global_step)
        whole = spent + self.plan["calibration_s"]
        found = {
            "asked_s": self.plan["asked_s"],
            "calibration_s": self.plan["calibration_s"],
            "train_s": round(spent, 3),
            "off_percent": round(100 * (whole / self.plan["asked_s"] - 1), 2),
            "planned_steps": self.plan["steps"],
            "steps": trainer.global_step,
            "max_gaussians": self.plan["cap"],
            "learning_rate_decay": self.plan["decay"],
            "growth_held_at_step": self._held,
            "schedule_done": round(done, 4),
            "expected_psnr_on_demo_scenes": self.plan["expected_psnr"],
            "twice_gain_db": self.plan["twice_gain_db"],
            "twice_steps": self.plan["twice_steps"],
            "twice": self.twice,
            "notes": self.plan["reasons"],
        }
        module.results.run["budget"] = found
        log.info(
            "budget: %.1f s of %g s (%+.1f %%), %d steps of %d planned; %s",
            whole, self.plan["asked_s"], found["off_percent"], trainer.global_step, self.plan["steps"], self.twice,
        )  # fmt: skip
        if done < 0.95:
            log.warning(
                "budget: training stopped when %.0f %% of its schedule was done; the pace was misjudged", 100 * done
            )

    # Resume ----------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        # What is over is not gone on with (``heatsplat.runs.resume``).
        return {"from": list(self._from), "end": self._end, "held": self._held}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._from, self._end = tuple(state["from"]), state["end"]
        self._held = state["held"]
