"""What the frontier is shown as: tables, a picture, a page and a file for programs."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from heatsplat.io.pictures import literal, series_look
from heatsplat.io.tables import markdown_table, number
from heatsplat.metrics.definitions import DEFINITIONS, described
from heatsplat.studies.child_runs import all_rows
from heatsplat.studies.finished import NAMES, SEEDS, clocks, ran_on
from heatsplat.studies.frontier.runs import SCORES, Recipe, dominated
from heatsplat.studies.sweeps import DRAWN

COLUMNS = ("train_seconds", "psnr", "ssim", "mae_c", "peak_memory_mb", "render_fps", "gaussians")
LEGEND = (
    "Thin lines: validation views along a run, evaluation time excluded. Marks: test views at its end. Dashed: the Pareto front "
    "of both; ends with a black edge are those that no other recipe equalled sooner."
)
WITH_SPREAD = {"train_seconds", "psnr", "mae_c"}  # beside the mean


def _reached(recipes: Sequence[Recipe], name: str, levels: Sequence[float]) -> list[float]:
    """The levels that some recipe reaches and not all reach at their first validation."""
    reached = [[recipe.seconds_to(name, level) for recipe in recipes] for level in levels]
    firsts = [[course[name][0][0] for course in recipe.table["course"] if course[name]] for recipe in recipes]
    starts = [statistics.fmean(first) if first else 0.0 for first in firsts]
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
        head = ["recipe", "runs", *(described(name).heading for name in COLUMNS), "front"]
        rows = []
        for recipe in own:
            cells = [
                number(
                    recipe.mean(name),
                    described(name).digits,
                    (recipe.spread(name) or None) if name in WITH_SPREAD else None,
                )
                for name in COLUMNS
            ]
            marks = [DEFINITIONS[name].title for name in SCORES if recipe.on_front.get(name)]
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
    """What all runs have, and the tables, for people."""
    runs = [one for recipe in recipes for one in recipe.table.itertuples()]
    jobs = [{f"{key}={value}" for key, value in one.overrides.items() if key not in SEEDS | NAMES} for one in runs]
    found = {key: [one.results.run.get(key) for one in runs] for key in ("seed", "threads")}
    about = [all_rows(sorted(set.intersection(*jobs)), **found), clocks(ran_on(one.results) for one in runs)]
    lines = ["# Accuracy against training time", "", " ".join(filter(None, about)), ""]
    for title, head, rows in tables(recipes, levels):
        lines += [f"## {title}", "", *markdown_table(head, rows, "l" + "r" * (len(head) - 1)), ""]
    return "\n".join([*lines, "![quality against seconds](frontier.svg)", "", LEGEND, ""])


def records(recipes: Sequence[Recipe]) -> list[dict[str, Any]]:
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
    every = list(dict.fromkeys(recipe.scene for recipe in recipes))
    scenes = every[:DRAWN]
    looks = {name: series_look(j) for j, name in enumerate(sorted({recipe.name for recipe in recipes}))}
    figure = Figure(figsize=(11, 4.4 * len(scenes)), dpi=110, layout="constrained")
    if len(scenes) < len(every):
        figure.suptitle(f"the first {len(scenes)} of {len(every)} scenes; the tables have all")
    for i, scene in enumerate(scenes):
        own = [recipe for recipe in recipes if recipe.scene == scene]
        for k, name in enumerate(SCORES):
            axes = figure.add_subplot(len(scenes), 2, 2 * i + k + 1)
            _draw(axes, own, name, looks)
            label = DEFINITIONS[name].heading
            axes.set(xlabel="seconds of training", ylabel=label, title=literal(scene), xscale="log")
            if name == "mae_c":
                axes.set_yscale("log")
                axes.yaxis.set_major_formatter("{x:g}")
                axes.yaxis.set_minor_formatter("{x:g}")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25, which="both")
            if k == 0 and own:
                axes.legend(fontsize=7)
    return figure


def _draw(axes: Any, recipes: Sequence[Recipe], name: str, looks: Mapping[str, tuple[str, str]]) -> None:
    """One score of the recipes of a scene, and the front of their points."""
    for recipe in recipes:
        color, mark = looks[recipe.name]
        for course in recipe.table["course"]:
            if course[name]:
                axes.plot(*zip(*course[name], strict=True), color=color, linewidth=0.8, alpha=0.5)
        x, y = recipe.mean("train_seconds"), recipe.mean(name)
        if x is not None and y is not None:
            edge = "black" if recipe.on_front.get(name) else color
            axes.errorbar(
                x, y, recipe.spread(name) or 0, color=color, marker=mark, markeredgecolor=edge, capsize=2,
                linestyle="", label=literal(recipe.name),
            )  # fmt: skip
    sign = DEFINITIONS[name].sign
    points = [(s, sign * value) for recipe in recipes for s, value in recipe.points(name)]
    front = sorted((s, sign * q) for s, q in points if not dominated(s, q, points))
    if len(front) > 1:
        axes.step(*zip(*front, strict=True), where="post", color="black", linewidth=0.8, linestyle="--")
