"""Budget in, best recipe out: steps, Gaussians and learning rates that make the most of so many seconds of training.

Three measurements meet. Curves say how well a method does after so many steps with so many Gaussians; they hold no
seconds, so they travel between machines. A calibration of a few steps says what a step costs here, on this scene, with few
and with many Gaussians. The plan is the measured choice that scores best in the time. docs/budget.md tells the rest.
"""

from __future__ import annotations

import csv
import io
import math
import re
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from scipy.spatial import cKDTree

from heatsplat.contracts import SceneData, SceneError
from heatsplat.io.results import write_atomically
from heatsplat.studies.stepping import Stepper
from heatsplat.training.rng import generator_for

CURVES_FILE = Path(__file__).with_name("budget_curves.csv")
UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
MIN_STEPS = 100  # below, the schedule loses its shape: growth, which comes every 50 steps or more, has no time
CALIBRATION_SHARE = 0.05  # of the budget at most
CALIBRATION_SECONDS = 4.0  # and at most this long
CALIBRATION_ROUNDS = (3, 200)  # fewest and most timed steps of each size; fewer than three have no middle
CALIBRATION_VIEWS = 20  # that take turns in them
WARM_UP = 2  # steps before them: kernels compile and memory is found
HEADROOM = 20  # a run has room for so many times its planned steps: where the pace was misjudged, it may need them
DENSER = 4  # the second size of the calibration, in Gaussians of the start


# Asking -------------------------------------------------------------------------------------------------------------


def seconds_of(budget: str | float) -> float:
    """Seconds of a budget as people write it: 120, 120s, 2min, 1.5h.

    Raises:
        SceneError: it is no such thing, or not above zero.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?|\.\d+)\s*([a-z]*)\s*", str(budget).lower())
    if match is None or match[2] not in UNITS or not float(match[1]) > 0:
        raise SceneError(
            f"budget={budget} is no time; write seconds, or a number with s, min or h: 120, 120s, 2min, 1h"
        )
    return float(match[1]) * UNITS[match[2]]


# Curves: what steps and Gaussians are worth ---------------------------------------------------------------------------


class Choice(NamedTuple):
    """Knobs besides the number of steps: cap on the Gaussians in those of the start, and ``optim.decay``."""

    growth: float
    decay: float


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
    """

    method: str
    scene: str
    steps: int
    growth: float
    mean_growth: float
    psnr: float
    seeds: int = 1
    decay: float = 1.0

    @property
    def choice(self) -> Choice:
        """What a plan may choose."""
        return Choice(self.growth, self.decay)


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

    Raises:
        SceneError: the file is not one, or empty.
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
                )
                for row in csv.DictReader(file)
            ]
        if not points:
            raise ValueError("it has no rows")
        if not all(min(p.steps, p.growth, p.mean_growth) > 0 and math.isfinite(p.psnr) for p in points):
            raise ValueError("steps, growth and mean_growth must be above zero, psnr finite")
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise SceneError(
            f"{path} holds no curves: {error!r}. Measure them with python src/study.py study=budget, which writes them to "
            "study.curves=FILE; runs read them from budget_curves=FILE, and without it those that come with heatsplat"
        ) from error
    return points


def merged(kept: Iterable[Point], measured: Iterable[Point]) -> list[Point]:
    """The points of both; where the same run was measured anew, the new one."""

    def key(point: Point) -> tuple[str, ...]:  # numbers as a file holds them
        return point.method, point.scene, str(point.steps), f"{point.growth:.3g}", f"{point.decay:.3g}"

    return list(({key(point): point for point in kept} | {key(point): point for point in measured}).values())


def write_points(points: Iterable[Point], path: Path) -> None:
    """Writes a curves file, in one order whatever that of ``points``."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(Point.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    for point in sorted(points, key=lambda point: (point.method, point.scene, point.choice, point.steps)):
        writer.writerow(
            asdict(point)
            | {"psnr": f"{point.psnr:.3f}"}
            | {n: f"{getattr(point, n):.3g}" for n in ("growth", "mean_growth", "decay")}
        )
    write_atomically(path, text.getvalue())


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

    The usual choice is the one that most scenes measured; of several, that with the most Gaussians, then with the whole decay.
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
        self.usual = max(counts, key=lambda choice: (counts[choice], *choice))
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

    def last(self, choice: Choice) -> int:
        """The longest run that was measured with the choice, in steps."""
        return max(own.last for own, _ in self._measured(choice))

    def missing(self, choice: Choice) -> list[str]:
        """The "method/scene" that did not measure the choice."""
        return [f"{method}/{scene}" for (method, scene), choices in self._scenes.items() if choice not in choices]

    def _measured(self, choice: Choice) -> list[tuple[Curve, dict[Choice, Curve]]]:
        return [(choices[choice], choices) for choices in self._scenes.values() if choice in choices]


# Calibration: what a step costs here ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pace:
    """Seconds of a training step on this machine and scene: ``base_s + per_gaussian_s`` times the Gaussians.

    Args:
        base_s, per_gaussian_s: seconds.
        points: Gaussians at the start.
        spent_s: seconds that the calibration took.
    """

    base_s: float
    per_gaussian_s: float
    points: int
    spent_s: float = 0.0

    def step_s(self, gaussians: float) -> float:
        """Seconds of a step with so many Gaussians."""
        return self.base_s + self.per_gaussian_s * gaussians


def calibrate(make: Callable[[], Any], scene: SceneData, max_steps: int, budget_s: float, device: str = "cpu") -> Pace:
    """What a step costs: whole steps (render, loss, backward, optimiser) with the scene's points, and with four times them.

    The two sizes take turns on the same views; the median of each counts, because a run will live with what else the
    machine does. It takes a twentieth of the budget at most, or three steps of each. Building the models and the first
    steps, in which kernels compile, are not counted: they belong to the start-up.

    Args:
        make: makes the training module.
        scene: to train on.
        max_steps: length of a run, for schedules.
        budget_s: seconds that the whole run may take.
        device: where it trains.
    """
    steppers = [
        Stepper(make(), _denser(scene, factor), step=max_steps // 2, max_steps=max_steps, device=device)
        for factor in (1, DENSER)
    ]
    times: list[list[float]] = [[] for _ in steppers]
    views = [scene.train[i] for i in range(min(len(scene.train), CALIBRATION_VIEWS))]
    for turn in range(WARM_UP):
        for stepper in steppers:
            stepper.step(views[turn % len(views)])
    limit, start = min(CALIBRATION_SHARE * budget_s, CALIBRATION_SECONDS), time.perf_counter()
    for turn in range(CALIBRATION_ROUNDS[1]):
        for stepper, own in zip(steppers, times, strict=True):
            own.append(stepper.step(views[turn % len(views)]))
        spent = time.perf_counter() - start
        next_spent = spent * (turn + 2) / (turn + 1)
        if turn + 1 >= CALIBRATION_ROUNDS[0] and next_spent > limit:
            break
    few, many = (statistics.median(own) for own in times)
    count, more = (len(stepper.module.splats) for stepper in steppers)
    if more == count:  # init=random: the number does not follow the points
        return Pace(few, 0.0, count, spent)
    slope = max(0.0, (many - few) / (more - count))
    return Pace(max(few - slope * count, 0.0), slope, count, spent)


def _denser(scene: SceneData, factor: int) -> SceneData:
    """The scene with ``factor`` times its points: the new ones lie between neighbours, and splats start smaller by it."""
    points = scene.points.float()
    if factor == 1 or len(points) < 4:
        return scene
    near = torch.from_numpy(cKDTree(points.numpy()).query(points.numpy(), k=4)[1])[:, 1:]
    generator = generator_for(0, factor, "calibration")
    parts, rows = [points], torch.arange(len(points)).repeat(factor)
    for _ in range(factor - 1):
        other = near.gather(1, torch.randint(3, (len(points), 1), generator=generator)).squeeze(1)
        parts.append(points + torch.rand(len(points), 1, generator=generator) * (points[other] - points))
    columns = ("point_colors", "labels", "point_features")
    repeated = {name: getattr(scene, name)[rows] for name in columns if getattr(scene, name) is not None}
    return replace(scene, points=torch.cat(parts), **repeated)


# Planning -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """What a budget buys.

    Args:
        asked_s: the budget, seconds.
        calibration_s: of them, those that the calibration took.
        train_s: what is left for training.
        steps: length of the run.
        cap: Gaussians at most, or None where the method keeps what it has.
        growth: that cap in Gaussians of the start; None is no cap but the configuration's.
        decay: ``optim.decay``, or None where the configuration's stays.
        expected_psnr: of the demo scenes on which the curves were measured, dB; None where the method has none.
        twice_steps, twice_growth: what would be chosen in twice the time.
        twice_gain_db: and what it would gain.
        step_ms: milliseconds of a step with the Gaussians of the start, by the calibration.
        reasons: sentences: where the numbers come from and how far they reach.
    """

    asked_s: float
    calibration_s: float
    train_s: float
    steps: int
    cap: int | None
    growth: float | None
    decay: float | None
    expected_psnr: float | None
    twice_steps: int
    twice_growth: float | None
    twice_gain_db: float
    step_ms: float
    reasons: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they travel in a checkpoint."""
        return asdict(self) | {"reasons": list(self.reasons)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Plan:
        """The plan of ``as_dict``."""
        return cls(**values | {"reasons": tuple(values["reasons"])})

    def lines(self) -> list[str]:
        """What the log says."""
        cap = "no Gaussians are added" if self.cap is None else f"at most {self.cap:,} Gaussians"
        left = f"{self.asked_s:g} s less {self.calibration_s:.1f} s of calibration (a step takes {self.step_ms:.1f} ms at first)"
        decay = "" if self.decay is None else f", {self.decay:.0%} of the decay of learning rates"
        first = f"budget: {self.steps:,} steps, {cap}{decay} for {left}"
        if self.expected_psnr is not None:
            first += f"; such runs reach {self.expected_psnr:.1f} dB on the demo scenes"
        return [first, self.twice(), *(f"budget: {reason}" for reason in self.reasons)]

    def twice(self) -> str:
        """What twice the time would buy, in a sentence."""
        return f"twice the time ({2 * self.asked_s:g} s) would buy about {self.twice_gain_db:+.2f} dB: {self.twice_steps:,} steps"


def plan(
    points: Sequence[Point], method: str, pace: Pace, asked_s: float, cap_max: int | None, free_decay: bool = True
) -> Plan:
    """The steps, the cap on Gaussians and the decay of learning rates with the best expected PSNR in ``asked_s`` seconds.

    Args:
        points: measured curves of any methods.
        method: name of the method.
        pace: what a step costs here.
        asked_s: seconds for calibration and training.
        cap_max: Gaussians that the configuration allows; None where the method adds none.
        free_decay: whether the decay may be chosen; else the configuration's stays, about which curves of 1 must do.

    Raises:
        SceneError: the time is too short, with the least; or nothing was measured.
    """
    own = [point for point in points if point.method == method]
    reasons = []
    if not own:
        own = list(points)
        methods = ", ".join(sorted({point.method for point in own}))
        reasons.append(
            f"{method} has no measured curves; those of {methods} stand in (python src/study.py study=budget)"
        )
    if not own:
        raise SceneError("there are no measured curves to plan from; run python src/study.py study=budget")
    own = [point for point in own if free_decay or point.decay == 1.0] or own
    if cap_max is None:
        decays: dict[float, set[float]] = {}
        for point in own:
            decays.setdefault(point.growth, set()).add(point.decay)
        alike = min(decays, key=lambda growth: (-len(decays[growth]), growth))  # so that choices differ in decay alone
        own = [point for point in own if point.growth == alike]
        reasons.append("this method adds no Gaussians, so their number was not chosen")
    outlook = Outlook(own)
    train_s = asked_s - pace.spent_s

    def cost(choice: Choice, steps: float) -> float:
        """Seconds of a run."""
        if cap_max is None:
            return steps * pace.step_s(pace.points)
        return steps * pace.step_s(min(pace.points * outlook.mean_growth(choice, steps), max(cap_max, pace.points)))

    def affordable(choice: Choice, seconds: float) -> float:
        """Steps that take so many seconds; the cost rises with the steps."""
        low, high = 1.0, 2.0
        while cost(choice, high) < seconds:
            low, high = high, 2 * high
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if cost(choice, middle) < seconds else (low, middle)
        return low

    def best(seconds: float) -> tuple[float, Choice, int]:
        """Expected PSNR, choice and steps of the best."""
        ends = []
        for choice in outlook.choices:
            steps = affordable(choice, seconds)
            ends.append((outlook.psnr(choice, steps), choice, round(steps)))
        return max(ends)

    least = min(cost(choice, MIN_STEPS) for choice in outlook.choices)
    if train_s < least:
        raise SceneError(
            f"budget={asked_s:g}s is too short here: {MIN_STEPS} steps and their calibration take "
            f"{math.ceil(10 * least / (1 - CALIBRATION_SHARE)) / 10:g} s on this machine. Give at least that, or make the scene "
            "smaller (data.downscale=2, init.count=10000)."
        )
    score, chosen, steps = best(train_s)
    (growth, decay), steps = chosen, max(steps, MIN_STEPS)
    better, more, longer = best(train_s + asked_s)
    without = outlook.missing(chosen)
    if without:
        reasons.append(
            f"this cap and decay were not measured on {', '.join(without)}; what they gain elsewhere stands in there"
        )
    measured = outlook.last(more)
    if longer > measured:
        reasons.append(
            f"runs of more than {measured:,} steps were not measured; what they gain is continued from the last"
        )
    cap = (
        None if cap_max is None else min(cap_max, max(round(growth * pace.points), 1)) if growth < math.inf else cap_max
    )
    return Plan(
        asked_s=asked_s,
        calibration_s=round(pace.spent_s, 3),
        train_s=round(train_s, 3),
        steps=steps,
        cap=cap,
        growth=None if cap_max is None or math.isinf(growth) else growth,
        decay=decay if free_decay else None,
        expected_psnr=round(score, 2) if any(point.method == method for point in points) else None,
        twice_steps=longer,
        twice_growth=None if cap_max is None or math.isinf(more.growth) else more.growth,
        twice_gain_db=round(max(better - score, 0.0), 2),
        step_ms=round(1e3 * pace.step_s(pace.points), 3),
        reasons=tuple(reasons),
    )
