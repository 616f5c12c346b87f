"""A run that ends when its time is up, its schedule complete."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from typing import Any

import pytorch_lightning as pl

from heatsplat.callbacks.timing import CostMeter
from heatsplat.contracts import SceneError

log = logging.getLogger("heatsplat")

SETTLED = 0.5  # share of the schedule after which no Gaussian is added and the rest may be stretched (density.stop)
GROWING = 0.6  # share of the time that the schedule up to there may take; else no more Gaussians come
PRESSED = 0.7  # share of the time after which the schedule is shrunk, settled or not
CHEAP = 0.25  # share of a step that added Gaussians take, below which holding them back saves nothing
EARLY = 0.1  # share of the time in which growing is left alone: few Gaussians have come, and first steps are slow
WINDOW = 0.05  # share of the time over which the pace is measured: a machine may become slower at any moment
LOOKS = 400  # looks at the clock in a run of the planned length


class BudgetClock(pl.Callback):
    """Ends training when its seconds are over, and lets the schedule end with it.

    The plan says how many steps fit. While Gaussians grow it is followed, since the growth was planned in steps. After that
    the steps that are left are those for which there is time at the pace of the last steps, more or fewer than planned,
    and what is left of the schedule is spread over them (``Schedule.end_at``).

    Where a scene calls for more Gaussians than expected, or the machine is slower, growing would eat the time in which they
    settle: as long as the growing half would take more than six tenths of the time, no more Gaussians come
    (``density.cap_max``); the first tenth of the time is left alone. Where Gaussians cost next to nothing, as on CUDA, that
    would save nothing, and they come. Where seven tenths of the time are gone before the half ends, the schedule is shrunk
    at once, and no more come.

    Seconds are those of ``cost.train_seconds``: evaluation, start-up and the steps of warm-up are outside. What came of the
    budget is in ``module.results.run["budget"]``, the log and the report. A resumed run keeps its plan and its schedule.

    Args:
        plan: the plan (``heatsplat.runs.budget.Plan.as_dict``).
        twice: what twice the time would buy, in a sentence.
    """

    def __init__(self, plan: Mapping[str, Any], twice: str) -> None:
        self.plan, self.twice = dict(plan), twice
        self.seconds = float(plan["train_s"])
        self._seen: deque[tuple[int, float]] = deque()
        self._meter: CostMeter | None = None
        self._cap: int | None = None  # Gaussians that there may be by the plan
        self._held: int | None = None  # step at which growing was first held back
        self._last: int | None = None  # Gaussians that there may be since the schedule was shrunk before it had settled
        self._every = max(1, int(plan["steps"]) // LOOKS)

    # The run ---------------------------------------------------------------------------------------------------------

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._meter = next((callback for callback in trainer.callbacks if isinstance(callback, CostMeter)), None)
        if self._meter is None:
            raise SceneError(
                "budget needs callbacks.costs, which measures time: keep callbacks.costs on, or leave budget out"
            )
        self._cap = module.density.cap_max
        self._close(module)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        step, schedule = trainer.global_step, module.schedule
        if step % self._every != 0 and step < schedule.end - self._every:
            return
        spent = self._spent()
        self._seen.append((step, spent))
        while len(self._seen) > 2 and spent - self._seen[1][1] > WINDOW * self.seconds:
            self._seen.popleft()
        if schedule.progress(step) >= SETTLED or spent >= PRESSED * self.seconds:
            if schedule.progress(step) < SETTLED and self._last is None:
                self._last = len(module.splats)
                self._held = step if self._held is None else self._held
                self._close(module)
            self._retime(schedule, step, spent)
        else:
            self._hold(module, step, spent)

    def _spent(self) -> float:
        return self._meter.state_dict()["seconds"]["train"]

    def _retime(self, schedule: Any, step: int, spent: float) -> None:
        """Sets the end to where the time will be over at the pace of the last steps."""
        left, step_s = self.seconds - spent, self._step_s()
        if left <= 0:
            schedule.end_at(step, step)
        elif step_s is not None:
            schedule.end_at(step, step + left / step_s)

    def _hold(self, module: pl.LightningModule, step: int, spent: float) -> None:
        """Lets no more Gaussians come as long as growing takes too much of the time; see the class."""
        step_s = self._step_s()
        if step_s is None or self._cap is None or spent < EARLY * self.seconds or self._gaussian_share() < CHEAP:
            return
        growing = spent + step_s * (SETTLED - module.schedule.progress(step)) * module.schedule.end
        held = growing > GROWING * self.seconds
        module.density.cap_max = min(self._cap, len(module.splats)) if held else self._cap
        if held and self._held is None:
            self._held = step

    def _close(self, module: pl.LightningModule) -> None:
        """Lets no more Gaussians come for good, where the schedule was shrunk before it had settled."""
        if self._last is not None and self._cap is not None:
            module.density.cap_max = min(self._cap, self._last)

    def _gaussian_share(self) -> float:
        """Share of a step with as many Gaussians as there may be that those beyond the start take, by the calibration."""
        more_ms = 1e-3 * self.plan["gaussian_us"] * max(self._cap - self.plan["points"], 0)
        return more_ms / (self.plan["step_ms"] + more_ms)

    def _step_s(self) -> float | None:
        """Seconds of one of the last steps; None before it is known."""
        if len(self._seen) < 2:
            return None
        (first, then), (last, now) = self._seen[0], self._seen[-1]
        return (now - then) / (last - first) if last > first and now > then else None

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.global_step < module.schedule.end:  # stopped by hand; the run that goes on has the rest of the time
            return
        spent, done = self._spent(), module.schedule.progress(trainer.global_step)
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
            "settings": self.plan["settings"],
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
        return {"held": self._held, "last": self._last}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._held, self._last = state["held"], state.get("last")
