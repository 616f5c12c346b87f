"""Budget in, best recipe out: the steps, Gaussians, learning rates and settings that make the most of seconds of training.

Three measurements meet. Curves (``heatsplat.runs.curves``) say how well a method does after so many steps with so many
Gaussians. A calibration of a few steps says what a step costs here, on this scene, with few and with many Gaussians. The plan
is the measured choice that scores best in the time. docs/budget.md tells the rest.
"""

from __future__ import annotations

import logging
import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from scipy.spatial import cKDTree

from heatsplat.composition import build, choices_of, compose, followed, overlap
from heatsplat.contracts import SceneData, SceneError
from heatsplat.io.command_lines import keys_of
from heatsplat.runs.curves import CURVES_FILE, Choice, Outlook, Point, read_points
from heatsplat.runs.device import device_of
from heatsplat.runs.stepping import Stepper
from heatsplat.runs.verdicts import with_verdicts
from heatsplat.training.clocks import read_clock
from heatsplat.training.rng import generator_for

log = logging.getLogger("heatsplat")

UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
MIN_STEPS = 100  # below, the schedule loses its shape: growth, which comes every 50 steps or more, has no time
SPARE = 1.25  # times the least is what is advised: the next start measures anew, in a busier moment perhaps
CALIBRATION_SHARE = 0.05  # of the budget at most
CALIBRATION_SECONDS = 4.0  # and at most this long
CALIBRATION_ROUNDS = (3, 200)  # fewest and most timed steps of each size; fewer than three have no middle
CALIBRATION_VIEWS = 20  # that take turns in them
WARM_UP = 2  # steps before them: kernels compile and memory is found
DENSER = 4  # the second size of the calibration, in Gaussians of the start


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


def calibrate(
    make: Callable[[], Any],
    scene: SceneData,
    max_steps: int,
    budget_s: float,
    device: str = "cpu",
    clock: str = "train_seconds",
) -> Pace:
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
        clock: that seconds are of: "train_seconds" | "cpu_seconds".
    """
    steppers = [
        Stepper(make(), _denser(scene, factor), step=max_steps // 2, device=device, clock=clock)
        for factor in (1, DENSER)
    ]
    times: list[list[float]] = [[] for _ in steppers]
    views = [scene.train[i] for i in range(min(len(scene.train), CALIBRATION_VIEWS))]
    for turn in range(WARM_UP):
        for stepper in steppers:
            stepper.step(views[turn % len(views)])
    limit, start = min(CALIBRATION_SHARE * budget_s, CALIBRATION_SECONDS), read_clock(clock)
    for turn in range(CALIBRATION_ROUNDS[1]):
        for stepper, own in zip(steppers, times, strict=True):
            own.append(stepper.step(views[turn % len(views)]))
        spent = read_clock(clock) - start
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
        settings: other overrides, such as ("schedule=coarse_to_fine",).
        points: Gaussians of the start.
        gaussian_us: microseconds that one Gaussian more adds to a step, by the calibration.
        gaussians: mean over the run.
        clock: that all seconds are of, "train_seconds" | "cpu_seconds".
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
    settings: tuple[str, ...] = ()
    points: int = 0
    gaussian_us: float = 0.0
    gaussians: float = 0.0
    clock: str = "train_seconds"

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as they travel in a checkpoint."""
        return asdict(self) | {"reasons": list(self.reasons), "settings": list(self.settings)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Plan:
        """The plan of ``as_dict``."""
        return cls(**values | {"reasons": tuple(values["reasons"]), "settings": tuple(values["settings"])})

    def lines(self) -> list[str]:
        """What the log says."""
        cap = "no Gaussians are added" if self.cap is None else f"at most {self.cap:,} Gaussians"
        left = f"{self.asked_s:g} s less {self.calibration_s:.1f} s of calibration (a step takes {self.step_ms:.1f} ms at first)"
        decay = "" if self.decay in (None, 1.0) else f", {self.decay:.0%} of the decay of learning rates"
        others = "".join(f", {text}" for text in self.settings)
        first = f"budget: {self.steps:,} steps, {cap}{decay}{others} for {left}"
        if self.expected_psnr is not None:
            first += f"; such runs reach {self.expected_psnr:.1f} dB on the demo scenes"
        return [first, self.twice(), *(f"budget: {reason}" for reason in self.reasons)]

    def twice(self) -> str:
        """What twice the time would buy, in a sentence."""
        return f"twice the time ({2 * self.asked_s:g} s) would buy about {self.twice_gain_db:+.2f} dB: {self.twice_steps:,} steps"


@dataclass(frozen=True)
class RunCosts:
    """What runs cost here, and the best that seconds buy.

    Args:
        outlook: what choices promise.
        pace: what a step costs here.
        cap_max: Gaussians that the configuration allows; None where the method adds none.
    """

    outlook: Outlook
    pace: Pace
    cap_max: int | None

    def gaussians(self, choice: Choice, steps: float) -> float:
        """Mean number of Gaussians of a run."""
        points = self.pace.points
        if self.cap_max is None:
            return points
        return min(points * self.outlook.mean_growth(choice, steps), max(self.cap_max, points))

    def cost(self, choice: Choice, steps: float) -> float:
        """Seconds of a run."""
        return steps * self.pace.step_s(self.gaussians(choice, steps)) * self.outlook.cost(choice, steps)

    def affordable(self, choice: Choice, seconds: float) -> float:
        """Steps that take so many seconds; the cost rises with the steps."""
        low, high = 1.0, 2.0
        while self.cost(choice, high) < seconds:
            low, high = high, 2 * high
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.cost(choice, middle) < seconds else (low, middle)
        return low

    def best(self, seconds: float) -> tuple[float, Choice, int]:
        """Expected PSNR, choice and steps of the best that has MIN_STEPS; there must be one that has them."""
        steps = {choice: self.affordable(choice, seconds) for choice in self.outlook.choices}
        whole = {choice: count for choice, count in steps.items() if round(count) >= MIN_STEPS}
        return max((self.outlook.psnr(choice, count), choice, round(count)) for choice, count in whole.items())

    def cap(self, growth: float) -> int | None:
        """Gaussians at most."""
        if self.cap_max is None or math.isinf(growth):
            return self.cap_max
        return min(self.cap_max, max(round(growth * self.pace.points), 1))

    def growth(self, choice: Choice) -> float | None:
        """The cap in Gaussians of the start, None where it is not chosen."""
        return None if self.cap_max is None or math.isinf(choice.growth) else choice.growth


def plan(
    points: Sequence[Point], method: str, pace: Pace, asked_s: float, cap_max: int | None, free_decay: bool = True
) -> Plan:
    """The steps, the cap on Gaussians, the decay of learning rates and the settings with the best expected PSNR in the time.

    Args:
        points: measured curves of any methods, of settings that this run may have (``open_points``).
        method: name of the method.
        pace: what a step costs here.
        asked_s: seconds for calibration and training; a step of the calibration has none of the settings.
        cap_max: Gaussians that the configuration allows; None where the method adds none.
        free_decay: whether the decay may be chosen; else the configuration's stays, about which curves of 1 must do.

    Raises:
        SceneError: the time is too short, with the least; or nothing was measured.
    """
    own, reasons = _of_method(points, method, cap_max is not None, free_decay)
    outlook = Outlook(own)
    costs, train_s = RunCosts(outlook, pace, cap_max), asked_s - pace.spent_s
    least = min(costs.cost(choice, MIN_STEPS) for choice in outlook.choices)
    if train_s < least:
        # In more time the calibration takes its share at most, or as long as here, where that is its fewest steps.
        needed = max(least / (1 - CALIBRATION_SHARE), least + pace.spent_s)
        raise SceneError(
            f"budget={asked_s:g}s is too short here: {MIN_STEPS} steps and their calibration take {needed:.3g} s on this "
            f"machine. Give budget={math.ceil(10 * SPARE * needed) / 10:g}s, which a busier moment may need, or make the scene "
            "smaller (data.downscale=2, init.count=10000)."
        )
    score, chosen, steps = costs.best(train_s)
    better, more, longer = costs.best(train_s + asked_s)
    if without := outlook.missing(chosen):
        reasons.append(f"this choice was not measured on {', '.join(without)}; what it gains elsewhere stands in there")
    measured = outlook.last(more)
    if longer > measured:
        reasons.append(
            f"runs of more than {measured:,} steps were not measured; what they gain is continued from the last"
        )
    return Plan(
        asked_s=asked_s,
        calibration_s=round(pace.spent_s, 3),
        train_s=round(train_s, 3),
        steps=steps,
        cap=costs.cap(chosen.growth),
        growth=costs.growth(chosen),
        decay=chosen.decay if free_decay else None,
        expected_psnr=round(score, 2) if any(point.method == method for point in points) else None,
        twice_steps=longer,
        twice_growth=costs.growth(more),
        twice_gain_db=round(max(better - score, 0.0), 2),
        step_ms=round(1e3 * pace.step_s(pace.points), 3),
        reasons=tuple(reasons),
        settings=chosen.settings,
        points=pace.points,
        gaussian_us=round(1e6 * pace.per_gaussian_s, 6),
        gaussians=round(costs.gaussians(chosen, steps), 1),
    )


def _of_method(points: Sequence[Point], method: str, grows: bool, free_decay: bool) -> tuple[list[Point], list[str]]:
    """The points that a plan for a method goes by, and sentences about them (see ``plan``)."""
    reasons = []
    own = [point for point in points if point.method == method]
    if not own:
        own = list(points)
        methods = ", ".join(sorted({point.method for point in own}))
        reasons.append(
            f"{method} has no measured curves; those of {methods} stand in (python src/study.py study=budget)"
        )
    if not own:
        raise SceneError("there are no measured curves to plan from; run python src/study.py study=budget")
    own = [point for point in own if free_decay or point.decay == 1.0] or own
    if not grows:
        others: dict[float, set[tuple[Any, ...]]] = {}
        for point in own:
            others.setdefault(point.growth, set()).add(point.choice[1:])
        # One growth of all, so that choices differ in the rest alone.
        alike = min(others, key=lambda growth: (-len(others[growth]), growth))
        own = [point for point in own if point.growth == alike]
        reasons.append("this method adds no Gaussians, so their number was not chosen")
    return own, reasons


def open_points(points: Sequence[Point], method: str, overrides: Sequence[str]) -> list[Point]:
    """The points whose settings a run of this method with these overrides may be given.

    What the command line says stays. So does what belongs to a method: settings that another method was measured with are
    open only where they choose an option of a group of which this method has the default, as ``density=budget`` is to
    methods without a density control of their own.
    """
    given = keys_of(overrides)
    here, default = choices_of(overrides), choices_of()

    def is_open(point: Point) -> bool:
        keys = keys_of(point.settings)
        if any(overlap(key, other) for key in keys for other in given):
            return False
        return point.method == method or all(key in default and here[key] == default[key] for key in keys)

    return [point for point in points if is_open(point)]


# The run ------------------------------------------------------------------------------------------------------------


def budgeted(config: dict[str, Any], scene: SceneData) -> dict[str, Any]:
    """The configuration of a run that makes the most of ``budget`` seconds; the same without a budget.

    "budget" then holds the plan, made from the curves in the file ``budget_curves`` (None: those of the package); where it
    holds one already, of an earlier run, that is kept. A ``BudgetClock`` keeps it.
    """
    asked = config["budget"]
    if asked is None:
        return config
    made = Plan.from_dict(asked) if isinstance(asked, Mapping) else _measured(config, scene)
    decay = [] if made.decay is None else [f"optim.decay={made.decay}"]
    overrides = config["overrides"]
    density = compose([*overrides, *made.settings])["density"]
    growth = {"cap_max": made.cap}
    if made.growth is not None:
        growth["multiple"] = "null"  # as many as planned
    if "density.reset_every" not in keys_of(overrides):
        growth["reset_every"] = "null"  # as in the runs behind the curves
    growing = [f"density.{key}={value}" for key, value in growth.items() if density.get(key) is not None]
    planned = [*made.settings, f"max_steps={made.steps}", *growing, *decay]
    config = followed(config, compose(overrides), compose([*overrides, *planned]))
    clock = {"_target_": "heatsplat.callbacks.budget.BudgetClock", "plan": made.as_dict(), "twice": made.twice()}
    return config | {
        "overrides": overrides,
        "budget": made.as_dict(),
        "callbacks": config["callbacks"] | {"budget": clock},
    }


def _measured(config: dict[str, Any], scene: SceneData) -> Plan:
    overrides = config["overrides"]
    points = open_points(read_points(Path(config["budget_curves"] or CURVES_FILE)), config["name"], overrides)
    log.info("measuring what a step costs here")
    module, seconds = with_verdicts(config)["module"], config["budget"]
    device = device_of(config["trainer"]["accelerator"], config["renderer"])
    pace = calibrate(lambda: build(module), scene, config["max_steps"], seconds, device, config["budget_clock"])
    cap_max = config["density"].get("cap_max")
    made = plan(points, config["name"], pace, seconds, cap_max, "optim.decay" not in keys_of(overrides))
    made = replace(made, clock=config["budget_clock"])
    for line in made.lines():
        log.info("%s", line)
    return made
