"""Speed over time: a line of ratios for each commit and machine, and a picture of them all.

Milliseconds of different machines and busy hours say little beside each other; ratios of what ran in turns do. A line is
written by ``study=renderer study.history=FILE`` (``make bench``) in place of an earlier one of its commit and machine.
"""

from __future__ import annotations

import json
import logging
import math
import os
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.tables import markdown_table
from heatsplat.io.versions import processor

log = logging.getLogger("heatsplat")

Row = dict[str, Any]
ROOT = Path(__file__).resolve().parents[1]

HIGHER, LOWER = "higher is faster", "lower is faster"


def ratios(tables: Mapping[str, Sequence[Row]]) -> dict[str, tuple[float, str]]:
    """What the tables of ``benchmarks.renderer`` say without milliseconds: name -> ratio, and which way is faster.

    Ratios of one kind are one: their geometric mean.
    """
    found: dict[str, tuple[float, str]] = {}

    def put(name: str, values: Sequence[float], way: str) -> None:
        if values:
            found[name] = (math.exp(statistics.fmean(map(math.log, values))), way)

    for part in ("forward", "backward"):
        put(f"{part}: its floor / its time", [row[f"share_{part}"] for row in tables.get("renderer", ())], HIGHER)
    for row in tables.get("peers", ()):
        for key in (key for key in row if key.startswith("ratio, ")):
            put(f"{row['peer']} / ours, {row['case']}, {key.removeprefix('ratio, ')}", [row[key]], HIGHER)
    for name in ("full window", "separable"):
        put(f"loss: {name} / fused", [row[f"{name}, ratio"] for row in tables.get("loss", ())], HIGHER)
    put("several opacities / one", [row["ratio"] for row in tables.get("modalities", ())], LOWER)
    for row in tables.get("training", ()):
        if row["ratio"] != 1.0:
            put(
                f"step: {row['method']} / the first method, {row['case']}, {row['threads']} thr.", [row["ratio"]], LOWER
            )
    return found


def commit() -> tuple[str, str, bool]:
    """The commit of this checkout, when it was made (ISO 8601), and whether files differ from it; empty without git."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else ""

    return (
        git("rev-parse", "HEAD")[:12],
        git("show", "-s", "--format=%cI", "HEAD"),
        bool(git("status", "--porcelain", "-uno")),
    )


def add_line(path: Path, tables: Mapping[str, Sequence[Row]]) -> Row:
    """Writes the line of this commit and machine into a file of JSON lines, in place of an earlier one, and returns it."""
    number, made, changed = commit()
    line = {
        "commit": number,
        "made": made,
        "changed": changed,
        "machine": processor(),
        "load": os.getloadavg()[0],
        "ratios": {name: [round(ratio, 4), way] for name, (ratio, way) in ratios(tables).items()},
    }
    kept = [one for one in read_lines(path) if (one["commit"], one["machine"]) != (number, line["machine"])]
    write_atomically(path, "".join(json.dumps(one, ensure_ascii=False) + "\n" for one in [*kept, line]))
    return line


def read_lines(path: Path) -> list[Row]:
    """The lines of a file, oldest commit first; none where there is no file. Raises SceneError for a line that is none."""
    if not path.exists():
        return []
    lines = []
    for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            line = json.loads(text)
            lines.append({key: line[key] for key in ("commit", "made", "changed", "machine", "load", "ratios")})
        except (ValueError, KeyError, TypeError) as error:
            raise SceneError(f"{path}, line {number} is no line of make bench ({error}); take it out") from error
    return sorted(lines, key=lambda line: line["made"])


def run(output_dir: Path | str, file: str) -> list[Row]:
    """Draws the lines of a file; writes history.png and history.md, and returns the lines.

    Args:
        output_dir: folder of the results.
        file: of ``add_line``.

    Raises:
        SceneError: it has no line.
    """
    output_dir, path = Path(output_dir), Path(file)
    lines = read_lines(path)
    if not lines:
        raise SceneError(f"{path} has no lines yet: make bench writes one for each commit and machine")
    names = list(dict.fromkeys(name for line in lines for name in line["ratios"]))
    write_png(output_dir / "history.png", figure_picture(picture(lines, names)))
    head = ["commit", "made", "machine", "load", *names]
    rows = [
        [line["commit"] + "+" * line["changed"], line["made"][:10], line["machine"], f"{line['load']:.1f}"]
        + [f"{line['ratios'][name][0]:.3g}" if name in line["ratios"] else "" for name in names]
        for line in lines
    ]
    text = "\n".join(
        ["# Speed over time", "", "+: with changes that are in no commit.", "", *markdown_table(head, rows), ""]
    )
    write_atomically(output_dir / "history.md", text)
    log.info("%s", text)
    return lines


def picture(lines: Sequence[Row], names: Sequence[str]) -> Figure:
    """A panel for each ratio over the commits, a line for each machine."""
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure = Figure(figsize=(5.0 * columns, 2.6 * rows), layout="constrained")
    commits = list(dict.fromkeys(line["commit"] for line in lines))
    machines = list(dict.fromkeys(line["machine"] for line in lines))
    for axis, name in zip(figure.subplots(rows, columns, squeeze=False).flat, names, strict=False):
        for k, one in enumerate(machines):
            own = [line for line in lines if line["machine"] == one and name in line["ratios"]]
            places = [commits.index(line["commit"]) for line in own]
            axis.plot(places, [line["ratios"][name][0] for line in own], "o-", color=f"C{k}", label=one)
        way = next(line["ratios"][name][1] for line in lines if name in line["ratios"])
        axis.set_title(f"{name}\n{way}", fontsize=9)
        axis.set_xticks(range(len(commits)), [text[:7] for text in commits], rotation=60, fontsize=7)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    for axis in figure.axes[len(names) :]:
        axis.remove()
    figure.axes[0].legend(fontsize=7)
    return figure
