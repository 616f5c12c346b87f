"""The curves behind budget=SECONDS: a grid of run lengths, caps on Gaussians, learning rates and further settings.

Rules: every run is whole, its schedule as long as it is, so a grid point is what a user would get; scores are those of the
test views at full resolution. The curves hold no seconds, so they may be measured on a busy machine. What further settings
cost is told in parts of a step without them: processor seconds by processor seconds, of which a line over the Gaussians says
what a step without takes, so runs are on one thread. Planned runs are set beside the grid by their seconds: not on a busy
machine.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from heatsplat.composition import compose
from heatsplat.contracts import SceneError, check_count, check_numbers
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, RunResults
from heatsplat.io.tables import NONE, markdown_table, number, read_csv
from heatsplat.runs.curves import Curve, Point, curves_of, merged, read_points, write_points
from heatsplat.studies.child_runs import all_rows, train_or_read
from heatsplat.studies.options import listed, non_empty, of_runs, whole_numbers

TABLE_FILE, PICTURE_FILE, POINTS_FILE = "budget.md", "budget.png", "budget_curves.csv"


@dataclass(frozen=True)
class Trained:
    """A run of the grid.

    Args:
        method, scene, steps, cap, decay, seed: which; ``cap`` None is that of the method.
        results: what it found.
        mean_gaussians: over its steps.
        settings: its further overrides, sorted.
    """

    method: str
    scene: str
    steps: int
    cap: int | None
    decay: float
    seed: int
    results: RunResults
    mean_gaussians: float
    settings: tuple[str, ...] = ()

    @property
    def step_cpu_s(self) -> float:
        """Processor seconds of one of its steps, in the mean."""
        cost = self.results.cost
        return cost["cpu_seconds"] / (cost["train_seconds"] * cost["steps_per_second"])

    @property
    def growth(self) -> float:
        """Its cap in Gaussians of the start."""
        return math.inf if self.cap is None else self.cap / self.results.data["points"]


def run(
    output_dir: Path | str,
    train: str | None,
    scenes: Sequence[str],
    steps: Sequence[int],
    caps: Sequence[int | None],
    decays: Sequence[float],
    seeds: Sequence[int],
    budgets: Sequence[float],
    overrides: Sequence[str],
    curves: str | None,
    threads: int | None = None,
    further: Sequence[Mapping[str, Any]] = (),
) -> None:
    """Trains the grid and the planned runs; writes the curves, budget.md and budget.png.

    Args:
        output_dir: of the study; runs that have results there are not run again.
        train: path of train.py; None: the installed heatsplat-train.
        scenes: "method/scene" of synthetic scenes, such as "etgs/heated".
        steps: lengths of a run.
        caps: most Gaussians; None is what the method's density control makes by itself.
        decays: shares of the decay of the learning rates (``optim.decay``).
        seeds: of every run of the grid.
        budgets: seconds for which a planned run is set beside the grid. These runs are planned from ``curves`` with the new
            points in it, as later ones will be; without it from the new points alone.
        overrides: of every run. Opacities are never reset, as budget= trains.
        curves: curves file into which the points go: those of the same method, scene, steps, cap and decay are replaced,
            others stay. None: only the study's folder has the points.
        threads: CPU threads of every run; None takes all cores.
        further: what else is measured: "set", overrides such as [density=budget, schedule=coarse_to_fine], and, where they
            differ, scenes, steps, caps, decays and seeds of its own. The same is measured without "set", to know its cost.

    Raises:
        SceneError: an option or ``curves`` cannot be used as it is, or a run failed.
    """
    folder, overrides, budgets = Path(output_dir).resolve(), listed(overrides), listed(budgets)
    common = of_runs(overrides, threads)
    grid = []
    pairs = _pairs(scenes)
    for budget in budgets:
        check_numbers("study.budgets", budget, error=SceneError)
    _known(curves)  # a file that is none is told before the runs, not after them
    whole = {"scenes": scenes, "steps": steps, "caps": caps, "decays": decays, "seeds": seeds}
    for (method, scene), length, cap, decay, seed, settings in _asked(whole, listed(further)):
        names = [method, scene, str(length), str(cap or "free"), f"{decay:g}", *settings]
        place = folder / "runs" / "_".join(names).replace("/", "-") / str(seed)
        wanted = [*settings, f"max_steps={length}", f"optim.decay={decay:g}"]
        chosen = [*_of(method, scene, seed), *settings]
        density = compose([*overrides, *chosen])["density"]
        off = ("reset_every", "multiple") if cap else ("reset_every",)  # as budget= trains
        wanted += [f"density.{name}=null" for name in off if name in density]
        wanted += [f"density.cap_max={cap}"] if cap else []
        results = train_or_read(place, train, [*common, *_of(method, scene, seed), *wanted], folder)
        mean = mean_gaussians(place / CURVE_FILE, results.data["points"])
        grid.append(Trained(method, scene, length, cap, decay, seed, results, mean, settings))
    points = means(grid)
    source = folder / POINTS_FILE
    write_points(points, source)
    if curves is not None:
        source = Path(curves).resolve()
        write_points(merged(_known(curves), points), source)
    plans = hashlib.sha256(source.read_bytes()).hexdigest()[:8]  # other curves plan other runs
    planned = [
        (method, scene, budget, train_or_read(
            folder / "planned" / f"{method}_{scene}_{budget:g}s_{plans}" / "0", train,
            [*common, *_of(method, scene, 0), f"budget={budget:g}s", f"budget_curves={source}"], folder,
        ))
        for (method, scene), budget in itertools.product(pairs, budgets)
    ]  # fmt: skip
    about = all_rows(common, threads=[one.results.run.get("threads") for one in grid])
    write_atomically(folder / TABLE_FILE, tables(grid, planned, about))
    write_png(folder / PICTURE_FILE, figure_picture(picture(points)))


def _known(curves: str | None) -> list[Point]:
    """The points that are in a curves file already."""
    return read_points(Path(curves)) if curves is not None and Path(curves).exists() else []


def _pairs(scenes: Sequence[str]) -> list[tuple[str, ...]]:
    """Method and scene of each entry."""
    scenes = non_empty("study.scenes", scenes)
    pairs = [tuple(str(pair).split("/")) for pair in scenes]
    if any(len(pair) != 2 for pair in pairs):
        raise SceneError(f"study.scenes has entries of the form method/scene, such as etgs/heated, got {scenes}")
    return pairs


def _asked(whole: Mapping[str, Sequence[Any]], further: Sequence[Mapping[str, Any]]) -> list[tuple[Any, ...]]:
    """(method, scene), steps, cap, decay, seed and settings of every run, each once. Raises SceneError as ``run`` does."""
    asked: dict[tuple[Any, ...], None] = {}
    for part in [{}, *further]:
        own = {name: part.get(name, values) for name, values in whole.items()}
        steps, seeds = whole_numbers("study.steps", own["steps"]), whole_numbers("study.seeds", own["seeds"], least=0)
        caps, decays = non_empty("study.caps", own["caps"]), non_empty("study.decays", own["decays"])
        for cap in caps:
            if cap is not None:
                check_count("study.caps", cap)
        for decay in decays:
            check_numbers("study.decays", decay, error=SceneError)
        choices = [(), tuple(sorted(listed(part["set"])))] if "set" in part else [()]
        grid = (_pairs(own["scenes"]), steps, caps, decays, seeds, choices)
        asked |= dict.fromkeys(itertools.product(*grid))
    return list(asked)


def costs(grid: Sequence[Trained]) -> list[float]:
    """For each run what its steps cost in parts of steps without settings and with as many Gaussians."""
    lines = {}
    for method, scene in {(one.method, one.scene) for one in grid if one.settings}:
        plain = [one for one in grid if (one.method, one.scene, one.settings) == (method, scene, ())]
        lines[method, scene] = _line_through([(one.mean_gaussians, one.step_cpu_s) for one in plain])

    def cost(one: Trained) -> float:
        if not one.settings:
            return 1.0
        base, slope = lines[one.method, one.scene]
        return one.step_cpu_s / (base + slope * one.mean_gaussians)

    return [cost(one) for one in grid]


def _line_through(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Value at zero and slope, neither below zero, of the line nearest to points (x, y)."""
    x, y = zip(*points, strict=True)
    middle = statistics.fmean(x), statistics.fmean(y)
    if len(set(x)) < 2:
        return middle[1], 0.0
    slope = min(max(statistics.linear_regression(x, y).slope, 0.0), middle[1] / middle[0])
    return middle[1] - slope * middle[0], slope


def _of(method: str, scene: str, seed: int) -> list[str]:
    return [f"method={method}", "data=synthetic", f"data.scene={scene}", f"data.scene_seed={seed}", f"seed={seed}"]


def mean_gaussians(curve: Path, start: int) -> float:
    """Gaussians in the mean over the steps of a run, straight between its validations."""
    before, total, last = (0.0, float(start)), 0.0, 0.0
    for step, count in ((row["step"], row["gaussians"]) for row in read_csv(curve)):
        total += 0.5 * (before[1] + count) * (step - before[0])
        before, last = (step, count), step
    return total / last


def means(grid: Sequence[Trained]) -> list[Point]:
    """The points of the curves: means over the seeds."""
    groups: dict[tuple, list[Trained]] = {}
    cost = dict(zip(map(id, grid), costs(grid), strict=True))
    for one in grid:
        groups.setdefault((one.method, one.scene, one.steps, one.cap, one.decay, one.settings), []).append(one)
    return [
        Point(
            method=own[0].method,
            scene=own[0].scene,
            steps=own[0].steps,
            growth=own[0].growth,
            mean_growth=statistics.fmean(one.mean_gaussians / one.results.data["points"] for one in own),
            psnr=statistics.fmean(one.results.test["psnr"] for one in own),
            seeds=len(own),
            decay=own[0].decay,
            settings=own[0].settings,
            cost=statistics.fmean(cost[id(one)] for one in own),
        )
        for own in groups.values()
    ]


def tables(grid: Sequence[Trained], planned: Sequence[tuple[str, str, float, RunResults]], about: str) -> str:
    """What all runs have, the grid, and each planned run beside the best run of the grid that was no slower."""
    rows = [
        (
            one.method, one.scene, f"{one.steps:,}", _cap(one.cap), f"{one.decay:g}", " ".join(one.settings), one.seed,
            f"{part:.2f}",
            number(one.results.cost["train_seconds"], 1), number(one.results.cost["gaussians"], 0),
            number(one.results.test["psnr"], 2),
        )
        for one, part in zip(grid, costs(grid), strict=True)
    ]  # fmt: skip
    head = (
        "method", "scene", "steps", "Gaussians at most", "decay", "further", "seed", "cost of a step", "train (s)",
        "Gaussians", "PSNR (dB)",
    )  # fmt: skip
    lines = ["# Accuracy against steps and Gaussians, and planned runs", "", about, ""]
    lines += markdown_table(head, rows, "llrrrlrrrrr")
    if not planned:
        return "\n".join([*lines, ""])
    rows = []
    for method, scene, budget, results in planned:
        found = results.run["budget"]
        rivals = [
            one for one in grid
            if (one.method, one.scene) == (method, scene) and one.results.cost["train_seconds"] <= 1.1 * budget
        ]  # fmt: skip
        best = max(rivals, key=lambda one: one.results.test["psnr"], default=None)
        rival = ("none", NONE, NONE)
        if best is not None:
            rival = (
                ", ".join([f"{best.steps:,} steps", _cap(best.cap), f"decay {best.decay:g}", *best.settings]),
                number(best.results.test["psnr"], 2),
                number(best.results.cost["train_seconds"], 1),
            )  # fmt: skip
        spent = number(found["train_s"] + found["calibration_s"], 1)
        rows.append((
            method, scene, f"{budget:g}", spent, f"{found['off_percent']:+.1f} %", f"{found['steps']:,}",
            number(results.test["psnr"], 2), *rival,
        ))  # fmt: skip
    head = (
        "method", "scene", "budget (s)", "spent (s)", "off", "steps", "PSNR (dB)", "best of the grid", "its PSNR", "its seconds",
    )  # fmt: skip
    lines += [
        "",
        "## Planned runs beside the grid",
        "",
        "The best of the grid is the highest PSNR among its runs (all seeds) that took at most 1.1 times the budget.",
        "",
        *markdown_table(head, rows, "llrrrrrlrr"),
    ]
    return "\n".join([*lines, ""])


def _cap(cap: int | None) -> str:
    return "free" if cap is None else f"{cap:,}"


def picture(points: Sequence[Point]) -> Figure:
    """PSNR and Gaussians against steps, a row for each method and scene, a line for each cap and decay."""
    pairs = list(dict.fromkeys((point.method, point.scene) for point in points))
    figure = Figure(figsize=(9, 3.2 * len(pairs)), dpi=110, layout="constrained")
    for row, (method, scene) in enumerate(pairs):
        own = [point for point in points if (point.method, point.scene) == (method, scene)]
        for column, (name, label) in enumerate(
            (("psnr", "PSNR (dB)"), ("mean_growth", "mean Gaussians / those of the start"))
        ):
            axes = figure.add_subplot(len(pairs), 2, 2 * row + column + 1)
            for i, ((growth, decay, settings), curve) in enumerate(curves_of(own)[method, scene].items()):
                cap = "free" if math.isinf(growth) else f"at most {growth:g} times the start"
                _line(axes, curve, name, i, ", ".join([cap, f"decay {decay:g}", *settings]))
            lengths = sorted({point.steps for point in own})
            axes.set(xscale="log", xlabel="steps", ylabel=label, title=f"{method} on {scene}")
            axes.set_xticks(lengths, [f"{length:,}" for length in lengths])
            axes.minorticks_off()
            axes.grid(alpha=0.25, which="both")
            axes.legend(fontsize=7)
    return figure


def _line(axes, curve: Curve, name: str, color: int, label: str) -> None:
    steps = [point.steps for point in curve.points]
    axes.plot(steps, [getattr(point, name) for point in curve.points], "o", color=f"C{color}", label=label)
    course = [steps[0] * (2 * steps[-1] / steps[0]) ** (i / 60) for i in range(61)]
    axes.plot(course, [getattr(curve, name)(at) for at in course], color=f"C{color}", linewidth=0.8)
