"""The renderer study's results as CSV, Markdown and a picture."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import matplotlib.figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from benchmarks.renderer.floors import Machine
from heatsplat.io.tables import markdown_table, write_csv

log = logging.getLogger("heatsplat")

Row = dict[str, Any]


def write(tables: dict[str, list[Row]], output_dir: Path, machines: dict[int, Machine]) -> None:
    """``renderer.md`` with all tables, a CSV file of each, and ``renderer.png``."""
    for name, rows in tables.items():
        if rows:
            write_csv(output_dir / f"{name}.csv", rows)
    text = _markdown(tables, machines)
    (output_dir / "renderer.md").write_text(text, encoding="utf-8")
    log.info("%s", text)
    _picture(tables["renderer"], output_dir / "renderer.png")


def _markdown(tables: dict[str, list[Row]], machines: dict[int, Machine]) -> str:
    rates = "; ".join(
        f"{count} thread(s): {machine.vectors / 1e9:.1f} G multiply-adds on 16 lanes and {machine.bytes / 1e9:.0f} GB "
        "a second"
        for count, machine in machines.items()
    )
    lines = ["# The CPU renderer", "", f"Minima in ms, with gradients; floors by {rates}.", ""]
    lines += markdown_table(
        ("case", "threads", "forward", "floor", "reached", "backward", "floor", "reached", "load"),
        (
            (
                row["case"], row["threads"], _ms(row["forward_ms"]), _ms(row["floor_forward_ms"]),
                f"{row['share_forward']:.0%}", _ms(row["backward_ms"]), _ms(row["floor_backward_ms"]),
                f"{row['share_backward']:.0%}", f"{row['load']:.1f}",
            )
            for row in tables["renderer"]
        ),
    )  # fmt: skip
    lines.append("")
    for name, title in (
        ("modalities", "Several opacities in one pass"),
        ("peers", "Peers, three channels"),
        ("loss", "The loss"),
        ("memory", "Memory above the parameters, in 10^6 bytes"),
    ):
        rows = tables.get(name)
        if rows:
            columns = list(dict.fromkeys(key for row in rows for key in row))
            cells = [[_any(row.get(key)) for key in columns] for row in rows]
            lines += [f"## {title}", "", *markdown_table(columns, cells), ""]
    if tables.get("training"):
        lines += ["## A training step, part by part", "", *training_table(tables["training"]), ""]
    return "\n".join(lines)


def training_table(rows: list[Row]) -> list[str]:
    """Parts down, runs across; floors in brackets."""
    parts = [key.removesuffix("_ms") for key in rows[0] if key.endswith("_ms") and not key.startswith("floor_")]
    heads = (f"{row['case']}, {row['method']}, {row['threads']} thr." for row in rows)
    each = ("" if row["views"] == 1 else f", {row['views']} views an update" for row in rows)
    columns = ["part", *map("".join, zip(heads, each, strict=True))]
    body = []
    for part in parts:
        floors = [row[f"floor_{part}_ms"] for row in rows]
        cells = [
            _ms(row[f"{part}_ms"]) + ("" if floor is None else f" ({_ms(floor)})")
            for row, floor in zip(rows, floors, strict=True)
        ]
        body.append([part, *cells])
    body.append(["ratio", *(f"{row['ratio']:.2f}" for row in rows)])
    body.append(["processor, all threads", *(_ms(row["processor"]) for row in rows)])
    body.append(["ratio of those", *(f"{row['processor_ratio']:.2f}" for row in rows)])
    body.append(["load", *(f"{row['load']:.1f}" for row in rows)])
    return markdown_table(columns, body)


def _ms(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _any(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
    return "" if value is None else str(value)


def _picture(rows: list[Row], path: Path) -> None:
    """Forward + backward time against N, pixels and channels; dashed is the floor."""
    rows = [row for row in rows if row["points"] == "synthetic"]
    most = max(row["threads"] for row in rows)
    figure = matplotlib.figure.Figure(figsize=(13, 4.4), layout="constrained")
    panels = (
        ("gaussians", "pixels", "Gaussians", "{:,} pixels"),
        ("pixels", "gaussians", "pixels", "{:,} Gaussians"),
        ("channels", "threads", "channels", "{} thread(s)"),
    )
    for axis, (along, over, label, legend) in zip(figure.subplots(1, 3), panels, strict=True):
        for k, value in enumerate(sorted({row[over] for row in rows})):
            line = [row for row in rows if row[over] == value and _belongs(row, along, rows, most)]
            line.sort(key=lambda row: row[along])
            x = [row[along] for row in line]
            if len(set(x)) > 1:
                axis.plot(x, [_total(row) for row in line], "o-", color=f"C{k}", label=legend.format(value))
                axis.plot(x, [_total(row, "floor_") for row in line], "--", color=f"C{k}", lw=1)
        if along != "channels":
            axis.set(xscale="log", yscale="log")
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}"))
            axis.yaxis.set_minor_locator(NullLocator())
        else:
            axis.set_ylim(bottom=0)
        ticks = sorted({row[along] for row in rows})
        axis.set_xticks(ticks, [f"{tick / 1000:.3g} k" if tick >= 1000 else str(tick) for tick in ticks], minor=False)
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set(xlabel=label, ylabel="forward + backward, ms (dashed: floor)", title=f"time over {label}")
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def _belongs(row: Row, along: str, rows: list[Row], most: int) -> bool:
    """Whether a row is on a line along N or pixels (one channel, all threads), or along channels (the middle case)."""
    if along != "channels":
        return row["channels"] == 1 and row["threads"] == most
    varied = next((other for other in rows if other["channels"] != 1), row)
    return (row["gaussians"], row["pixels"]) == (varied["gaussians"], varied["pixels"])


def _total(row: Row, prefix: str = "") -> float:
    return row[f"{prefix}forward_ms"] + row[f"{prefix}backward_ms"]
