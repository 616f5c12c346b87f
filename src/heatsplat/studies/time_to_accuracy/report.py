"""What the time to an accuracy is shown as: tables, a picture and a file for programs."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from heatsplat.io.pictures import literal, series_look
from heatsplat.io.tables import NONE, markdown_table, over_seeds
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.finished import clocks
from heatsplat.studies.frontier.runs import SCORES
from heatsplat.studies.time_to_accuracy.runs import Outcome, Panel

CLOCK_LABELS = {"train_seconds": "seconds of training", "cpu_seconds": "processor seconds of training"}


def named(panel: Panel, one: Outcome) -> str:
    """What a run is called."""
    if one.recipe is not None:
        return one.recipe
    reference = panel.references.get(one.seed)
    return f"standard, {one.steps:,} steps" + (
        " (reference)" if reference is not None and one.steps == reference.steps else ""
    )


def _mean_and_spread(measures: Sequence[dict[str, float | None]], name: str, digits: int) -> str:
    """Mean and standard deviation of a measure; a dash where a run has none."""
    values = [each.get(name) for each in measures]
    return NONE if None in values else over_seeds(values, digits)


def _scores(panel: Panel) -> list[str]:
    """The scores that all runs of a panel have."""
    return [score for score in SCORES if all(score in one.scores for one in panel.outcomes)]


def ends(panel: Panel) -> list[str]:
    """Lines of the table of ends: what each recipe reaches and costs, and what the standard schedule does in the time."""
    scores = _scores(panel)
    head = ["recipe", "runs", "steps", "seconds", "of the reference's"]
    for score in scores:
        head += [DEFINITIONS[score].heading, "against the reference", "as good"]
    head += ["Gaussians", "of the reference's"]
    rows = []
    for own in panel.groups():
        rows.append([named(panel, own[0]), str(len(own)), _steps(own), *_end_cells(panel, own, scores)])
        usual = [found for one in own if one.recipe is not None and (found := panel.standard_in(one)) is not None]
        if usual and len(usual) == len(own):
            steps = f"≈ {_mean_steps(usual):,}"
            rows.append(["– standard in the same time", str(len(usual)), steps, *_end_cells(panel, usual, scores)])
    return markdown_table(head, rows, "l" + "r" * (len(head) - 1))


def _steps(own: Sequence[Outcome]) -> str:
    return f"{own[0].steps:,}" if len({one.steps for one in own}) == 1 else f"≈ {_mean_steps(own):,}"


def _mean_steps(own: Sequence[Outcome]) -> int:
    return round(statistics.fmean(one.steps for one in own))


def _end_cells(panel: Panel, own: Sequence[Outcome], scores: Sequence[str]) -> list[str]:
    measures = [panel.measures(one) for one in own]
    cells = [_mean_and_spread(measures, "seconds", 1), _mean_and_spread(measures, "time_ratio", 2)]
    for score in scores:
        digits = DEFINITIONS[score].digits
        good = sum(each[f"end_{score}"] is not None for each in measures)
        cells += [
            _mean_and_spread(measures, score, digits),
            _mean_and_spread(measures, f"{score}_off", digits),
            f"{good} of {len(own)}",
        ]
    return [*cells, _mean_and_spread(measures, "gaussians", 0), _mean_and_spread(measures, "gaussians_ratio", 2)]


def times(panel: Panel, way: str) -> list[str]:
    """Lines of the table of seconds to the reference's accuracy.

    Args:
        panel: whose.
        way: "way" by the courses over the validation views, "end" by the test views at the ends of whole runs.
    """
    scores = _scores(panel)
    head = ["recipe"]
    for score in scores:
        title = DEFINITIONS[score].title
        head += [f"to its {title} (s)", "of the standard's time to it", "of the reference's whole time"]
    rows = []
    for own in panel.groups():
        measures = [panel.measures(one) for one in own]
        cells = [
            _mean_and_spread(measures, f"{way}_{score}{suffix}", digits)
            for score in scores
            for suffix, digits in (("", 1), ("_of_own", 2), ("_of_all", 2))
        ]
        rows.append([named(panel, own[0]), *cells])
    return markdown_table(head, rows, "l" + "r" * (len(head) - 1))


def markdown(panels: Sequence[Panel], clock: str) -> str:
    """The tables for people."""
    lines = [f"# Time to the reference's accuracy, {CLOCK_LABELS[clock]}", ""]
    for panel in panels:
        margins = " and ".join(f"{panel.margins[score]:g} {DEFINITIONS[score].unit}" for score in _scores(panel))
        about = [f"As good as the reference: within {margins} of it.", clocks(one.on for one in panel.outcomes)]
        lines += [
            f"## {panel.title}", "", " ".join(filter(None, about)), "",
            "Ends of whole runs, test views:", "", *ends(panel), "",
            "Until the course over the validation views is as good as the reference's last validation:", "",
            *times(panel, "way"), "",
            "Whole runs whose end is as good as the reference's, test views:", "", *times(panel, "end"), "",
        ]  # fmt: skip
    return "\n".join([*lines, "![accuracy against seconds](time_to_accuracy.png)", ""])


def records(panels: Sequence[Panel]) -> list[dict[str, Any]]:
    """A row for every run, and for the standard schedule in the time of every recipe's run."""
    rows = []
    for panel in panels:
        for one in (one for own in panel.groups() for one in own):
            place = {"panel": panel.title, "recipe": named(panel, one), "seed": one.seed}
            rows.append({**place, "steps": one.steps, **panel.measures(one)})
            usual = panel.standard_in(one) if one.recipe is not None else None
            if usual is not None:
                name = {"recipe": f"standard in the time of {one.recipe}"}
                rows.append({**place, **name, "steps": usual.steps, **panel.measures(usual)})
    return rows


def picture(panels: Sequence[Panel], clock: str) -> Figure:
    """Accuracy against seconds, a row of axes per panel: thin lines are courses over the validation views, marks the ends.

    The black line joins ends of the standard schedule, the dashed one is the reference's accuracy, the dotted one what
    counts as good as it (means over the seeds).
    """
    names = sorted({one.recipe for panel in panels for one in panel.outcomes if one.recipe is not None})
    looks = {name: series_look(i + 10) for i, name in enumerate(names)}  # without circles, which are the standard's
    looks[None] = ("black", "o")
    figure = Figure(figsize=(11, 4.4 * len(panels)), dpi=110, layout="constrained")
    for i, panel in enumerate(panels):
        for k, score in enumerate(_scores(panel)):
            axes = figure.add_subplot(len(panels), len(SCORES), len(SCORES) * i + k + 1)
            _draw(axes, panel, score, looks)
            label = DEFINITIONS[score].heading
            axes.set(xlabel=CLOCK_LABELS[clock], ylabel=label, title=literal(panel.title), xscale="log")
            _near(axes, panel, score)
            axes.xaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25, which="both")
            if k == 0:
                axes.legend(fontsize=7)
    return figure


def _draw(axes: Any, panel: Panel, score: str, looks: Mapping[str | None, tuple[str, str]]) -> None:
    """One score of a panel's runs, and the levels of the reference."""
    standard = []
    for own in panel.groups():
        color, mark = looks[own[0].recipe]
        for one in own:
            if one.course[score]:
                axes.plot(*zip(*one.course[score], strict=True), color=color, linewidth=0.6, alpha=0.4)
        x = [one.seconds for one in own]
        y = [one.scores[score] for one in own]
        spread = [statistics.stdev(values) if len(own) > 1 else 0.0 for values in (y, x)]
        end = (statistics.fmean(x), statistics.fmean(y))
        name = literal(named(panel, own[0]))
        axes.errorbar(*end, *spread, color=color, marker=mark, capsize=2, linestyle="", label=name)
        if own[0].recipe is None:
            standard.append(end)
    if len(standard) > 1:
        axes.plot(*zip(*sorted(standard), strict=True), color="black", linewidth=1.2)
    last = statistics.fmean(one.scores[score] for one in panel.references.values())
    axes.axhline(last, color="black", linewidth=0.8, linestyle="--")
    axes.axhline(panel.level(score, last), color="black", linewidth=0.8, linestyle=":")


def _near(axes: Any, panel: Panel, score: str) -> None:
    """Shows what lies near the ends; courses begin far from them, and a reset of opacities throws them back."""
    values = [one.scores[score] for one in panel.outcomes]
    if DEFINITIONS[score].higher:
        axes.set_ylim(min(values) - 6.0, max(values) + 1.0)
    else:
        axes.set_ylim(0.7 * min(values), 3.0 * max(values))
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
