"""The curves behind budget=SECONDS: a grid of run lengths, caps on Gaussians and learning rates; planned runs beside it.

Rules: every run is whole, its schedule as long as it is, so a grid point is what a user would get; scores are those of the
test views at full resolution. The curves hold no seconds, so they may be measured on a busy machine; the comparison of
planned runs with the grid holds seconds, so it may not.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, RunResults, write_atomically
from heatsplat.io.tables import NONE, markdown_table, number, read_csv
from heatsplat.runs.curves import Curve, Point, curves_of, merged, read_points, write_points
from heatsplat.studies.child_runs import trained

TABLE_FILE, PICTURE_FILE, POINTS_FILE = "budget.md", "budget.png", "budget_curves.csv"


@dataclass(frozen=True)
class Trained:
    """A run of the grid.

    Args:
        method, scene, steps, cap, decay, seed: which; ``cap`` None is that of the method.
        results: what it found.
        mean_gaussians: over its steps.
    """

    method: str
    scene: str
    steps: int
    cap: int | None
    decay: float
    seed: int
    results: RunResults
    mean_gaussians: float

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
) -> None:
    """Trains the grid and the planned runs; writes the curves, budget.md and budget.png.

    Args:
        output_dir: of the study; runs that have results there are not run again.
        train: path of train.py; None: the installed heatsplat-train.
        scenes: "method/scene" of synthetic scenes, such as "etgs/heated".
        steps: lengths of a run.
        caps: most Gaussians; None is the method's own cap.
        decays: shares of the decay of the learning rates (``optim.decay``).
        seeds: of every run of the grid.
        budgets: seconds for which a planned run is set beside the grid. These runs are planned from ``curves`` with the new
            points in it, as later ones will be; without it from the new points alone.
        overrides: of every run. Opacities are never reset, as budget= trains.
        curves: curves file into which the points go: those of the same method, scene, steps, cap and decay are replaced,
            others stay. None: only the study's folder has the points.
        threads: CPU threads of every run; None takes all cores.

    Raises:
        SceneError: ``scenes`` or ``curves`` cannot be used as they are, or a run failed.
    """
    folder = Path(output_dir).resolve()
    common = [*([f"threads={threads}"] if threads else []), *overrides]
    grid = []
    pairs = [tuple(pair.split("/")) for pair in scenes]
    if any(len(pair) != 2 for pair in pairs):
        raise SceneError(f"study.scenes has entries of the form method/scene, such as etgs/heated, got {list(scenes)}")
    _known(curves)  # a file that is none is told before the runs, not after them
    for (method, scene), length, cap, decay, seed in itertools.product(pairs, steps, caps, decays, seeds):
        place = folder / "runs" / f"{method}_{scene}_{length}_{cap or 'free'}_{decay:g}" / str(seed)
        wanted = [f"max_steps={length}", f"optim.decay={decay:g}", "density.reset_every=null"]
        wanted += [f"density.cap_max={cap}"] if cap else []
        results = trained(place, train, [*common, *_of(method, scene, seed), *wanted], folder)
        mean = mean_gaussians(place / CURVE_FILE, results.data["points"])
        grid.append(Trained(method, scene, length, cap, decay, seed, results, mean))
    points = means(grid)
    source = folder / POINTS_FILE
    write_points(points, source)
    if curves is not None:
        source = Path(curves).resolve()
        write_points(merged(_known(curves), points), source)
    planned = [
        (method, scene, budget, trained(
            folder / "planned" / f"{method}_{scene}_{budget:g}s" / "0", train,
            [*common, *_of(method, scene, 0), f"budget={budget:g}s", f"budget_curves={source}"], folder,
        ))
        for (method, scene), budget in itertools.product(pairs, budgets)
    ]  # fmt: skip
    write_atomically(folder / TABLE_FILE, tables(grid, planned))
    write_png(folder / PICTURE_FILE, figure_picture(picture(points)))


def _known(curves: str | None) -> list[Point]:
    """The points that are in a curves file already."""
    return read_points(Path(curves)) if curves is not None and Path(curves).exists() else []


def _of(method: str, scene: str, seed: int) -> list[str]:
    return [f"method={method}", "data=synthetic", f"data.scene={scene}", f"data.scene_seed={seed}", f"seed={seed}"]


def mean_gaussians(curve: Path, start: int) -> float:
    """Gaussians in the mean over the steps of a run, straight between its validations."""
    before, total, last = (0.0, float(start)), 0.0, 0.0
    for step, count in ((row["step"], row["gaussians"]) for row in read_csv(curve)):
        total += 0.5 * (before[1] + count) * (step - before[0])
        before, last = (step, count), step
    return total / last


def means(grid: Iterable[Trained]) -> list[Point]:
    """The points of the curves: means over the seeds."""
    groups: dict[tuple, list[Trained]] = {}
    for one in grid:
        groups.setdefault((one.method, one.scene, one.steps, one.cap, one.decay), []).append(one)
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
        )
        for own in groups.values()
    ]


def tables(grid: Sequence[Trained], planned: Sequence[tuple[str, str, float, RunResults]]) -> str:
    """The grid, and each planned run beside the best run of the grid that was no slower."""
    rows = [
        (
            one.method, one.scene, f"{one.steps:,}", _cap(one.cap), f"{one.decay:g}", one.seed,
            number(one.results.cost["train_seconds"], 1), number(one.results.cost["gaussians"], 0),
            number(one.results.test["psnr"], 2),
        )
        for one in grid
    ]  # fmt: skip
    head = ("method", "scene", "steps", "Gaussians at most", "decay", "seed", "train (s)", "Gaussians", "PSNR (dB)")
    lines = ["# Accuracy against steps and Gaussians, and planned runs", "", *markdown_table(head, rows, "llrrrrrrr")]
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
                f"{best.steps:,} steps, {_cap(best.cap)}, decay {best.decay:g}", number(best.results.test["psnr"], 2),
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
            for i, ((growth, decay), curve) in enumerate(curves_of(own)[method, scene].items()):
                cap = "free" if math.isinf(growth) else f"at most {growth:g} times the start"
                _line(axes, curve, name, i, f"{cap}, decay {decay:g}")
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
