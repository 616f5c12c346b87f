"""Ours beside the paper's: a published table with what the runs of a sweep found, for people and for programs."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from heatsplat.io.files import write_atomically
from heatsplat.io.results import RunResults
from heatsplat.io.tables import NONE, markdown_table, number, write_csv
from heatsplat.metrics.definitions import COSTS
from heatsplat.studies.finished import Runs
from heatsplat.studies.published.figures import METRICS, Figure
from heatsplat.studies.published.reproduction import Reproduction, row_name
from heatsplat.studies.sweeps import collect

COMPARISON_FILE, COMPARISON_CSV = "comparison.md", "comparison.csv"
BESIDE = ("train_seconds", "peak_memory_mb", "gaussians")  # costs that stand beside every row
THAT_RAN = "mean of the scenes that ran"


@dataclass
class Line:
    """One line of the comparison.

    Args:
        scene, method, setting: of the table; ``scene`` may begin with ``THAT_RAN``.
        members: the scenes that its figures are means of.
        have: those of them that have results.
        ours: metric -> our mean, in the table's unit.
        spread: metric -> standard deviation over seeds, of single scenes.
        seeds: runs per scene; the fewest.
        cost: name of a cost -> our mean.
        printed: metric -> the paper's figure.
        theirs: metric -> its value, or the mean of the printed values of the same scenes.
        other: overrides that tell ours from other runs of the row in the folder; empty where there are no others.
    """

    scene: str
    method: str
    setting: str
    members: tuple[str, ...]
    have: tuple[str, ...] = ()
    ours: dict[str, float] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)
    seeds: int = 0
    cost: dict[str, float] = field(default_factory=dict)
    printed: dict[str, Figure] = field(default_factory=dict)
    theirs: dict[str, float] = field(default_factory=dict)
    other: str = ""

    def difference(self, metric: str) -> float | None:
        """Ours less theirs, None where either is missing."""
        pair = (self.ours.get(metric), self.theirs.get(metric))
        return None if None in pair else pair[0] - pair[1]

    @property
    def label(self) -> str:
        """The scene, and of how many scenes ours is the mean where it is not all."""
        name = self.scene or "(scenes not named)"
        partial = self.have and len(self.have) < len(self.members)
        return f"{name} ({len(self.have)} of {len(self.members)})" if partial else name


def write_comparison(folder: Path, reproduction: Reproduction) -> list[Path]:
    """Writes comparison.md and comparison.csv into the folder of a sweep, and returns their paths.

    All runs in the folder count, those of earlier commands too, which may have asked for other scenes and methods.
    """
    found = collect(folder)
    reproduction = _with_all_rows(reproduction, found)
    lines = compare_all(reproduction, found)
    failed = [f"{row.label} on {row.scene}: {reason}" for row in found for reason in row.failed]
    results = [one for row in found for one in row.table["results"].dropna()]
    write_atomically(folder / COMPARISON_FILE, markdown(reproduction, lines, _reasons(results, reproduction), failed))
    write_csv(folder / COMPARISON_CSV, _records(lines))
    return [folder / COMPARISON_FILE, folder / COMPARISON_CSV]


def _with_all_rows(reproduction: Reproduction, found: Sequence[Runs]) -> Reproduction:
    """The table with every row that has results; none of them is absent."""
    have = {row.name: row for row in found if row.count and reproduction.scene_of(row.scene)}
    settings = dict.fromkeys(setting for _, setting in reproduction.rows)
    of_runs = [
        (method, setting)
        for name, row in have.items()
        for method in row.table["method"].unique()
        for setting in settings
        if row_name(method, setting) == name
    ]
    absent = {row: why for row, why in reproduction.absent.items() if row_name(*row) not in have}
    return replace(reproduction, rows=tuple(dict.fromkeys([*reproduction.rows, *of_runs])), absent=absent)


def compare_all(reproduction: Reproduction, found: Sequence[Runs]) -> list[Line]:
    """The lines of the comparison; a row that ran with several settings (``Runs.other``) has a line for each of them."""
    key_of = {row.scene: reproduction.scene_of(row.scene) for row in found}
    known = [row for row in found if key_of[row.scene] is not None]
    lines = [
        replace(line, other=other)
        for other in dict.fromkeys(row.other for row in known) or [""]
        for line in compare(reproduction, {(row.name, key_of[row.scene]): row for row in known if row.other == other})
    ]
    alike: dict[tuple[str, str, str, tuple[str, ...]], list[Line]] = {}
    for line in lines:
        alike.setdefault((line.scene, line.method, line.setting, line.members), []).append(line)
    shown = ([line for line in same if line.have] or [replace(same[0], other="")] for same in alike.values())
    return [line for same in shown for line in same]


def compare(reproduction: Reproduction, results: Mapping[tuple[str, str], Runs]) -> list[Line]:
    """The lines of the comparison, scene by scene in the order of the table.

    A printed mean of several scenes has a value of ours where all of them have results. Else ours stands in a line
    ``THAT_RAN``, beside the mean of what is printed for the same scenes, where that is.

    Args:
        reproduction: the table.
        results: (name of the row, scene) -> its runs.
    """
    printed: dict[tuple[str, str, str], dict[str, Figure]] = {}
    for figure in reproduction.figures:
        printed.setdefault((figure.scene, figure.method, figure.setting), {})[figure.metric] = figure
    scenes = list(dict.fromkeys(figure.scene for figure in reproduction.figures))
    rows = reproduction.rows or tuple(dict.fromkeys((figure.method, figure.setting) for figure in reproduction.figures))
    of_paper = {(method, setting) for _, method, setting in printed}
    lines, incomplete = [], []
    for scene in scenes:
        members = reproduction.members(scene)
        for method, setting in rows:
            figures = printed.get((scene, method, setting), {})
            if not figures and (method, setting) in of_paper:
                continue
            line = Line(scene, method, setting, members, printed=figures)
            line.theirs = {name: figure.value for name, figure in figures.items() if figure.value is not None}
            have = tuple(member for member in members if _of(results, method, setting, member))
            if len(have) < len(members) > 1:
                incomplete.append((line, have))  # the printed mean is of other scenes; see below
            else:
                _fill(reproduction, line, have, results)
            lines.append(line)
    for line, have in incomplete:
        if have:
            name = f"{THAT_RAN}, {line.scene}" if line.scene in reproduction.source.groups else THAT_RAN
            part = Line(name, line.method, line.setting, line.members)
            _fill(reproduction, part, have, results)
            per_scene = [printed.get((scene, line.method, line.setting), {}) for scene in have]
            part.theirs = _printed_means(line.printed, per_scene)
            lines.append(part)
    return lines


def _printed_means(metrics: Iterable[str], per_scene: Sequence[Mapping[str, Figure]]) -> dict[str, float]:
    """The mean over scenes of each metric that is printed for all of them."""
    means = {}
    for metric in metrics:
        values = [figures[metric].value for figures in per_scene if metric in figures]
        if len(values) == len(per_scene) and None not in values:
            means[metric] = statistics.fmean(values)
    return means


def _of(results: Mapping[tuple[str, str], Runs], method: str, setting: str, scene: str) -> Runs | None:
    row = results.get((row_name(method, setting), scene))
    return row if row and row.count else None


def _fill(
    reproduction: Reproduction, line: Line, have: tuple[str, ...], results: Mapping[tuple[str, str], Runs]
) -> None:
    """Puts ours into a line: the mean over scenes of the means over seeds."""
    runs = [row for scene in have if (row := _of(results, line.method, line.setting, scene))]
    line.have, line.seeds = have, min((row.count for row in runs), default=0)
    for metric in reproduction.printed_metrics:
        ours = reproduction.ours(metric)
        values = [row.mean(ours) for row in runs] if ours else []
        if values and None not in values:
            line.ours[metric] = statistics.fmean(METRICS[metric].convert(value) for value in values)
            if len(runs) == 1 and runs[0].spread(ours) is not None:
                line.spread[metric] = METRICS[metric].convert(runs[0].spread(ours))
    for name in BESIDE:
        values = [row.mean(name) for row in runs]
        if values and None not in values:
            line.cost[name] = statistics.fmean(values)


def _reasons(runs: Sequence[RunResults], reproduction: Reproduction) -> list[str]:
    """Why printed metrics have no value of ours, a line each."""
    lines = []
    for metric in reproduction.printed_metrics:
        ours, known = reproduction.ours(metric), METRICS[metric]
        if ours is None:
            lines.append(f"{known.title}: {known.why_not}")
        elif runs and not any((run.test | run.cost).get(ours) is not None for run in runs):
            keys = (f"test.{ours}", f"cost.{ours}")
            reason = next((run.reasons[key] for run in runs for key in keys if key in run.reasons), "not measured")
            lines.append(f"{known.title}: n/a, {reason}")
    return lines


def markdown(
    reproduction: Reproduction, lines: Sequence[Line], reasons: Sequence[str] = (), failed: Sequence[str] = ()
) -> str:
    """The comparison for people. A cell reads ours / paper's (ours less paper's)."""
    text = [
        f"# {reproduction.title}: ours beside the paper's",
        "",
        "A cell reads: ours / printed (ours less printed). – is none. Ours is a mean over seeds (± standard deviation where "
        "there are several), then over scenes. Seconds, memory and frames/s are of other machines than the paper's.",
        "",
        *_table(reproduction, lines),
    ]
    for title, items in (
        ("Without ours", [*reproduction.left_out(), *reasons]),
        ("Not on disk", [", ".join(reproduction.missing)] if reproduction.missing else []),
        ("Jobs without a result", failed),
        ("Notes", _notes(reproduction)),
        ("How cells were read", list(dict.fromkeys(figure.note for figure in reproduction.figures if figure.note))),
    ):
        if items:
            text += ["", f"## {title}", "", *(f"- {item}" for item in items)]
    return "\n".join([*text, ""])


def _table(reproduction: Reproduction, lines: Sequence[Line]) -> list[str]:
    """Lines of the table: what the paper prints beside ours, then what ours cost, where the paper does not print that."""
    metrics = reproduction.printed_metrics
    compared = {reproduction.ours(metric) for metric in metrics}
    costs = [name for name in BESIDE if name not in compared and any(name in line.cost for line in lines)]
    several = any(setting for _, setting in reproduction.rows)
    head = ["scene", "method", *(["setting"] if several else []), *(METRICS[metric].title for metric in metrics)]
    head += [f"ours: {COSTS[name].heading}" for name in costs]
    rows = []
    for line in lines:
        method = ", ".join(filter(None, [line.method, line.other])) or NONE
        cells = [line.label, method, *([line.setting or NONE] if several else [])]
        cells += [_cell(line, metric) for metric in metrics]
        rows.append(cells + [number(line.cost.get(name), COSTS[name].digits) for name in costs])
    return markdown_table(head, rows)


def _notes(reproduction: Reproduction) -> list[str]:
    """Which of our scores stand for printed metrics, and what is doubtful about data set and table."""
    ours = {
        metric: reproduction.metrics[metric]
        for metric in reproduction.printed_metrics
        if metric in reproduction.metrics
    }
    notes = [f"{METRICS[metric].title} of ours is `{name}` (docs/conventions.md)." for metric, name in ours.items()]
    unsure = [reproduction.source.unsure] if reproduction.source and reproduction.source.unsure else []
    return [*notes, *unsure, *reproduction.notes]


def _cell(line: Line, metric: str) -> str:
    digits, figure = METRICS[metric].digits, line.printed.get(metric)
    ours, theirs, difference = line.ours.get(metric), line.theirs.get(metric), line.difference(metric)
    paper = (figure.printed if figure else "" if theirs is None else f"{theirs:.{digits}f}") or NONE
    if ours is None:
        return paper if paper == NONE else f"{NONE} / {paper}"
    text = f"{number(ours, digits, line.spread.get(metric))} / {paper}"
    return text if difference is None else f"{text} ({difference:+,.{digits}f})"


def _records(lines: Sequence[Line]) -> list[dict[str, Any]]:
    """The comparison for programs: a row per scene, method, setting and metric, in full precision."""
    rows = []
    for line in lines:
        for metric in dict.fromkeys([*line.printed, *line.ours]):
            figure = line.printed.get(metric)
            rows.append(
                {
                    "scene": line.scene,
                    "method": line.method,
                    "setting": line.setting,
                    "overrides": line.other,
                    "metric": metric,
                    "ours": line.ours.get(metric),
                    "ours_std": line.spread.get(metric),
                    "runs": line.seeds,
                    "scenes": len(line.have),
                    "printed": figure.printed if figure else line.theirs.get(metric),
                    "difference": line.difference(metric),
                    **{name: line.cost.get(name) for name in BESIDE},
                    "note": figure.note if figure else "",
                }
            )
    return rows
