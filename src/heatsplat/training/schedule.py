"""How far a run is: the one clock that learning rates, losses, thermal models, density control and the end ask."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

DENSEST = 4  # times as many even intervals as asked for, at most, in the search for one that suits


class Schedule:
    """The steps of a run, its rounds, its progress and its end.

    A run is planned for a number of steps, and ends after them unless the end is moved (``end_at``): what was left of the
    plan is then spread evenly over the steps that are left, so that whatever follows the progress is complete when the
    run ends. Rounds, and all else that is set in steps, begin at those steps of the run.

    Args:
        steps: planned length of the run.
        restarts: first steps of all rounds but the first (``stages.restarts``).

    Raises:
        ValueError: there is no step, or restarts do not increase from 1 on.
    """

    def __init__(self, steps: int, restarts: Sequence[int] = ()) -> None:
        if steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {steps}")
        self.steps, self.restarts = steps, tuple(restarts)
        if any(after <= before for before, after in zip((0, *self.restarts), self.restarts, strict=False)):
            raise ValueError(f"stages.restarts must be increasing steps from 1 on, got {list(restarts)}")
        self._start, self._planned, self._end = 0, 0.0, float(steps)  # step and planned step of the last move; the end

    @property
    def end(self) -> int:
        """Steps after which the run ends."""
        return round(self._end)

    def end_at(self, step: int, end: float) -> None:
        """Spreads what is left of the plan after ``step`` over the steps up to ``end``."""
        self._start, self._planned, self._end = step, self._planned_step(step), max(end, step)

    def _planned_step(self, step: float) -> float:
        """The step of the plan that a step of the run stands for; itself as long as the end is where it was planned."""
        if self._end <= self._start:  # there was no time left for the rest
            return self._planned
        passed = (self.steps - self._planned) * (step - self._start) / (self._end - self._start)
        return min(self._planned + passed, self.steps)

    def planned(self, round_step: float) -> float:
        """The step of the plan that a step stands for, both counted from the first of the last round; itself as long as the end
        is where it was planned."""
        if (self._start, self._end) == (self._planned, self.steps):
            return round_step
        first = max(self.restarts, default=0)
        return self._planned_step(first + round_step) - first

    def progress(self, step: float) -> float:
        """Share of the run that is done after ``step`` steps, in [0, 1]."""
        return self._planned_step(step) / self.steps

    def round_progress(self, step: float) -> float:
        """Share of its round that is done after ``step`` steps, in [0, 1]."""
        first = self._first(step)
        after = next((restart for restart in self.restarts if restart > step), self.steps)
        return min(max(self._planned_step(step) - first, 0) / max(after - first, 1), 1.0)

    def left(self, step: float) -> float:
        """Share of the last round that is left after ``step`` steps, in [0, 1]; 1 in the rounds before."""
        return 1 - self.round_progress(step) if step > max(self.restarts, default=0) else 1.0

    def round_step(self, step: int) -> int:
        """The step counted from the first of its round."""
        return step - self._first(step)

    def _first(self, step: float) -> int:
        return max((first for first in self.restarts if first <= step), default=0)

    def interval(self, wanted: int, suits: Callable[[int], bool]) -> int:
        """The longest interval of at most ``wanted`` steps that parts the planned run evenly and whose multiples all suit.

        Args:
            wanted: taken as it is where its multiples suit, and where those of no other do.
            suits: whether something may happen after so many steps.
        """
        fewest = -(-self.steps // wanted)
        even = (-(-self.steps // count) for count in range(fewest, DENSEST * fewest + 1))
        for interval in (wanted, *even):
            if all(suits(step) for step in range(interval, self.steps + 1, interval)):
                return interval
        return wanted

    def state_dict(self) -> dict[str, Any]:
        """Where the end is, as plain numbers."""
        return {"steps": self.steps, "start": self._start, "planned": self._planned, "end": self._end}

    def load_state_dict(self, state: dict[str, Any]) -> bool:
        """Puts the end where it was; a run of another length than that which wrote the state keeps its own. Whether it did."""
        same = state["steps"] == self.steps
        if same:
            self._start, self._planned, self._end = state["start"], state["planned"], state["end"]
        return same
