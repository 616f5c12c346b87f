"""The runs of the frontier: which are read, what groups them into panels and recipes, and which ends lie on the front."""

from __future__ import annotations

import csv
import logging
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from heatsplat.io.recorded import OVERRIDES
from heatsplat.io.results import CURVE_FILE, METRICS_FILE
from heatsplat.io.tables import read_csv
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.finished import Runs, each_seed_once, read_runs, settings_of, told_apart, unshared

log = logging.getLogger("heatsplat")

SCORES = ("psnr", "mae_c")  # whose courses are compared
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
        found = [seconds_to(course[name], level, DEFINITIONS[name].higher) for course in self.table["course"]]
        return statistics.fmean(found) if found and None not in found else None


def find_runs(folders: Iterable[Path], clock: str = "train_seconds") -> pd.DataFrame:
    """The finished runs in folders at any depth (``read_runs``), in the order of their paths; each once.

    Further columns: measured, what tells its validation and test views from others of the scene ("image size" -> "64x52" and
    the like), and course, score -> (seconds, value) of the validations in order. One whose files cannot be read is left out,
    and a warning names it and says why. Evaluations of a run are not runs.

    Args:
        folders: where to look.
        clock: column of the curve whose seconds those are: "train_seconds" | "cpu_seconds".
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
            courses.append(_courses(one.folder / CURVE_FILE, clock))
        except (ValueError, OSError, csv.Error) as error:
            log.warning("%s is left out: %s", one.folder, error)
            courses.append(None)
    found["course"] = courses
    found = found[found["course"].notna()]
    return found.assign(measured=[_conditions(one.results.data, one.data) for one in found.itertuples()])


def _conditions(found: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, str]:
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


def _courses(path: Path, clock: str) -> dict[str, list[tuple[float, float]]]:
    courses: dict[str, list[tuple[float, float]]] = {name: [] for name in SCORES}
    for row in read_csv(path):
        for name, course in courses.items():
            if row.get(name) is not None and row.get(clock) is not None:
                course.append((float(row[clock]), float(row[name])))
    return courses


def group(runs: pd.DataFrame) -> list[Recipe]:
    """Runs by panel and recipe, with what lies on the front of its panel.

    A panel is a scene whose runs measured alike views. Names leave out what all recipes share. Each seed of a recipe counts
    once, the last run of it.
    """
    titles = panel_titles(runs)
    runs = runs.assign(title=titles, name=_names(runs, titles))
    runs = each_seed_once(runs, [*zip(runs["title"], runs["name"], strict=True)])
    panels = runs.groupby(["title", "name"], sort=False)
    recipes = [Recipe(name, title, own) for (title, name), own in panels]
    for scene in {recipe.scene for recipe in recipes}:
        of_scene = [recipe for recipe in recipes if recipe.scene == scene]
        for name in SCORES:
            sign = DEFINITIONS[name].sign
            points = {id(recipe): [(s, sign * value) for s, value in recipe.points(name)] for recipe in of_scene}
            for recipe in of_scene:
                others = [point for other in of_scene if other is not recipe for point in points[id(other)]]
                if recipe.mean("train_seconds") is not None and recipe.mean(name) is not None:
                    recipe.on_front[name] = not dominated(*points[id(recipe)][-1], others)
    return sorted(recipes, key=lambda recipe: (recipe.scene, recipe.mean("train_seconds") or 0.0))


def panel_titles(runs: pd.DataFrame) -> list[str]:
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
    those that not all runs of the panel share. Runs that differ in more than their seeds have that in their names too
    (``told_apart``).
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
    apart = told_apart([*zip(titles, names, strict=True)], runs["overrides"])
    return [" ".join([name, *words]) for name, words in zip(names, apart, strict=True)]


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
