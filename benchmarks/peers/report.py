"""From the points (seconds, PSNR) of both programs to the time that each takes to one PSNR, and the tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from heatsplat.io.files import write_atomically
from heatsplat.io.tables import NONE, markdown_table, number, write_csv

TABLE_FILE = "peers.md"
SECONDS = {"training_s": "training", "process_s": "whole process"}
Row = dict[str, Any]


def seconds_to(points: Iterable[tuple[float, float]], wanted: float) -> tuple[float | None, bool]:
    """Seconds after which a program reaches a PSNR, and whether it may be less because its shortest run already does.

    Between two runs the logarithm of the seconds is taken to be linear in PSNR; a longer run that is worse than a shorter
    one is left out.

    Args:
        points: (seconds, PSNR in dB) of whole runs.
        wanted: PSNR in dB.

    Returns:
        (None, False) where no run reaches it.
    """
    better: list[tuple[float, float]] = []
    for seconds, found in sorted(points):
        if not better or found > better[-1][1]:
            better.append((seconds, found))
    if not better or better[-1][1] < wanted:
        return None, False
    if better[0][1] >= wanted:
        return better[0][0], better[0][1] > wanted
    above = next(i for i, (_, found) in enumerate(better) if found >= wanted)
    (early, low), (late, high) = better[above - 1 : above + 1]
    share = (wanted - low) / (high - low)
    return math.exp((1 - share) * math.log(early) + share * math.log(late)), False


def equal_psnr(runs: Sequence[Row]) -> list[Row]:
    """For each run of the peer: how long each recipe of ours takes to the same PSNR, and the ratio.

    Args:
        runs: with scene, threads, program, peer (whether it is theirs), steps, training_s, process_s and psnr.
    """
    rows = []
    for theirs in (run for run in runs if run["peer"]):
        beside = [
            run for run in runs if not run["peer"] and all(run[key] == theirs[key] for key in ("scene", "threads"))
        ]
        for recipe in dict.fromkeys(run["program"] for run in beside):
            row = {key: theirs[key] for key in ("scene", "threads", "program", "steps", "psnr")} | {"ours": recipe}
            for clock in SECONDS:
                points = [(run[clock], run["psnr"]) for run in beside if run["program"] == recipe]
                seconds, at_most = seconds_to(points, theirs["psnr"])
                ratio = None if seconds is None else theirs[clock] / seconds
                row |= {
                    f"peer_{clock}": theirs[clock],
                    clock: seconds,
                    f"ratio_{clock}": ratio,
                    f"least_{clock}": at_most,
                }
            rows.append(row)
    return rows


def write(tables: Mapping[str, Sequence[Row]], folder: Path, conditions: str) -> None:
    """peers.md and a CSV file of each table that has rows."""
    for name, rows in tables.items():
        if rows:
            write_csv(folder / f"{name}.csv", rows)
    lines = [conditions, ""]
    for name, lay_out in (("rasterisers", _rasterisers), ("agreement", _agreement), ("equal", _equal), ("runs", _runs)):
        if tables.get(name):
            lines += [*lay_out(tables[name]), ""]
    write_atomically(folder / TABLE_FILE, "\n".join(lines))


def _rasterisers(rows: Sequence[Row]) -> list[str]:
    head = ("scene", "Gaussians", "image", "threads", "peer", "peer ms", "ours ms", "ratio", "ours ms, C = 1", "load")
    cells = [
        (
            row["scene"], f"{row['Gaussians']:,}", row["image"], row["threads"], row["peer"], number(row["peer_ms"], 1),
            number(row["ms"], 1), f"{row['ratio']:.1f}x", number(row["ms_one_channel"], 1), number(row["load"], 1),
        )
        for row in rows
    ]  # fmt: skip
    return ["Rasterisers, forward + backward, C = 3, as many threads each:", "", *markdown_table(head, cells)]


def _agreement(rows: Sequence[Row]) -> list[str]:
    names = [key for key in rows[0] if key != "renderer"]
    cells = [(row["renderer"], *(f"{row[name]:.1e}" for name in names)) for row in rows]
    return [
        "Differences from float64 brute force: of images the largest, of gradients relative L2:",
        "",
        *markdown_table(("renderer", *names), cells),
    ]


def _equal(rows: Sequence[Row]) -> list[str]:
    head = ["scene", "threads", "peer", "steps", "PSNR dB", "ours"]
    for what in SECONDS.values():
        head += [f"peer s, {what}", "ours s", "ratio"]
    cells = []
    for row in rows:
        cell = [row[key] for key in ("scene", "threads", "program", "steps")] + [number(row["psnr"], 2), row["ours"]]
        for clock in SECONDS:
            sign = ("≤ ", "≥ ") if row[f"least_{clock}"] else ("", "")
            ratio = row[f"ratio_{clock}"]
            cell += [number(row[f"peer_{clock}"], 1), sign[0] + number(row[clock], 1)]
            cell += [NONE if ratio is None else f"{sign[1]}{ratio:.1f}x"]
        cells.append(cell)
    return ["Seconds to the PSNR on held-out views that a run of the peer reached:", "", *markdown_table(head, cells)]


def _runs(rows: Sequence[Row]) -> list[str]:
    head = ("scene", "threads", "program", "steps", "Gaussians", "PSNR dB", "training s", "process s", "load")
    cells = [
        (
            row["scene"], row["threads"], row["program"], row["steps"], f"{row['gaussians']:,}", number(row["psnr"], 2),
            number(row["training_s"], 1), number(row["process_s"], 1), number(row["load"], 1),
        )
        for row in rows
    ]  # fmt: skip
    return ["Every run:", "", *markdown_table(head, cells)]
