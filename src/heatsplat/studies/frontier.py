"""What accuracy costs in time: quality against seconds along finished runs, the Pareto front, and time to a quality.

Rules: seconds are of training alone, evaluation excluded; a course is that of the validation views, its end mark that of
the test views; runs of one recipe on one scene with different seeds are averaged. The front is that of all points, those of
courses too: an end is on it if no other recipe was as good sooner, at its end or on its way. Only runs that measured alike
views are compared. Finished runs are read, old ones too; what ``methods`` asks for is trained before.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import itertools
import logging
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, METRICS_FILE, write_atomically
from heatsplat.io.tables import markdown_table, number, read_csv, write_csv
from heatsplat.studies.child_runs import trained
from heatsplat.studies.finished import Runs, read_runs, settings_of, unshared
from heatsplat.studies.recorded import OVERRIDES

log = logging.getLogger("heatsplat")

COLUMNS = {  # digits, and whether the spread stands beside the mean
    "train_seconds": (1, True), "psnr": (2, True), "ssim": (4, False), "mae_c": (3, True),
    "peak_memory_mb": (0, False), "render_fps": (0, False), "gaussians": (0, False),
}  # fmt: skip
# Options of the data that choose what is measured, beside the rule of the split, and those of a rule. What only training
# sees, such as data.degrade, is not here.
OF_MEASURED = ("noise_k", "only")
OF_SPLIT = {"block": ("split_fraction", "split_position"), "list": ("split_file",)}


@dataclass
class Recipe(Runs):
    """The runs of one recipe on one scene; ``scene`` is the title of its panel, with what was measured where that differs.

    Args:
        on_front: score -> whether no other recipe of the panel was as good in less time, at its end or on its way.
    """

    on_front: dict[str, bool] = field(default_factory=dict)

    def course(self, name: str) -> list[tuple[float, float]]:
        """Mean (seconds, value) of each validation of a score that all runs have."""
        courses = zip(*(course[name] for course in self.table["course"]), strict=False)
        return [(statistics.fmean(s for s, _ in points), statistics.fmean(v for _, v in points)) for points in courses]

    def points(self, name: str) -> list[tuple[float, float]]:
        """``course`` and the end, (seconds, value)."""
        seconds, value = self.mean("train_seconds"), self.mean(name)
        return self.course(name) + ([(seconds, value)] if seconds is not None and value is not None else [])

    def seconds_to(self, name: str, level: float) -> float | None:
        """Mean seconds until a validation reaches a level of a score; None where a run never does."""
        found = [seconds_to(course[name], level, higher=name == "psnr") for course in self.table["course"]]
        return statistics.fmean(found) if found and None not in found else None


def run(
    output_dir: Path | str,
    runs: str | Sequence[str] | None,
    psnr_levels_db: Sequence[float],
    mae_levels_c: Sequence[float],
    methods: Sequence[str] | Mapping[str, Mapping[str, Sequence[Any]]] | None = None,
    scenes: Sequence[str] = ("heated",),
    seeds: Sequence[int] = (0,),
    knobs: Mapping[str, Sequence[Any]] | None = None,
    overrides: Sequence[str] = (),
    train: str | None = None,
    outputs: str = "outputs",
) -> list[Recipe]:
    """The recipes found; writes frontier.md, .csv, .png, .svg and .html, and the picture to TensorBoard.

    Args:
        output_dir: folder of the results, and of the runs that the study trains.
        runs: folders of finished runs or sweeps that are shown, searched to any depth; None: ``outputs`` where there are no
            methods, else no others.
        psnr_levels_db, mae_levels_c: qualities (dB; °C) until which the seconds of training are told.
        methods: what to train, every combination of them with scenes, seeds and knobs; none: nothing. With a mapping each
            has knobs of its own besides: {"etgs": {"thermal.frequencies": [8, 24]}, "3dgs": {}}.
        scenes, seeds: on which they train.
        knobs: override -> its values, of all methods.
        overrides: of all these runs.
        train: path of train.py; None: the installed heatsplat-train.
        outputs: where runs lie.

    Raises:
        SceneError: there is no finished run in them, one of the study's failed, or levels are not positive numbers.
    """
    output_dir = Path(output_dir)
    levels = {
        "psnr": checked_levels("psnr_levels_db", psnr_levels_db),
        "mae_c": checked_levels("mae_levels_c", mae_levels_c)[::-1],
    }
    if runs is None:
        runs = [] if methods else outputs
    folders = [Path(text).expanduser() for text in ([runs] if isinstance(runs, str) else runs)]
    for place, wanted in asked_for(methods or (), scenes, seeds, knobs or {}):
        trained(output_dir / "runs" / place, train, [*overrides, *wanted], output_dir)
        folders = [*folders, output_dir / "runs" / place]
    found = find_runs(folders)
    if found.empty:
        raise SceneError(
            f"runs={', '.join(map(str, folders))}: there is no finished run (no {METRICS_FILE} that can be read with a "
            f"{CURVE_FILE} beside). Give folders that src/train.py wrote, such as "
            "study.runs=[outputs/etgs_cooling,outputs/sweeps/...]; a run whose files are damaged must be trained again, in "
            "a new folder."
        )
    recipes = group(found)
    figure = picture(recipes)
    pixels = figure_picture(figure)
    write_png(output_dir / "frontier.png", pixels)
    vector = io.StringIO()
    figure.savefig(vector, format="svg", metadata={"Date": None})
    write_atomically(output_dir / "frontier.svg", vector.getvalue())
    write_csv(output_dir / "frontier.csv", _records(recipes))
    text = markdown(recipes, levels)
    write_atomically(output_dir / "frontier.md", text)
    write_atomically(output_dir / "frontier.html", page(recipes, levels, vector.getvalue()))
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(output_dir / "tb")) as writer:
        writer.add_image("frontier", pixels, dataformats="HWC")
        writer.add_text("frontier", text)
    log.info("%d runs of %d recipes:\n%s", len(found), len(recipes), text)
    return recipes


def asked_for(
    methods: Sequence[str] | Mapping[str, Mapping[str, Sequence[Any]]],
    scenes: Sequence[str],
    seeds: Sequence[int],
    knobs: Mapping[str, Sequence[Any]],
) -> list[tuple[str, list[str]]]:
    """Folder and overrides of every run that ``run`` trains."""
    jobs = []
    for method in methods:
        grid = {**knobs, **(methods[method] or {} if isinstance(methods, Mapping) else {})}
        for scene, seed, *values in itertools.product(scenes, seeds, *grid.values()):
            settings = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
            place = "_".join([method, scene, *(text.replace("/", "-") for text in settings), f"seed={seed}"])
            jobs.append((place, [f"method={method}", f"data.scene={scene}", f"seed={seed}", *settings]))
    return jobs


def checked_levels(name: str, levels: Any) -> list[float]:
    """Levels of a score in ascending order, each once.

    Raises:
        SceneError: they are no list of positive numbers; the message names the option.
    """
    numbers = list(levels) if isinstance(levels, (list, tuple)) else [None]
    for value in numbers:
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > 0
        if not good:
            raise SceneError(f"study.{name}={levels}: give positive numbers in brackets, such as [1, 2]; [] for none")
    return sorted({float(value) for value in numbers})


# Reading -------------------------------------------------------------------------------------------------------------


def find_runs(folders: Iterable[Path]) -> pd.DataFrame:
    """The finished runs in folders at any depth (``read_runs``), in the order of their paths; each once.

    Further columns: measured, what tells its validation and test views from others of the scene ("image size" -> "64x52" and
    the like), and course, score -> (seconds, value) of the validations in order. One whose files cannot be read is left out,
    and a warning names it and says why. Evaluations of a run are not runs.
    """
    places = [file.parent for folder in folders for file in sorted(folder.rglob(METRICS_FILE))]
    places = [place for place in places if (place / CURVE_FILE).exists() and (place / OVERRIDES).exists()]
    found = read_runs({place.resolve(): place for place in places}.values())  # folders may lie in each other
    if found.empty:
        return found
    courses = []
    for one in found.itertuples():
        try:
            if pd.notna(one.failed):
                raise ValueError(one.failed)
            courses.append(_courses(one.folder / CURVE_FILE))
        except (ValueError, OSError, csv.Error) as error:
            log.warning("%s is left out: %s", one.folder, error)
            courses.append(None)
    found["course"] = courses
    found = found[found["course"].notna()]
    return found.assign(measured=[_measured(one.results.data, one.data) for one in found.itertuples()])


def _measured(found: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, str]:
    """What tells the validation and test views of a run from others of a scene of this name; what is not known is left out.

    Args:
        found: section "data" of the results.
        config: options of the data.
    """
    views = found.get("views") or {}
    sizes = [str(text).partition("x")[::2] for text in found.get("image_sizes") or []]
    # Training images may be smaller than those that are measured (data.degrade), never larger.
    width, height = max(((int(w), int(h)) for w, h in sizes), key=math.prod, default=(0, 0))
    split = found.get("split", config.get("split"))
    options = [*OF_MEASURED, *OF_SPLIT.get(str(split), ())]
    known = {
        "image size": f"{width}x{height}" if width else None,
        "test views": views.get("test"),
        "validation views": views.get("val"),
        "split": split,
        **{f"data.{name}": config.get(name) for name in options},
    }
    return {name: str(value) for name, value in known.items() if value is not None}


def _courses(path: Path) -> dict[str, list[tuple[float, float]]]:
    courses: dict[str, list[tuple[float, float]]] = {"psnr": [], "mae_c": []}
    for row in read_csv(path):
        for name, course in courses.items():
            if row.get(name) is not None and row.get("train_seconds") is not None:
                course.append((float(row["train_seconds"]), float(row[name])))
    return courses


def group(runs: pd.DataFrame) -> list[Recipe]:
    """Runs by panel and recipe, with what lies on the front of its panel.

    A panel is a scene whose runs measured alike views. Names leave out what all recipes share.
    """
    titles = _titles(runs)
    panels = runs.assign(title=titles, name=_names(runs, titles)).groupby(["title", "name"], sort=False)
    recipes = [Recipe(name, title, own) for (title, name), own in panels]
    for scene in {recipe.scene for recipe in recipes}:
        of_scene = [recipe for recipe in recipes if recipe.scene == scene]
        for name, sign in (("psnr", 1.0), ("mae_c", -1.0)):
            points = {id(recipe): [(s, sign * value) for s, value in recipe.points(name)] for recipe in of_scene}
            for recipe in of_scene:
                others = [point for other in of_scene if other is not recipe for point in points[id(other)]]
                if recipe.mean("train_seconds") is not None and recipe.mean(name) is not None:
                    recipe.on_front[name] = not dominated(*points[id(recipe)][-1], others)
    return sorted(recipes, key=lambda recipe: (recipe.scene, recipe.mean("train_seconds") or 0.0))


def _titles(runs: pd.DataFrame) -> list[str]:
    """For each run the title of its panel: the scene, and of what was measured as much as tells panels apart."""
    titles = runs["scene"].tolist()
    for part in dict.fromkeys(name for measured in runs["measured"] for name in measured):
        values = [measured.get(part, "unknown") for measured in runs["measured"]]
        kinds: dict[str, set[str]] = {}
        for title, value in zip(titles, values, strict=True):
            kinds.setdefault(title, set()).add(value)
        titles = [
            f"{title}, {part} {value}" if len(kinds[title]) > 1 else title
            for title, value in zip(titles, values, strict=True)
        ]
    return titles


def _names(runs: pd.DataFrame, titles: Sequence[str]) -> list[str]:
    """For each run the name of its recipe: method, row, and settings that tell it from others.

    A named row has those that not all runs of the row share; else they are those that not all runs share, of the data
    those that not all runs of the panel share.
    """
    methods, rows, settings = runs["method"], runs["row"], [settings_of(overrides) for overrides in runs["overrides"]]
    several = len({(*one, *own) for *one, own in zip(methods, rows, settings, strict=True)}) > 1
    in_all = unshared([""] * len(runs), settings) if several else settings
    in_row = unshared([f"{method}, {row}" for method, row in zip(methods, rows, strict=True)], settings)
    in_panel = unshared(titles, settings) if several else settings
    names = []
    for method, row, of_all, of_row, of_panel in zip(methods, rows, in_all, in_row, in_panel, strict=True):
        told = of_row if row else of_all
        told = " ".join(text for text in told if text in of_panel or not text.lstrip("+~").startswith("data."))
        start = f"{method}, {row}" if row else method
        names.append(start + (f"{', ' if row else ' '}{told}" if told else ""))
    return names


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


def _reached(recipes: Sequence[Recipe], name: str, levels: Sequence[float]) -> list[float]:
    """The levels that some recipe reaches and not all reach at their first validation."""
    reached = [[recipe.seconds_to(name, level) for recipe in recipes] for level in levels]
    starts = [
        min((course[name][0][0] for course in recipe.table["course"] if course[name]), default=0.0)
        for recipe in recipes
    ]
    return [
        level
        for level, times in zip(levels, reached, strict=True)
        if any(t is not None for t in times)
        and not all(t is not None and t <= s for t, s in zip(times, starts, strict=True))
    ]


def tables(
    recipes: Sequence[Recipe], levels: Mapping[str, Sequence[float]]
) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, heading and rows of the tables of every panel: results beside costs, and time to a quality.

    Args:
        recipes: from ``group``.
        levels: score -> the qualities that are asked for, the easy ones first.
    """
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
            cells = [
                number(recipe.mean(name), digits, (spread and recipe.spread(name)) or None)
                for name, (digits, spread) in COLUMNS.items()
            ]
            marks = [label for name, label in (("psnr", "PSNR"), ("mae_c", "MAE")) if recipe.on_front.get(name)]
            rows.append([recipe.name, str(recipe.count), *cells, ", ".join(marks)])
        found.append((f"{scene}: results beside their costs{_views_of(own)}", head, rows))
        psnr, mae = _reached(own, "psnr", levels["psnr"]), _reached(own, "mae_c", levels["mae_c"])
        if psnr or mae:
            head = ["seconds to", *(f"{level:g} dB" for level in psnr), *(f"{level:g} °C" for level in mae)]
            rows = [
                [
                    recipe.name,
                    *(number(recipe.seconds_to("psnr", level), 1) for level in psnr),
                    *(number(recipe.seconds_to("mae_c", level), 1) for level in mae),
                ]
                for recipe in own
            ]
            found.append((f"{scene}: seconds of training until the validation views reach a quality", head, rows))
    return found


def _views_of(recipes: Sequence[Recipe]) -> str:
    """How many views were measured on the way and at the end, in brackets; empty where the runs of a panel do not tell."""
    measured = [one for recipe in recipes for one in recipe.table["measured"]]
    counts = {(one.get("validation views"), one.get("test views")) for one in measured}
    val, test = counts.pop() if len(counts) == 1 else (None, None)
    return "" if None in (val, test) else f" ({val} validation views on the way, {test} test views at the end)"


def markdown(recipes: Sequence[Recipe], levels: Mapping[str, Sequence[float]]) -> str:
    """The tables for people."""
    lines = ["# Accuracy against training time", ""]
    for title, head, rows in tables(recipes, levels):
        lines += [f"## {title}", "", *markdown_table(head, rows), ""]
    return "\n".join([*lines, "![quality against seconds](frontier.png)", ""])


def _records(recipes: Sequence[Recipe]) -> list[dict[str, Any]]:
    """Every point of every course, all scores and costs of the ends, and which ends are on the front, for programs."""
    records = []
    for recipe, one in ((shown, one) for shown in recipes for _, one in shown.table.iterrows()):
        place = {"scene": recipe.scene, "recipe": recipe.name, "folder": one["folder"].name}
        for score, course in one["course"].items():
            records += [
                {**place, "views": "validation", "seconds": s, "score": score, "value": v, "on_front": ""}
                for s, v in course
            ]
        seconds = one.get("train_seconds")
        for score in COLUMNS:
            value = one.get(score)
            if score != "train_seconds" and pd.notna(seconds) and pd.notna(value):
                end = {"views": "test", "seconds": seconds, "score": score, "value": value}
                records.append({**place, **end, "on_front": recipe.on_front.get(score, "")})
    return records


def picture(recipes: Sequence[Recipe]) -> Figure:
    """Quality against seconds, a row of axes per panel: thin lines are courses, marks ends, the step line the front of all.

    A recipe looks the same in all panels.
    """
    scenes = list(dict.fromkeys(recipe.scene for recipe in recipes))
    places = {name: j for j, name in enumerate(sorted({recipe.name for recipe in recipes}))}
    figure = Figure(figsize=(11, 4.4 * len(scenes)), dpi=110, layout="constrained")
    for i, scene in enumerate(scenes):
        own = [recipe for recipe in recipes if recipe.scene == scene]
        for k, (name, label) in enumerate((("psnr", "PSNR (dB)"), ("mae_c", "MAE (°C)"))):
            axes = figure.add_subplot(len(scenes), 2, 2 * i + k + 1)
            for recipe in own:
                j = places[recipe.name]
                color, mark = f"C{j % 10}", "os^Dv<>P"[j // 10 % 8]
                for course in recipe.table["course"]:
                    if course[name]:
                        axes.plot(*zip(*course[name], strict=True), color=color, linewidth=0.8, alpha=0.5)
                x, y = recipe.mean("train_seconds"), recipe.mean(name)
                if x is not None and y is not None:
                    edge = "black" if recipe.on_front.get(name) else color
                    axes.errorbar(
                        x, y, recipe.spread(name) or 0, color=color, marker=mark, markeredgecolor=edge, capsize=2,
                        linestyle="", label=recipe.name,
                    )  # fmt: skip
            sign = 1.0 if name == "psnr" else -1.0
            every = [(s, sign * value) for recipe in own for s, value in recipe.points(name)]
            front = sorted((s, sign * q) for s, q in every if not dominated(s, q, every))
            if len(front) > 1:
                axes.step(*zip(*front, strict=True), where="post", color="black", linewidth=0.8, linestyle="--")
            axes.set(xlabel="seconds of training", ylabel=label, title=scene, xscale="log")
            if name == "mae_c":
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter("{x:g}")
                axes.yaxis.set_minor_formatter("{x:g}")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25, which="both")
            if k == 0 and own:
                axes.legend(fontsize=7)
    return figure


def page(recipes: Sequence[Recipe], levels: Mapping[str, Sequence[float]], vector: str) -> str:
    """A page that needs no other file: the picture and the tables."""
    picture_data = base64.b64encode(vector.encode()).decode()
    parts = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Accuracy against training time</title>',
        "<style>body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1100px;padding:0 1em}"
        "table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .7em;border-bottom:1px solid #ccc;text-align:right}"
        "td:first-child,th:first-child{text-align:left}img{width:100%}</style>",
        "<h1>Accuracy against training time</h1>",
        f'<img alt="quality against seconds" src="data:image/svg+xml;base64,{picture_data}">',
        "<p>Thin lines: validation views along a run, evaluation time excluded. Marks: test views at its end. Dashed: the Pareto "
        "front of both; ends with a black edge are those that no other recipe equalled sooner.</p>",
    ]
    for title, head, rows in tables(recipes, levels):
        cells = "".join(f"<th>{html.escape(text)}</th>" for text in head)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in rows)
        parts.append(f"<h2>{html.escape(title)}</h2><table><tr>{cells}</tr>{body}</table>")
    return "\n".join(parts)
