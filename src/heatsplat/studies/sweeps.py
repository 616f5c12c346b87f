"""What the jobs of a sweep found: one table with means, spreads and costs, and one picture of quality against seconds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, literal, series_look, write_png
from heatsplat.io.recorded import OVERRIDES
from heatsplat.io.tables import NONE, markdown_table, over_seeds, write_csv
from heatsplat.metrics.definitions import described, unit_of
from heatsplat.studies.child_runs import all_rows
from heatsplat.studies.finished import (
    COLUMNS,
    Runs,
    clocks,
    each_seed_once,
    ran_on,
    read_runs,
    row_names,
    settings_of,
    versions,
)

TABLE_FILE, CSV_FILE, PICTURE_FILE = "table.md", "table.csv", "table.png"
# Scores and costs in the table, where any job has them; between them stand the scores of own callbacks.
SCORES = ("psnr", "ssim", "lpips", "mae_c", "clean_psnr", "clean_mae_c", "rgb_psnr")
COSTS = ("train_seconds", "peak_memory_mb", "gaussians", "render_fps")
DRAWN = 30  # scenes at most in the picture: two hundred take minutes, and few programs show a picture as long
OWN_DIGITS = 4  # significant ones of the largest value of an own score

Printed = Mapping[str, Mapping[str, str]]  # name of a row -> score or cost -> what a paper prints for it


def write_sweep(
    folder: Path,
    order: Sequence[str] = (),
    paper: Printed | None = None,
    draw: Callable[[Sequence[Runs]], Figure | None] | None = None,
) -> list[Path]:
    """Writes table.md, table.csv and table.png into a sweep's folder, and returns their paths; none without jobs.

    Args:
        folder: the sweep's folder, in which every job has its own.
        order: names of rows in the order of the table; others follow as they come.
        paper: what a paper prints for a row: name of row -> score or cost -> text.
        draw: makes the picture of the rows, None without; quality against seconds if not given.
    """
    rows = collect(folder)
    if not rows:
        return []
    place = {name: i for i, name in enumerate(order)}
    rows.sort(key=lambda row: (row.scene, place.get(row.name, len(place))))
    write_atomically(folder / TABLE_FILE, markdown(rows, paper or {}))
    write_csv(folder / CSV_FILE, _records(rows, paper or {}))
    written = [folder / TABLE_FILE, folder / CSV_FILE]
    figure = (draw or picture)(rows)
    if figure is not None:
        write_png(folder / PICTURE_FILE, figure_picture(figure))
        written.append(folder / PICTURE_FILE)
    return written


def collect(folder: Path) -> list[Runs]:
    """The rows of a sweep's folder, in the order of its jobs. Jobs of one name and other settings are rows of their own."""
    table = read_runs(sorted((path.parents[1] for path in folder.glob(f"*/{OVERRIDES}")), key=_number))
    if table.empty:
        return []
    table[["name", "other"]] = row_names(table["overrides"], table["scene"])
    # A grid that got another seed numbers its jobs anew, and trains some of them again.
    table = each_seed_once(table, [*zip(table["scene"], table["name"], table["other"], strict=True)])
    groups = table.groupby(["scene", "name", "other"], sort=False)
    return [Runs(name, scene, own, other) for (scene, name, other), own in groups]


def _number(job: Path) -> tuple[int, str]:
    """Hydra's number of a job, which is part of its folder's name."""
    numbers = [int(part) for part in job.name.split("_") if part.isdigit()]
    return (numbers[-1] if numbers else 0, job.name)


def _columns(rows: Sequence[Runs]) -> list[str]:
    own = dict.fromkeys(
        name
        for row in rows
        for found in row.table["results"].dropna()
        for name in found.test
        if described(name) is None and name not in COLUMNS
    )
    return [name for name in (*SCORES, *own, *COSTS) if any(row.values(name) for row in rows)]


def _printed(paper: Printed) -> list[str]:
    return [name for name in (*SCORES, *COSTS) if any(name in texts for texts in paper.values())]


def _shown(name: str, rows: Sequence[Runs]) -> tuple[str, int]:
    """Heading of a column, and digits behind the point of its numbers."""
    if known := described(name):
        return known.heading, known.digits
    told = (found.definitions.get(name) for row in rows for found in row.table["results"].dropna())
    unit = next(filter(None, map(unit_of, told)), "")
    largest = max(abs(value) for row in rows for value in row.values(name))
    digits = OWN_DIGITS - 1 - math.floor(math.log10(largest)) if largest else 0
    return f"{name} ({unit})" if unit else name, max(digits, 0)


def markdown(rows: Sequence[Runs], paper: Printed) -> str:
    """The table for people: mean ± standard deviation over the seeds."""
    columns = _columns(rows)
    printed = _printed(paper)
    several = len({row.scene for row in rows}) > 1
    shown = {name: _shown(name, rows) for name in columns}
    head = [*(["scene"] if several else []), "row", "runs", *(heading for heading, _ in shown.values())]
    head += [f"paper: {described(name).heading}" for name in printed]
    cells = [
        [
            *([row.scene] if several else []),
            row.label,
            row.count,
            *(_cell(row, name, digits) for name, (_, digits) in shown.items()),
            *(paper.get(row.name, {}).get(name, NONE) for name in printed),
        ]
        for row in rows
    ]
    lines = markdown_table(head, cells)
    failed = [f"- {row.label} on {row.scene}: {reason}" for row in rows for reason in row.failed]
    if failed:
        lines += ["", f"Jobs without a result: {len(failed)}", "", *failed]
    scenes = ", ".join(sorted({row.scene for row in rows}))
    return "\n".join([f"# Sweep on {scenes}", "", _about(rows), "", *lines, ""])


def _about(rows: Sequence[Runs]) -> str:
    """What all runs of a table share: settings, machines and versions; and whether its rows can be compared."""
    jobs = [set(settings_of(overrides)) for row in rows for overrides in row.table["overrides"]]
    shared = sorted(set.intersection(*jobs))
    about = "Mean ± standard deviation over seeds." + (f" {all_rows(shared)}" if shared else "")
    if len(rows) > 1 and len({row.scene for row in rows}) == len(rows):
        about += (
            " No two rows are of one scene, so their scores are not to be compared: a scene for all is data.scene=NAME."
        )
    results = [one for row in rows for one in row.table["results"].dropna()]
    return " ".join(filter(None, [about, clocks(map(ran_on, results)), versions(results)]))


def _cell(row: Runs, name: str, digits: int) -> str:
    """Mean and spread over the seeds, and how many have the value where not all do."""
    values = row.values(name)
    few = f" ({len(values)} of {row.count})" if 0 < len(values) < row.count else ""
    return over_seeds(values, digits) + few


def _records(rows: Sequence[Runs], paper: Printed) -> list[dict[str, Any]]:
    """The table for programs: full precision, mean and standard deviation in columns of their own."""
    columns, printed = _columns(rows), _printed(paper)
    return [
        {"scene": row.scene, "row": row.label, "runs": row.count, "failed": len(row.failed)}
        | {name: row.mean(name) for name in columns}
        | {f"{name}_std": row.spread(name) for name in columns}
        | {f"paper_{name}": paper.get(row.name, {}).get(name) for name in printed}
        for row in rows
    ]


def picture(rows: Sequence[Runs]) -> Figure | None:
    """PSNR and MAE against seconds of training, a mark per row with its spread and a line of panels per scene, for scores of
    different scenes are not compared; None without such values."""
    shown = [name for name in ("psnr", "mae_c") if any(row.mean(name) is not None for row in rows)]
    if not shown or not any(row.mean("train_seconds") for row in rows):
        return None
    every, labels = list(dict.fromkeys(row.scene for row in rows)), list(dict.fromkeys(row.label for row in rows))
    scenes = every[:DRAWN]
    figure = Figure(figsize=(5.2 * len(shown), 4.2 * len(scenes)), dpi=110, layout="constrained")
    if len(scenes) < len(every):
        figure.suptitle(f"the first {len(scenes)} of {len(every)} scenes; the table has all")
    panels = figure.subplots(len(scenes), len(shown), squeeze=False)
    for line, scene in zip(panels, scenes, strict=True):
        for axes, name in zip(line, shown, strict=True):
            for row in (row for row in rows if row.scene == scene):
                x, y = row.mean("train_seconds"), row.mean(name)
                if x is not None and y is not None:
                    color, mark = series_look(labels.index(row.label))
                    axes.errorbar(
                        x, y, row.spread(name) or 0, row.spread("train_seconds") or 0, mark, color=color, capsize=2, markersize=6,
                        label=literal(row.label),
                    )  # fmt: skip
            axes.set(xlabel="seconds of training", ylabel=f"{described(name).heading}, test")
            axes.grid(alpha=0.25)
            if len(scenes) > 1:
                axes.set_title(literal(scene), fontsize=9)
        if line[0].get_legend_handles_labels()[0]:
            line[0].legend(fontsize=7)
    return figure
