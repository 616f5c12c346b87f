"""Pictures and pages of what accuracy costs."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.tables import NONE, markdown_table
from heatsplat.physics.responses import RATES

LEVELS_K = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-6)
BLOWN_K = 300.0  # and more is drawn at the upper edge
MIN_K = 1e-10  # and less at the lower edge
CAMERA_K = 0.03  # noise of a good thermal camera
EQUAL = 2.0  # errors within this factor are of one accuracy
STYLES = {  # colour, mark
    "closed form, fused kernel": ("#d1231c", "*"),
    "closed form, torch": ("#ef8a17", "*"),
    "balance, time-stepped kernel": ("#d1231c", "*"),
    "rate table": ("#b8479c", "P"),
    "printed formula": ("#000000", "X"),
    "explicit Euler": ("#9aa0a6", "o"),
    "RK4": ("#3b6fb6", "s"),
    "exponential Euler": ("#2a9d8f", "^"),
    "ETD2": ("#5fa52c", "v"),
    "implicit Adams (torchdiffeq)": ("#8c6d4f", "d"),
    "dopri5 (torchdiffeq)": ("#6a4fb3", "D"),
    "Radau (scipy)": ("#1b9ad6", "h"),
}


def rules(settings: Mapping[str, Any], load: float, seconds: float) -> list[str]:
    """The rules, one or a few sentences each.

    Args:
        settings: of the study.
        load: of the machine.
        seconds: that the study took.
    """
    return [
        "One process, one thread, {gaussians} Gaussians, {frames} frames, K = {frequencies} frequencies. "
        "No gradients are requested; the time-stepped kernel computes its own anyway.".format(**settings),
        "Times are CPU time, the minimum of {rounds} rounds in which the solvers alternate; solvers that take more than "
        "{once_above_s:g} s run once. Integrations that take more than {limit_s:g} s ({adaptive_limit_s:g} s with adaptive "
        "steps) are stopped and listed. The time of an adaptive solver includes its controller and rejected steps.".format(
            **settings
        ),
        "*In order*: the solver passes through all frames once, the best case for an integration. *Alone*: each frame is "
        "computed separately, as in training, so an integration starts anew each time. This is not measured but scaled from the "
        "first, by the share of the record before each frame. Solvers that evaluate any time directly cost the same in both.",
        "Errors are in kelvin: the maximum and the root mean square over all frames of {sample} Gaussians, including those with "
        "the fastest and the slowest rate. The reference is the formula with 50 digits (mpmath) if there is one; with T⁴ "
        "it is scipy's LSODA at 1e-12, restarted at each weather sample. Inputs are float32 values.".format(**settings),
        "Integrations step onto every frame and every weather sample (except Radau, whose frames are interpolated), use "
        "one matrix-vector product for all harmonics, share the source between stages at the same time, and reuse "
        "exponentials while steps and rates stay equal. All run in torch. torchdiffeq's implicit Adams iterates without a "
        "Jacobian; scipy's Radau has the exact, diagonal one, and runs in float64 only.",
        "Tables that depend only on the weather record are built once per scene; their time is listed separately and not "
        "included. Tables of a single frame are included.",
        "Exponential Euler is exact for cooling, and so is ETD2 for weather without T⁴ and wind with steps at its samples: "
        "there they are closed forms, applied step by step.",
        f"The machine's load was {load:.1f}; the study took {seconds:.0f} s.",
    ]


def write(
    rows: Sequence[Any],
    titles: dict[str, str],
    rules: Sequence[str],
    folder: Path,
    document: str | None,
    pictures: str | None,
) -> str:
    """The text of table.md, which is written with the pictures into ``folder``; see ``run`` for the rest."""
    body = markdown(rows, titles)
    for name, order, title in (
        ("work_precision", "us", "All frames in order"),
        ("work_precision_alone", "us_alone", "Each frame by itself, as in training"),
    ):
        figure = picture(rows, titles, order, title)
        pixels = figure_picture(figure)
        for place in (folder, *([] if pictures is None else [Path(pictures)])):
            write_png(place / f"{name}.png", pixels)
        vector = io.StringIO()
        figure.savefig(vector, format="svg", metadata={"Date": None})
        write_atomically(folder / f"{name}.svg", vector.getvalue())
    stated = ["## Rules", "", *(f"- {rule}" for rule in rules), ""]
    verdicts = [
        "## Results",
        "",
        "For each problem the Pareto front, and beside each solver of ours the fastest other one with at most twice its error.",
        "",
        *(line for name in titles for line in _verdict(rows, name, titles[name])),
        "",
    ]

    def page(where: str) -> str:
        shown = [
            f"![error against time, frames in order]({where}work_precision.png)", "",
            f"![error against time, each frame by itself]({where}work_precision_alone.png)", "",
        ]  # fmt: skip
        return "\n".join([*HEAD, "", "## Pictures", "", *LEGEND, "", *shown, *verdicts, *stated, *body]).rstrip() + "\n"

    write_atomically(folder / "table.md", page(""))
    if document is not None:
        write_atomically(document, page("pictures/"))
    return "\n".join([*verdicts, *stated, *body])


HEAD = [
    "# What accuracy costs",
    "",
    "Generated by `python src/study.py study=work_precision`, which repeats the measurements in some minutes. Times depend "
    "on the machine, errors do not.",
    "",
    "How long a solver takes for the temperature of a Gaussian, and how far off it is: our closed forms, rate tables and "
    "time-stepped kernel beside usual integrators, on six problems of heat. [Results](#results) says for each which are the "
    "fastest for their error, ours or not.",
]
LEGEND = [
    "Faster is to the left, more accurate is lower. Stars and markers with a black edge are ours. Filled markers are float32, "
    "open ones float64. The grey line is the Pareto front: no point is both faster and more accurate. The dotted line is the "
    f"noise of a good camera, {CAMERA_K:g} K. Faint markers on the upper edge diverged; markers on the lower edge have errors "
    f"below {MIN_K:g} K.",
]


def drawn(row: Any) -> float:
    """The worst error, kept within the axes."""
    return min(max(row.worst_k, MIN_K), BLOWN_K)


def front(rows: Sequence[Any], order: str) -> list[Any]:
    """Rows that no other beats in both time and error as drawn, from the quickest on; blown-up ones are none."""
    found, best = [], BLOWN_K
    for row in sorted((r for r in rows if not r.given_up), key=lambda r: (getattr(r, order), drawn(r))):
        if drawn(row) < best:
            found.append(row)
            best = drawn(row)
    return found


def picture(rows: Sequence[Any], titles: dict[str, str], order: str, title: str) -> Figure:
    """Worst error against time, a panel for each problem."""
    columns = min(3, len(titles))
    lines = math.ceil(len(titles) / columns)
    figure = Figure(figsize=(4.9 * columns, 4.1 * lines + 1.2), dpi=110, layout="constrained")
    axes_of = figure.subplots(lines, columns, squeeze=False, sharey=True)
    times = [getattr(r, order) for r in rows if not r.given_up]
    for axes, (name, text) in zip(axes_of.flat, titles.items(), strict=False):
        own = [row for row in rows if row.problem == name and not row.given_up]
        axes.axhline(CAMERA_K, color="#666666", linewidth=0.8, linestyle=":", zorder=1)
        best = front(own, order)
        if best:
            xs, ys = [getattr(r, order) for r in best], [drawn(r) for r in best]
            axes.step(
                [xs[0], *xs, max(times) * 2],
                [BLOWN_K, *ys, ys[-1]],
                where="post",
                color="#bbbbbb",
                linewidth=4,
                zorder=1,
            )
        for (solver, kind), points in _groups(own).items():
            color, mark = STYLES[solver]
            hollow, ours = kind == "float64", points[0].ours
            look = {
                "color": color,
                "marker": mark,
                "markersize": 15 if mark == "*" else 8 if ours else 5.5,
                "markerfacecolor": "white" if hollow else color,
                "markeredgecolor": "black" if ours and not hollow else color,
                "markeredgewidth": 0.8 if ours and not hollow else 1.2,
                "zorder": 4 if ours else 3,
                "clip_on": False,
            }
            for blew_up in (True, False):
                chosen = [r for r in points if (r.worst_k < BLOWN_K) != blew_up]
                how = (
                    {"linestyle": "", "alpha": 0.35}
                    if blew_up
                    else {"linestyle": "--" if hollow else "-", "linewidth": 1.1}
                )
                (line,) = axes.plot([getattr(r, order) for r in chosen], [drawn(r) for r in chosen], **look | how)
                line.set_in_layout(False)  # marks reach over the edges of the axes
        lost = {row.solver: row.given_up for row in rows if row.problem == name and row.given_up}
        missing = [f"{s.split(' (')[0]}: {why}" for s, why in lost.items() if not any(r.solver == s for r in own)]
        if missing:
            axes.text(
                0.015, 0.02, "\n".join(missing), transform=axes.transAxes, fontsize=8, color="#555555", va="bottom"
            )
        axes.set_title(text, fontsize=11)
        axes.set(xscale="log", yscale="log", ylim=(MIN_K, BLOWN_K), xlim=(min(times) / 1.8, max(times) * 1.8))
        axes.yaxis.set_major_locator(LogLocator(numticks=14))
        axes.yaxis.set_minor_locator(LogLocator(numticks=1))
        axes.grid(alpha=0.25, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in list(axes_of.flat)[len(titles) :]:
        axes.remove()
    for axes in axes_of[:, 0]:
        axes.set_ylabel("worst error (K)")
    for axes in list(axes_of.flat)[max(0, len(titles) - columns) : len(titles)]:
        axes.set_xlabel("µs per Gaussian and frame, one thread")
    figure.suptitle(f"What accuracy costs. {title}", fontsize=13, fontweight="bold")
    shown = [s for s in STYLES if any(r.solver == s for r in rows) and s != "balance, time-stepped kernel"]
    handles = []
    for solver in shown:
        color, mark = STYLES[solver]
        label = "closed form / balance, compiled kernel (ours)" if solver == "closed form, fused kernel" else solver
        label += " (ours)" if solver == "closed form, torch" else " (ours in weather)" if solver == "rate table" else ""
        handles.append(Line2D([], [], color=color, marker=mark, markersize=13 if mark == "*" else 7, label=label))
    handles.append(Line2D([], [], color="#bbbbbb", linewidth=4, label="front"))
    handles.append(Line2D([], [], color="#666666", linewidth=0.8, linestyle=":", label="a camera's noise"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(5, 2 * columns), fontsize=9, frameon=False)
    return figure


def _groups(rows: Sequence[Any]) -> dict[tuple[str, str], list[Any]]:
    groups: dict[tuple[str, str], list[Any]] = {}
    for row in rows:
        groups.setdefault((row.solver, row.type), []).append(row)
    return groups


def markdown(rows: Sequence[Any], titles: dict[str, str]) -> list[str]:
    """Sections for each problem: ours point by point, and what each accuracy costs."""
    lines = []
    for name, title in titles.items():
        own = [row for row in rows if row.problem == name]
        done = [row for row in own if not row.given_up]
        lines += [f"## {title}", ""]
        lines += markdown_table(
            ["ours", "type", "µs", "maximum K", "RMS K", "once per record"],
            [
                [
                    _name(r),
                    r.type,
                    _time(r.us),
                    _error(r.worst_k),
                    _error(r.rms_k),
                    f"{r.setup_s:.2f} s" if r.setup_s > 0.02 else "",
                ]
                for r in done
                if r.ours
            ],
        )
        lines += ["", "Shortest time in µs (in order / alone) for a maximum error of at most"]
        head = ["solver", *(f"{level:g} K" for level in LEVELS_K), "smallest error", "stopped"]
        cells = []
        for solver in dict.fromkeys(r.solver for r in own):
            points, lost = (
                [r for r in done if r.solver == solver],
                [r for r in own if r.solver == solver and r.given_up],
            )
            least = min((r.worst_k for r in points), default=math.inf)
            cells.append(
                [
                    f"**{solver}**" if any(r.ours for r in points) else solver,
                    *(_least(points, level) for level in LEVELS_K),
                    _error(least) if points else NONE,
                    "; ".join(dict.fromkeys(f"{r.setting}: {r.given_up}" for r in lost)),
                ]
            )
        lines += ["", *markdown_table(head, cells), ""]
    return lines


def _verdict(rows: Sequence[Any], name: str, title: str) -> list[str]:
    """Sentences on the front of a problem, in both orders, and on the cheapest others that are as accurate as ours."""
    done, lines = [row for row in rows if row.problem == name and not row.given_up], [f"- **{title}.**"]
    for order, label in (("us", "In order"), ("us_alone", "Alone")):
        best = front(done, order)
        others = [f"{_point(r, order)}" for r in best if not r.ours]
        text = "ours and " if any(r.ours for r in best) else "other solvers only: "
        if not others:
            text = "ours only" if best else "no solver: all diverged"
        lines.append(f"  - {label}, the front consists of {text}{'; '.join(others)}.")
        for own in _chosen(done):
            rivals = [r for r in done if not r.ours and drawn(r) <= EQUAL * drawn(own)]
            rival = min(rivals, key=lambda r: getattr(r, order), default=None)
            text = "no other reaches twice this error within the limits"
            if rival is not None:
                ratio = getattr(rival, order) / getattr(own, order)
                text = f"{_point(rival, order)} takes {_ratio(ratio)} times as long"
            lines.append(f"    - {_point(own, order)}: {text}.")
    return lines


def _chosen(done: Sequence[Any]) -> list[Any]:
    """One point for each of our solvers that the product would take here: its first type, with the product's size of tables.

    The fused kernel, which it takes on a CPU, comes in both types: float64 is a choice of the user (dtype=float64).
    """
    groups = _groups([r for r in done if r.ours])
    first = {points[0].solver: points for points in reversed(groups.values())}
    if "closed form, fused kernel" in first:
        first.pop("closed form, torch", None)
        if double := groups.get(("closed form, fused kernel", "float64")):
            first["closed form, fused kernel, float64"] = double
    chosen = (next((r for r in points if r.setting == f"{RATES} rates"), points[-1]) for points in first.values())
    return sorted(chosen, key=lambda r: r.us)


def _point(row: Any, order: str) -> str:
    return f"{_name(row)}, {row.type} ({_time(getattr(row, order))} µs, {_error(row.worst_k)} K)"


def _ratio(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _name(row: Any) -> str:
    return f"{row.solver}, {row.setting}" if row.setting else row.solver


def _least(points: Sequence[Any], level: float) -> str:
    good = [r for r in points if r.worst_k <= level]
    if not good:
        return NONE
    return f"{_time(min(r.us for r in good))} / {_time(min(r.us_alone for r in good))}"


def _time(us: float) -> str:
    return f"{us:.3f}" if us < 0.1 else f"{us:.2g}" if us < 10 else f"{us:.0f}"


def _error(kelvin: float) -> str:
    return "diverged" if not kelvin < BLOWN_K else f"{kelvin:.0e}" if kelvin < 1e-3 else f"{kelvin:.2g}"
