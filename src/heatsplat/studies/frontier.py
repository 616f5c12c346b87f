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

import yaml
from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, METRICS_FILE, RunResults, write_atomically
from heatsplat.studies.child_runs import trained
from heatsplat.studies.recorded import OVERRIDES, config_of, overrides_of
from heatsplat.studies.sweeps import named_row, settings_of, unshared

log = logging.getLogger("heatsplat")

COLUMNS = ("train_seconds", "psnr", "ssim", "mae_c", "peak_memory_mb", "render_fps", "gaussians")
# Options of the data that choose what is measured, beside the rule of the split, and those of a rule. What only training
# sees, such as data.degrade, is not here.
OF_MEASURED = ("noise_k", "only")
OF_SPLIT = {"block": ("split_fraction", "split_position"), "list": ("split_file",)}


@dataclass
class Run:
    """One finished run.

    Args:
        folder: where it lies.
        scene: its name.
        measured: what tells its validation and test views from others of the scene: "image size" -> "64x52" and the like.
        method, row: its method, and its row in a sweep ("" without).
        settings: other overrides that make its recipe, such as "thermal.frequencies=8".
        end: scores of the test views and costs, by name.
        course: score -> (seconds, value) of the validations in order.
    """

    folder: Path
    scene: str
    measured: dict[str, str]
    method: str
    row: str
    settings: list[str]
    end: dict[str, float]
    course: dict[str, list[tuple[float, float]]]


@dataclass
class Recipe:
    """The runs of one recipe on one scene.

    Args:
        scene: title of the panel: the scene, and what was measured of it where that differs between runs.
        name: of the recipe.
        runs: one per seed.
        on_front: score -> whether no other recipe of the panel was as good in less time, at its end or on its way.
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

    def course(self, name: str) -> list[tuple[float, float]]:
        """Mean (seconds, value) of each validation of a score that all runs have."""
        courses = zip(*(run.course.get(name, []) for run in self.runs), strict=False)
        return [(statistics.fmean(s for s, _ in points), statistics.fmean(v for _, v in points)) for points in courses]

    def points(self, name: str) -> list[tuple[float, float]]:
        """``course`` and the end, (seconds, value)."""
        seconds, value = self.mean("train_seconds"), self.mean(name)
        return self.course(name) + ([(seconds, value)] if seconds is not None and value is not None else [])

    def seconds_to(self, name: str, level: float) -> float | None:
        """Mean seconds until a validation reaches a level of a score; None where a run never does."""
        found = [seconds_to(run.course.get(name, []), level, higher=name == "psnr") for run in self.runs]
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
    # Folders may lie in each other; a run counts once.
    found = list({one.folder.resolve(): one for folder in folders for one in read_runs(folder)}.values())
    if not found:
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
    write_atomically(output_dir / "frontier.csv", table_csv(recipes))
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


def read_runs(folder: Path) -> list[Run]:
    """The finished runs in a folder at any depth, in the order of their paths; evaluations of a run are not runs.

    One whose files cannot be read is left out, and a warning names it and says why.
    """
    found = []
    for file in sorted(folder.rglob(METRICS_FILE)):
        place = file.parent
        if not (place / CURVE_FILE).exists() or not (place / OVERRIDES).exists():
            continue
        try:
            found.append(_read_run(place))
        except (ValueError, OSError, yaml.YAMLError, csv.Error) as error:
            log.warning("%s is left out: %s", place, error)
    return found


def _read_run(place: Path) -> Run:
    results = RunResults.read(place / METRICS_FILE)
    overrides = overrides_of(place)
    return Run(
        place,
        str(results.run.get("scene")),
        _measured(results.data, config_of(place).get("data") or {}),
        str(results.run.get("method")),
        named_row(overrides),
        settings_of(overrides),
        {name: value for name, value in (results.test | results.cost).items() if value is not None},
        _courses(place / CURVE_FILE),
    )


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
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name, course in courses.items():
                if row.get(name) and row.get("train_seconds"):
                    course.append((float(row["train_seconds"]), float(row[name])))
    return courses


def group(runs: Iterable[Run]) -> list[Recipe]:
    """Runs by panel and recipe, with what lies on the front of its panel.

    A panel is a scene whose runs measured alike views. Names leave out what all recipes share.
    """
    runs = list(runs)
    recipes: dict[tuple[str, str], Recipe] = {}
    titles = _titles(runs)
    for one, title, name in zip(runs, titles, _names(runs, titles), strict=True):
        recipes.setdefault((title, name), Recipe(title, name)).runs.append(one)
    for scene in {recipe.scene for recipe in recipes.values()}:
        of_scene = [recipe for recipe in recipes.values() if recipe.scene == scene]
        for name, sign in (("psnr", 1.0), ("mae_c", -1.0)):
            points = {id(recipe): [(s, sign * value) for s, value in recipe.points(name)] for recipe in of_scene}
            for recipe in of_scene:
                others = [point for other in of_scene if other is not recipe for point in points[id(other)]]
                if recipe.mean("train_seconds") is not None and recipe.mean(name) is not None:
                    recipe.on_front[name] = not dominated(*points[id(recipe)][-1], others)
    return sorted(recipes.values(), key=lambda recipe: (recipe.scene, recipe.mean("train_seconds") or 0.0))


def _titles(runs: Sequence[Run]) -> list[str]:
    """For each run the title of its panel: the scene, and of what was measured as much as tells panels apart."""
    titles = [one.scene for one in runs]
    for part in dict.fromkeys(name for one in runs for name in one.measured):
        values = [one.measured.get(part, "unknown") for one in runs]
        kinds: dict[str, set[str]] = {}
        for title, value in zip(titles, values, strict=True):
            kinds.setdefault(title, set()).add(value)
        titles = [
            f"{title}, {part} {value}" if len(kinds[title]) > 1 else title
            for title, value in zip(titles, values, strict=True)
        ]
    return titles


def _names(runs: Sequence[Run], titles: Sequence[str]) -> list[str]:
    """For each run the name of its recipe: method, row, and settings that tell it from others.

    A named row has those that not all runs of the row share; else they are those that not all runs share, of the data
    those that not all runs of the panel share.
    """
    settings = [one.settings for one in runs]
    several = len({(one.method, one.row, *one.settings) for one in runs}) > 1
    in_all = unshared([""] * len(runs), settings) if several else settings
    in_row = unshared([f"{one.method}, {one.row}" for one in runs], settings)
    in_panel = unshared(titles, settings) if several else settings
    names = []
    for one, of_all, of_row, of_panel in zip(runs, in_all, in_row, in_panel, strict=True):
        told = of_row if one.row else of_all
        told = " ".join(text for text in told if text in of_panel or not text.lstrip("+~").startswith("data."))
        start = f"{one.method}, {one.row}" if one.row else one.method
        names.append(start + (f"{', ' if one.row else ' '}{told}" if told else ""))
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
            digits = dict(zip(COLUMNS, (1, 2, 4, 3, 0, 0, 0), strict=True))
            cells = [_cell(recipe.mean(name), digits[name]) for name in COLUMNS]
            for i, name in ((0, "train_seconds"), (1, "psnr"), (3, "mae_c")):
                if recipe.spread(name):
                    cells[i] += f" ± {recipe.spread(name):,.{digits[name]}f}"
            marks = [label for name, label in (("psnr", "PSNR"), ("mae_c", "MAE")) if recipe.on_front.get(name)]
            rows.append([recipe.name, str(len(recipe.runs)), *cells, ", ".join(marks)])
        found.append((f"{scene}: results beside their costs{_views_of(own)}", head, rows))
        psnr, mae = _reached(own, "psnr", levels["psnr"]), _reached(own, "mae_c", levels["mae_c"])
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


def _views_of(recipes: Sequence[Recipe]) -> str:
    """How many views were measured on the way and at the end, in brackets; empty where the runs of a panel do not tell."""
    told = [(one.measured.get("validation views"), one.measured.get("test views")) for r in recipes for one in r.runs]
    if len(set(told)) != 1 or None in told[0]:
        return ""
    return f" ({told[0][0]} validation views on the way, {told[0][1]} test views at the end)"


def markdown(recipes: Sequence[Recipe], levels: Mapping[str, Sequence[float]]) -> str:
    """The tables for people."""
    lines = ["# Accuracy against training time", ""]
    for title, head, rows in tables(recipes, levels):
        lines += [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        lines += ["| " + " | ".join(row) + " |" for row in rows] + [""]
    return "\n".join([*lines, "![quality against seconds](frontier.png)", ""])


def table_csv(recipes: Sequence[Recipe]) -> str:
    """Every point of every course, all scores and costs of the ends, and which ends are on the front, for programs."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "recipe", "folder", "views", "seconds", "score", "value", "on_front"])
    for recipe, one in [(mean, one) for mean in recipes for one in mean.runs]:
        place = [recipe.scene, recipe.name, one.folder.name]
        for name, course in one.course.items():
            writer.writerows([*place, "validation", s, name, v, ""] for s, v in course)
        seconds = one.end.get("train_seconds")
        for name in COLUMNS[1:]:
            if name in one.end and seconds is not None:
                writer.writerow([*place, "test", seconds, name, one.end[name], recipe.on_front.get(name, "")])
    return text.getvalue()


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
