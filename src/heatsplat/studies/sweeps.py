"""What the jobs of a sweep found: one table with means, spreads and costs, and one picture of quality against seconds."""

from __future__ import annotations

import csv
import io
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults, write_atomically
from heatsplat.studies.recorded import OVERRIDES, config_of, overrides_of

TABLE_FILE, CSV_FILE, PICTURE_FILE = "table.md", "table.csv", "table.png"
# Scores and costs in the table, where any job has them, with heading and digits.
SCORES = {
    "psnr": ("PSNR (dB)", 2),
    "ssim": ("SSIM", 4),
    "lpips": ("LPIPS", 4),
    "mae_c": ("MAE (°C)", 3),
    "clean_psnr": ("clean PSNR (dB)", 2),
    "clean_mae_c": ("clean MAE (°C)", 3),
    "rgb_psnr": ("RGB PSNR (dB)", 2),
}
COSTS = {
    "train_seconds": ("train (s)", 1),
    "peak_memory_mb": ("memory (MB)", 0),
    "gaussians": ("Gaussians", 0),
    "render_fps": ("frames/s", 0),
}
# Overrides that make no other recipe. cli.NOT_LEARNED, and the keys that conf/train.yaml leaves out of the names of folders,
# are among them; the method is named by itself.
SEEDS = {"seed", "data.seed", "data.scene_seed"}
PLACES = {"data", "data.root", "data.scene", "data.scenes"}
NAMES = {"method", "row", "ablation", "experiment"}
HOW_IT_RUNS = {"threads", "ckpt", "test"}
NOT_A_ROW = SEEDS | PLACES | NAMES | HOW_IT_RUNS
NOT_WHAT_WAS_LEARNED = {"trainer", "launcher", "callbacks", "logger", "hydra", "table"}  # these groups with all below

Printed = Mapping[str, Mapping[str, str]]  # name of a row -> score or cost -> what a paper prints for it


@dataclass
class Row:
    """The jobs of one row on one scene.

    Args:
        name: of the row.
        scene: on which they ran.
        values: score or cost -> its values, one per job that has it.
        jobs: how many have results.
        failed: first lines of why the others have none.
        other: overrides that not all jobs of a row of this name have, such as "max_steps=3000"; empty where all agree.
    """

    name: str
    scene: str
    values: dict[str, list[float]] = field(default_factory=dict)
    jobs: int = 0
    failed: list[str] = field(default_factory=list)
    other: str = ""

    @property
    def label(self) -> str:
        """The name, with what tells the row from others of its name."""
        return f"{self.name}, {self.other}" if self.other else self.name

    def mean(self, name: str) -> float | None:
        """Mean over the jobs, None where none has the value."""
        return statistics.fmean(self.values[name]) if self.values.get(name) else None

    def spread(self, name: str) -> float | None:
        """Standard deviation over the jobs (n - 1), None for fewer than two."""
        return statistics.stdev(self.values[name]) if len(self.values.get(name, ())) > 1 else None


def write_sweep(folder: Path, order: Sequence[str] = (), paper: Printed | None = None) -> list[Path]:
    """Writes table.md, table.csv and table.png into a sweep's folder, and returns their paths; none without jobs.

    Args:
        folder: the sweep's folder, in which every job has its own.
        order: names of rows in the order of the table; others follow as they come.
        paper: what a paper prints for a row: name of row -> score or cost -> text.
    """
    rows = collect(folder)
    if not rows:
        return []
    place = {name: i for i, name in enumerate(order)}
    rows.sort(key=lambda row: (row.scene, place.get(row.name, len(place))))
    write_atomically(folder / TABLE_FILE, markdown(rows, paper or {}))
    write_atomically(folder / CSV_FILE, table_csv(rows, paper or {}))
    written = [folder / TABLE_FILE, folder / CSV_FILE]
    figure = picture(rows)
    if figure is not None:
        write_png(folder / PICTURE_FILE, figure_picture(figure))
        written.append(folder / PICTURE_FILE)
    return written


def collect(folder: Path) -> list[Row]:
    """The rows of a sweep's folder, in the order of its jobs. Jobs of one name and other settings are rows of their own."""
    rows: dict[tuple[str, str, str], Row] = {}
    jobs = sorted((path.parents[1] for path in folder.glob(f"*/{OVERRIDES}")), key=_number)
    names = row_names([overrides_of(job) for job in jobs])
    for job, (name, other) in zip(jobs, names, strict=True):
        results, reason = _results(job)
        scene = str(results.run["scene"]) if results and "scene" in results.run else _scene(config_of(job))
        row = rows.setdefault((scene, name, other), Row(name, scene, other=other))
        if results is None:
            row.failed.append(reason)
            continue
        row.jobs += 1
        for key, value in (results.test | results.cost).items():
            if value is not None:
                row.values.setdefault(key, []).append(value)
    return list(rows.values())


def row_names(jobs: Sequence[Mapping[str, str]]) -> list[tuple[str, str]]:
    """For each job the name of its row, and the settings that not all jobs of a row of this name have ("" for none).

    A job without a named row has its settings for a name (``row_name``).

    Args:
        jobs: overrides of each: key -> value.
    """
    names = [named_row(overrides) for overrides in jobs]
    settings = [[*_method(overrides), *settings_of(overrides)] for overrides in jobs]
    others = [" ".join(words) for words in unshared(names, settings)]
    return [
        (name, other) if name else (row_name(overrides), "")
        for overrides, name, other in zip(jobs, names, others, strict=True)
    ]


def unshared(names: Sequence[str], settings: Sequence[Sequence[str]]) -> list[list[str]]:
    """For each job those of its settings that not all jobs of its name have."""
    shared: dict[str, set[str]] = {}
    for name, own in zip(names, settings, strict=True):
        shared[name] = shared.get(name, set(own)) & set(own)
    return [[text for text in own if text not in shared[name]] for name, own in zip(names, settings, strict=True)]


def named_row(overrides: Mapping[str, str]) -> str:
    """Name of the row that a job was given (``row=``), empty for none."""
    name = overrides.get("row", "").strip("'\"")
    return "" if name == "null" else name


def row_name(overrides: Mapping[str, str]) -> str:
    """Name of a job without a named row: its overrides, method first, without those that tell seeds and places apart."""
    return " ".join([*_method(overrides), *settings_of(overrides)]) or "run"


def _method(overrides: Mapping[str, str]) -> list[str]:
    return [overrides["method"]] if "method" in overrides else []


def settings_of(overrides: Mapping[str, str]) -> list[str]:
    """Overrides that make a recipe besides its method: "key=value" in alphabetical order."""

    def makes_a_recipe(key: str) -> bool:
        key = key.lstrip("+~")
        return key not in NOT_A_ROW and key.partition(".")[0] not in NOT_WHAT_WAS_LEARNED

    return sorted(f"{key}={value}" for key, value in overrides.items() if makes_a_recipe(key))


def _results(job: Path) -> tuple[RunResults | None, str]:
    """The results of a job, or None and why there are none."""
    if not (job / METRICS_FILE).exists():
        return None, reason_of(job)
    try:
        return RunResults.read(job / METRICS_FILE), ""
    except (ValueError, OSError) as error:
        return None, f"{error}. Delete the folder to run it again."


def _scene(config: Mapping[str, Any]) -> str:
    """The scene that a job was told; a method's own synthetic preset is a reference to another key."""
    data = config.get("data") or {}
    scene = str(data.get("scene") or "+".join(data.get("scenes") or ()) or "?")
    return str(config.get(scene[2:-1], scene)) if scene.startswith("${") else scene


def _number(job: Path) -> tuple[int, str]:
    """Hydra's number of a job, which is part of its folder's name."""
    numbers = [int(part) for part in job.name.split("_") if part.isdigit()]
    return (numbers[-1] if numbers else 0, job.name)


def reason_of(job: Path) -> str:
    """Why a job has no result: the last line of its FAILED file that names an error, since Hydra adds lines of its own."""
    if not (job / FAILED).exists():
        return "not finished"
    lines = [line.strip() for line in (job / FAILED).read_text(encoding="utf-8").splitlines() if line.strip()]
    named = [line for line in lines if re.match(r"[\w.]*(Error|Exception)\b", line)]
    return (named or lines or ["failed"])[-1]


def _columns(rows: Iterable[Row]) -> dict[str, tuple[str, int]]:
    return {name: shown for name, shown in (SCORES | COSTS).items() if any(name in row.values for row in rows)}


def _printed(paper: Printed) -> dict[str, tuple[str, int]]:
    return {name: shown for name, shown in (SCORES | COSTS).items() if any(name in texts for texts in paper.values())}


def markdown(rows: Sequence[Row], paper: Printed) -> str:
    """The table for people: mean ± standard deviation over the seeds."""
    columns = _columns(rows)
    printed = _printed(paper)
    several = len({row.scene for row in rows}) > 1
    head = [*(["scene"] if several else []), "row", "runs", *(title for title, _ in columns.values())]
    head += [f"paper: {title}" for title, _ in printed.values()]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        cells = [*([row.scene] if several else []), row.label, str(row.jobs)]
        for name, (_, digits) in columns.items():
            mean, spread = row.mean(name), row.spread(name)
            text = "–" if mean is None else f"{mean:,.{digits}f}"
            cells.append(text if spread is None else f"{text} ± {spread:,.{digits}f}")
        cells += [paper.get(row.name, {}).get(name, "–") for name in printed]
        lines.append("| " + " | ".join(cells) + " |")
    failed = [f"- {row.label} on {row.scene}: {reason}" for row in rows for reason in row.failed]
    if failed:
        lines += ["", f"Jobs without a result: {len(failed)}", "", *failed]
    scenes = ", ".join(sorted({row.scene for row in rows}))
    return "\n".join([f"# Sweep on {scenes}", "", "Mean ± standard deviation over seeds.", "", *lines, ""])


def table_csv(rows: Sequence[Row], paper: Printed) -> str:
    """The table for programs: full precision, mean and standard deviation in columns of their own."""
    columns = _columns(rows)
    spread, printed = [f"{name}_std" for name in columns], _printed(paper)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(
        text,
        ["scene", "row", "runs", "failed", *columns, *spread, *map("paper_{}".format, printed)],
        lineterminator="\n",
    )
    writer.writeheader()
    for row in rows:
        numbers = {name: row.mean(name) for name in columns} | {f"{name}_std": row.spread(name) for name in columns}
        counts = {"scene": row.scene, "row": row.label, "runs": row.jobs, "failed": len(row.failed)}
        texts = {f"paper_{name}": paper.get(row.name, {}).get(name) for name in printed}
        writer.writerow(counts | numbers | texts)
    return text.getvalue()


def picture(rows: Sequence[Row]) -> Figure | None:
    """PSNR and MAE against seconds of training, a mark per row with its spread; None without such values."""
    shown = [name for name in ("psnr", "mae_c") if any(row.mean(name) is not None for row in rows)]
    if not shown or not any(row.mean("train_seconds") for row in rows):
        return None
    several = len({row.scene for row in rows}) > 1
    figure = Figure(figsize=(5.2 * len(shown), 4.2), dpi=110, layout="constrained")
    for i, name in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), i + 1)
        for j, row in enumerate(rows):
            x, y = row.mean("train_seconds"), row.mean(name)
            if x is not None and y is not None:
                label = f"{row.label}, {row.scene}" if several else row.label
                axes.errorbar(
                    x, y, row.spread(name) or 0, row.spread("train_seconds") or 0, "os^Dv"[j // 10 % 5], color=f"C{j % 10}",
                    capsize=2, markersize=6, label=label,
                )  # fmt: skip
        axes.set(xlabel="seconds of training", ylabel=f"{SCORES[name][0]}, test")
        axes.grid(alpha=0.25)
        if i == 0:
            axes.legend(fontsize=7)
    return figure
