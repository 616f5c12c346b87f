"""What steps and Gaussians are worth: measured ends of runs, and what choices promise after so many steps.

They hold no seconds, so they travel between machines. docs/budget.md tells the rest.
"""

from __future__ import annotations

import csv
import math
import statistics
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import as_dict
from heatsplat.io.tables import write_csv

CURVES_FILE = Path(__file__).with_name("budget_curves.csv")


class Choice(NamedTuple):
    """Knobs besides the number of steps: cap on the Gaussians in those of the start, ``optim.decay``, and other overrides.

    Those are sorted, such as ("density=budget", "schedule=coarse_to_fine"); none: all else is as the method has it.
    """

    growth: float
    decay: float
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Point:
    """The end of one measured run, or the mean of several with different seeds.

    Args:
        method, scene: what was reconstructed and how.
        steps: length of the run.
        growth: cap on the Gaussians in Gaussians of the start; infinity where nothing but the scene bounds them.
        mean_growth: Gaussians in the mean over the run's steps, in Gaussians of the start.
        psnr: of the test views at full resolution, dB.
        seeds: runs behind the mean.
        decay: share of the decay of the learning rates, ``optim.decay``.
        settings: other overrides that the run had, sorted; a column of the file for each key.
        cost: what a step cost in the mean over the run, in parts of one without ``settings`` and with as many Gaussians.
    """

    method: str
    scene: str
    steps: int
    growth: float
    mean_growth: float
    psnr: float
    seeds: int = 1
    decay: float = 1.0
    settings: tuple[str, ...] = ()
    cost: float = 1.0

    @property
    def choice(self) -> Choice:
        """What a plan may choose."""
        return Choice(self.growth, self.decay, self.settings)


COLUMNS = tuple(name for name in Point.__dataclass_fields__ if name != "settings")


@dataclass(frozen=True)
class Curve:
    """Scores and Gaussians over the length of a run, for one scene and one cap; points in order of their steps."""

    points: tuple[Point, ...]

    def psnr(self, steps: float) -> float:
        """Expected PSNR in dB; see ``_at``."""
        return self._at(steps, "psnr")

    def mean_growth(self, steps: float) -> float:
        """Expected Gaussians in the mean over the run, in those of the start; never fewer than there or in a measured run."""
        return max(self._at(steps, "mean_growth"), min(1.0, *(point.mean_growth for point in self.points)))

    def cost(self, steps: float) -> float:
        """Expected cost of a step, in parts of one without settings; never outside what was measured."""
        costs = [point.cost for point in self.points]
        return min(max(self._at(steps, "cost"), min(costs)), max(costs))

    def _at(self, steps: float, name: str) -> float:
        """Straight between measured points over log steps; beyond the last one the slope halves with every doubling."""
        x = [math.log2(point.steps) for point in self.points]
        y = [getattr(point, name) for point in self.points]
        at = math.log2(max(steps, 1.0))
        if len(x) == 1:
            return y[0]
        if at > x[-1]:
            slope = (y[-1] - y[-2]) / (x[-1] - x[-2])
            return y[-1] + slope * (1.0 - 2.0 ** (x[-1] - at)) / math.log(2.0)
        i = next((i for i in range(1, len(x)) if at <= x[i]), len(x) - 1)
        share = (at - x[i - 1]) / (x[i] - x[i - 1])
        return y[i - 1] + share * (y[i] - y[i - 1])

    @property
    def last(self) -> int:
        """The longest measured run, in steps."""
        return self.points[-1].steps


def read_points(path: Path = CURVES_FILE) -> list[Point]:
    """The measured points of a curves file.

    Columns that are no number of a point are overrides; where they are empty, the run had none of this key.

    Raises:
        SceneError: the file is not one, or empty, or has several rows of one run.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            points = [
                Point(
                    row["method"],
                    row["scene"],
                    int(row["steps"]),
                    float(row["growth"]),
                    float(row["mean_growth"]),
                    float(row["psnr"]),
                    int(row["seeds"]),
                    float(row["decay"]),
                    tuple(sorted(f"{key}={row[key]}" for key in row if key not in COLUMNS and row[key])),
                    float(row["cost"]),
                )
                for row in csv.DictReader(file)
            ]
        if not points:
            raise ValueError("it has no rows")
        if not all(min(p.steps, p.growth, p.mean_growth, p.cost) > 0 and math.isfinite(p.psnr) for p in points):
            raise ValueError("steps, growth, mean_growth and cost must be above zero, psnr finite")
        if twice := [point for point, count in Counter(map(_which, points)).items() if count > 1]:
            raise ValueError(f"several rows are of one run: {', '.join(twice[0])}")
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise SceneError(
            f"{path} holds no curves: {error!r}. Measure them with python src/study.py study=budget, which writes them to "
            "study.curves=FILE; runs read them from budget_curves=FILE, and without it those that come with heatsplat"
        ) from error
    return points


def merged(kept: Iterable[Point], measured: Iterable[Point]) -> list[Point]:
    """The points of both; where the same run was measured anew, the new one."""
    return list(({_which(point): point for point in kept} | {_which(point): point for point in measured}).values())


def _which(point: Point) -> tuple[str, ...]:
    """The run that a point is of, with numbers as a file holds them."""
    numbers = f"{point.growth:.3g}", f"{point.decay:.3g}"
    return point.method, point.scene, str(point.steps), *numbers, *point.settings


def write_points(points: Iterable[Point], path: Path) -> None:
    """Writes a curves file, in one order whatever that of ``points``."""
    points = sorted(points, key=lambda point: (point.method, point.scene, point.choice, point.steps))
    keys = sorted({key for point in points for key in as_dict(point.settings)})
    rows = (
        {name: getattr(point, name) for name in COLUMNS}
        | {"psnr": f"{point.psnr:.3f}"}
        | {name: f"{getattr(point, name):.3g}" for name in ("growth", "mean_growth", "decay", "cost")}
        | as_dict(point.settings)
        for point in points
    )
    write_csv(path, rows, [*COLUMNS, *keys])


def curves_of(points: Iterable[Point]) -> dict[tuple[str, str], dict[Choice, Curve]]:
    """(method, scene) -> choice -> curve, in one order whatever that of ``points``."""
    curves: dict[tuple[str, str], dict[Choice, list[Point]]] = {}
    for point in sorted(points, key=lambda point: (point.method, point.scene, point.choice, point.steps)):
        curves.setdefault((point.method, point.scene), {}).setdefault(point.choice, []).append(point)
    return {scene: {choice: Curve(tuple(own)) for choice, own in choices.items()} for scene, choices in curves.items()}


class Outlook:
    """What choices promise after so many steps, where not every scene measured every choice.

    Scenes are compared with themselves only, or a choice would win for having been measured where all goes well. Each says
    what a choice gains over the *usual* one there after as many steps; a scene that did not measure the choice is taken to
    gain what the others gained in the mean. So every choice that was measured anywhere beside the usual one takes part, and
    where all scenes measured all choices, what comes out is their mean. Gains are differences for PSNR and ratios for
    Gaussians, of which there are never more than the cap.

    The usual choice is the one that most scenes measured; of several, that with the fewest settings, then with the most
    Gaussians, then with the whole decay.
    What was measured at one length only says nothing of others, and counts where there is nothing better.

    Args:
        points: measured points, at least one.
    """

    def __init__(self, points: Iterable[Point]) -> None:
        curves = curves_of(points)
        least = min(2, max(len(curve.points) for choices in curves.values() for curve in choices.values()))
        able = {
            scene: {choice: curve for choice, curve in choices.items() if len(curve.points) >= least}
            for scene, choices in curves.items()
        }
        counts = Counter(choice for choices in able.values() for choice in choices)
        self.usual = max(counts, key=lambda one: (counts[one], -len(one.settings), one.growth, one.decay, one.settings))
        self._scenes = {scene: choices for scene, choices in able.items() if self.usual in choices}
        self.choices = sorted({choice for choices in self._scenes.values() for choice in choices})

    def psnr(self, choice: Choice, steps: float) -> float:
        """Expected PSNR in dB, in the mean over the scenes."""
        usual = statistics.fmean(choices[self.usual].psnr(steps) for choices in self._scenes.values())
        if choice == self.usual:
            return usual
        return usual + statistics.fmean(
            own.psnr(steps) - choices[self.usual].psnr(steps) for own, choices in self._measured(choice)
        )

    def mean_growth(self, choice: Choice, steps: float) -> float:
        """Expected Gaussians in the mean over the run, in those of the start, in the mean over the scenes."""
        ratio = statistics.fmean(
            own.mean_growth(steps) / choices[self.usual].mean_growth(steps) for own, choices in self._measured(choice)
        )
        least = min(choice.growth, 1.0)  # a run starts with them
        return statistics.fmean(
            choices[choice].mean_growth(steps)
            if choice in choices
            else min(max(ratio * choices[self.usual].mean_growth(steps), least), choice.growth)
            for choices in self._scenes.values()
        )

    def cost(self, choice: Choice, steps: float) -> float:
        """What a step costs in the mean over the run, in parts of one without settings and with as many Gaussians."""
        return statistics.fmean(own.cost(steps) for own, _ in self._measured(choice))

    def last(self, choice: Choice) -> int:
        """The longest run that was measured with the choice, in steps."""
        return max(own.last for own, _ in self._measured(choice))

    def missing(self, choice: Choice) -> list[str]:
        """The "method/scene" that did not measure the choice."""
        return [f"{method}/{scene}" for (method, scene), choices in self._scenes.items() if choice not in choices]

    def _measured(self, choice: Choice) -> list[tuple[Curve, dict[Choice, Curve]]]:
        return [(choices[choice], choices) for choices in self._scenes.values() if choice in choices]
