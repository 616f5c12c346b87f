"""What accuracy costs in time: quality against seconds along finished runs, the Pareto front, and time to a quality.

Rules: seconds are of training alone, evaluation excluded; a course is that of the validation views, its end mark that of
the test views; runs of one recipe on one scene with different seeds are averaged at their ends. Runs are read, not made:
any folder below outputs/ will do, old ones too.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import logging
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import METRICS_FILE, RunResults, write_atomically
from heatsplat.studies.sweeps import row_name

log = logging.getLogger("heatsplat")

CURVE_FILE = "curve.csv"
PSNR_LEVELS = (15, 20, 25, 30, 32, 34, 36, 38, 40, 42, 44, 46)
MAE_LEVELS = (5.0, 2.0, 1.0, 0.5, 0.3, 0.2, 0.1, 0.05)
COLUMNS = ("train_seconds", "psnr", "ssim", "mae_c", "peak_memory_mb", "render_fps", "gaussians")


@dataclass
class Run:
    """One finished run.

    Args:
        folder: where it lies.
        scene, recipe: what was reconstructed and how.
        end: scores of the test views and costs, by name.
        course: score -> (seconds, value) of the validations in order.
    """

    folder: Path
    scene: str
    recipe: str
    end: dict[str, float]
    course: dict[str, list[tuple[float, float]]]


@dataclass
class Recipe:
    """The runs of one recipe on one scene.

    Args:
        scene, name: which.
        runs: one per seed.
        on_front: score -> whether no other recipe of the scene is as good in less time.
    """

    scene: str
    name: str
    runs: list[Run] = field(default_factory=list)
    on_front: dict[str, bool] = field(default_factory=dict)

    def mean(self, name: str) -> float | None:
        """Mean of a score or cost at the end of the runs that have it."""
        values = [run.end[name] for run in self.runs if name in run.end]
        return statistics.fmean(values) if values else None

    def spread(self, name: str) -> float:
        """Its standard deviation, 0 for fewer than two."""
        values = [run.end[name] for run in self.runs if name in run.end]
        return statistics.stdev(values) if len(values) > 1 else 0.0

    def seconds_to(self, name: str, level: float) -> float | None:
        """Mean seconds until a validation reaches a level of a score; None where a run never does."""
        found = [seconds_to(run.course.get(name, []), level, higher=name == "psnr") for run in self.runs]
        return statistics.fmean(found) if found and None not in found else None


def run(output_dir: Path | str, runs: str | Sequence[str]) -> list[Recipe]:
    """The recipes found; writes frontier.md, .csv, .png, .svg and .html, and the picture to TensorBoard.

    Args:
        output_dir: folder of the results.
        runs: folders of runs or sweeps, searched to any depth.

    Raises:
        SceneError: there is no finished run in them.
    """
    output_dir = Path(output_dir)
    folders = [Path(text).expanduser() for text in ([runs] if isinstance(runs, str) else runs)]
    found = [one for folder in folders for one in read_runs(folder)]
    if not found:
        raise SceneError(
            f"runs={', '.join(map(str, folders))}: there is no finished run (no {METRICS_FILE} with a {CURVE_FILE} beside). "
            "Give folders that src/train.py wrote, such as runs=[outputs/etgs_cooling,outputs/sweeps/...]."
        )
    recipes = group(found)
    figure = picture(recipes)
    pixels = figure_picture(figure)
    write_png(output_dir / "frontier.png", pixels)
    vector = io.StringIO()
    figure.savefig(vector, format="svg", metadata={"Date": None})
    write_atomically(output_dir / "frontier.svg", vector.getvalue())
    write_atomically(output_dir / "frontier.csv", table_csv(found))
    text = markdown(recipes)
    write_atomically(output_dir / "frontier.md", text)
    write_atomically(output_dir / "frontier.html", page(recipes, vector.getvalue()))
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(output_dir / "tb")) as writer:
        writer.add_image("frontier", pixels, dataformats="HWC")
        writer.add_text("frontier", text)
    log.info("%d runs of %d recipes:\n%s", len(found), len(recipes), text)
    return recipes


# Reading -------------------------------------------------------------------------------------------------------------


def read_runs(folder: Path) -> list[Run]:
    """The finished runs in a folder at any depth, in the order of their paths; evaluations of a run are not runs."""
    found = []
    for file in sorted(folder.rglob(METRICS_FILE)):
        curve, hydra = file.parent / CURVE_FILE, file.parent / ".hydra"
        if not curve.exists() or not (hydra / "overrides.yaml").exists():
            continue
        results = RunResults.read(file)
        overrides = yaml.safe_load((hydra / "overrides.yaml").read_text(encoding="utf-8")) or []
        settings = dict(text.partition("=")[::2] for text in overrides)
        recipe = settings.get("row", "").strip("'\"")
        method = str(results.run.get("method"))
        recipe = f"{method}, {recipe}" if recipe else row_name({"method": method} | settings)
        end = {name: value for name, value in (results.test | results.cost).items() if value is not None}
        found.append(Run(file.parent, str(results.run.get("scene")), recipe, end, _courses(curve)))
    return found


def _courses(path: Path) -> dict[str, list[tuple[float, float]]]:
    courses: dict[str, list[tuple[float, float]]] = {"psnr": [], "mae_c": []}
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name, course in courses.items():
                if row.get(name) and row.get("train_seconds"):
                    course.append((float(row["train_seconds"]), float(row[name])))
    return courses


def group(runs: Iterable[Run]) -> list[Recipe]:
    """Runs by scene and recipe, with what lies on the front of its scene; names leave out what all recipes share."""
    runs = list(runs)
    settings = [set(one.recipe.split(" ")[1:]) for one in runs]
    shared = set.intersection(*settings) if len({one.recipe for one in runs}) > 1 else set()
    for one in runs:
        one.recipe = " ".join(word for word in one.recipe.split(" ") if word not in shared)
    recipes: dict[tuple[str, str], Recipe] = {}
    for one in runs:
        recipes.setdefault((one.scene, one.recipe), Recipe(one.scene, one.recipe)).runs.append(one)
    for scene in {recipe.scene for recipe in recipes.values()}:
        of_scene = [recipe for recipe in recipes.values() if recipe.scene == scene]
        for name, sign in (("psnr", 1.0), ("mae_c", -1.0)):
            points = [
                (recipe, recipe.mean("train_seconds"), sign * recipe.mean(name))
                for recipe in of_scene
                if recipe.mean("train_seconds") is not None and recipe.mean(name) is not None
            ]
            for recipe, seconds, quality in points:
                recipe.on_front[name] = not dominated(seconds, quality, [(s, q) for _, s, q in points])
    return sorted(recipes.values(), key=lambda recipe: (recipe.scene, recipe.mean("train_seconds") or 0.0))


def dominated(seconds: float, quality: float, points: Iterable[tuple[float, float]]) -> bool:
    """Whether one of ``points`` (seconds, quality) is as quick and as good, and better in one of the two."""
    return any(s <= seconds and q >= quality and (s < seconds or q > quality) for s, q in points)


def seconds_to(course: Sequence[tuple[float, float]], level: float, higher: bool) -> float | None:
    """Seconds at which a course reaches ``level``, on the line between its validations; None where it never does.

    Args:
        course: (seconds, value) in order.
        higher: whether larger values are better.
    """
    before: tuple[float, float] | None = None
    for seconds, value in course:
        if (value >= level) if higher else (value <= level):
            if before is None or before[1] == value:
                return seconds
            share = (level - before[1]) / (value - before[1])
            return before[0] + share * (seconds - before[0])
        before = (seconds, value)
    return None


# Writing -------------------------------------------------------------------------------------------------------------


def _levels(recipes: Sequence[Recipe], name: str, levels: Sequence[float]) -> list[float]:
    """The levels that some recipe reaches and not all reach at their first validation."""
    reached = [[recipe.seconds_to(name, level) for recipe in recipes] for level in levels]
    starts = [
        min((run.course[name][0][0] for run in recipe.runs if run.course.get(name)), default=0.0) for recipe in recipes
    ]
    return [
        level
        for level, times in zip(levels, reached, strict=True)
        if any(t is not None for t in times)
        and not all(t is not None and t <= s for t, s in zip(times, starts, strict=True))
    ]


def _cell(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:,.{digits}f}"


def tables(recipes: Sequence[Recipe]) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, heading and rows of the tables of every scene: results beside costs, and time to a quality."""
    found = []
    for scene in dict.fromkeys(recipe.scene for recipe in recipes):
        own = [recipe for recipe in recipes if recipe.scene == scene]
        head = [
            "recipe",
            "runs",
            "train (s)",
            "PSNR (dB)",
            "SSIM",
            "MAE (°C)",
            "memory (MB)",
            "frames/s",
            "Gaussians",
            "front",
        ]
        rows = []
        for recipe in own:
            digits = dict(zip(COLUMNS, (1, 2, 4, 3, 0, 0, 0), strict=True))
            cells = [_cell(recipe.mean(name), digits[name]) for name in COLUMNS]
            for i, name in ((0, "train_seconds"), (1, "psnr"), (3, "mae_c")):
                if recipe.spread(name):
                    cells[i] += f" ± {recipe.spread(name):,.{digits[name]}f}"
            marks = [label for name, label in (("psnr", "PSNR"), ("mae_c", "MAE")) if recipe.on_front.get(name)]
            rows.append([recipe.name, str(len(recipe.runs)), *cells, ", ".join(marks)])
        found.append((f"{scene}: results beside their costs", head, rows))
        psnr, mae = _levels(own, "psnr", PSNR_LEVELS), _levels(own, "mae_c", MAE_LEVELS)
        if psnr or mae:
            head = ["seconds to", *(f"{level:g} dB" for level in psnr), *(f"{level:g} °C" for level in mae)]
            rows = [
                [
                    recipe.name,
                    *(_cell(recipe.seconds_to("psnr", level), 1) for level in psnr),
                    *(_cell(recipe.seconds_to("mae_c", level), 1) for level in mae),
                ]
                for recipe in own
            ]
            found.append((f"{scene}: seconds of training until the validation views reach a quality", head, rows))
    return found


def markdown(recipes: Sequence[Recipe]) -> str:
    """The tables for people."""
    lines = ["# Accuracy against training time", ""]
    for title, head, rows in tables(recipes):
        lines += [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        lines += ["| " + " | ".join(row) + " |" for row in rows] + [""]
    return "\n".join([*lines, "![quality against seconds](frontier.png)", ""])


def table_csv(runs: Sequence[Run]) -> str:
    """Every point of every course, and the ends, for programs."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "recipe", "folder", "views", "seconds", "score", "value"])
    for one in runs:
        for name, course in one.course.items():
            writer.writerows([one.scene, one.recipe, one.folder.name, "validation", s, name, v] for s, v in course)
            if name in one.end and "train_seconds" in one.end:
                writer.writerow(
                    [one.scene, one.recipe, one.folder.name, "test", one.end["train_seconds"], name, one.end[name]]
                )
    return text.getvalue()


def picture(recipes: Sequence[Recipe]) -> Figure:
    """Quality against seconds, a row of axes per scene: thin lines are courses, marks ends, the step line the front."""
    scenes = list(dict.fromkeys(recipe.scene for recipe in recipes))
    figure = Figure(figsize=(11, 4.4 * len(scenes)), dpi=110, layout="constrained")
    for i, scene in enumerate(scenes):
        own = [recipe for recipe in recipes if recipe.scene == scene]
        for k, (name, label) in enumerate((("psnr", "PSNR (dB)"), ("mae_c", "MAE (°C)"))):
            axes = figure.add_subplot(len(scenes), 2, 2 * i + k + 1)
            for j, recipe in enumerate(own):
                color, mark = f"C{j % 10}", "os^Dv<>P"[j // 10 % 8]
                for one in recipe.runs:
                    if one.course.get(name):
                        axes.plot(*zip(*one.course[name], strict=True), color=color, linewidth=0.8, alpha=0.5)
                x, y = recipe.mean("train_seconds"), recipe.mean(name)
                if x is not None and y is not None:
                    edge = "black" if recipe.on_front.get(name) else color
                    axes.errorbar(
                        x, y, recipe.spread(name), color=color, marker=mark, markeredgecolor=edge, capsize=2,
                        linestyle="", label=recipe.name,
                    )  # fmt: skip
            front = sorted((r.mean("train_seconds"), r.mean(name)) for r in own if r.on_front.get(name))
            if len(front) > 1:
                axes.step(*zip(*front, strict=True), where="post", color="black", linewidth=0.8, linestyle="--")
            axes.set(xlabel="seconds of training", ylabel=label, title=scene, xscale="log")
            if name == "mae_c":
                axes.set_yscale("log")
            axes.grid(alpha=0.25, which="both")
            if k == 0 and own:
                axes.legend(fontsize=7)
    return figure


def page(recipes: Sequence[Recipe], vector: str) -> str:
    """A page that needs no other file: the picture and the tables."""
    picture_data = base64.b64encode(vector.encode()).decode()
    parts = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Accuracy against training time</title>',
        "<style>body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1100px;padding:0 1em}"
        "table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .7em;border-bottom:1px solid #ccc;text-align:right}"
        "td:first-child,th:first-child{text-align:left}img{width:100%}</style>",
        "<h1>Accuracy against training time</h1>",
        f'<img alt="quality against seconds" src="data:image/svg+xml;base64,{picture_data}">',
        "<p>Thin lines: validation views along a run, evaluation time excluded. Marks: test views at its end; black edges "
        "lie on the Pareto front.</p>",
    ]
    for title, head, rows in tables(recipes):
        cells = "".join(f"<th>{html.escape(text)}</th>" for text in head)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in rows)
        parts.append(f"<h2>{html.escape(title)}</h2><table><tr>{cells}</tr>{body}</table>")
    return "\n".join(parts)
