"""The end of a run: metrics.json, report.md, hyperparameters beside the scores, and a table on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterable
from glob import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from matplotlib.figure import Figure
from pytorch_lightning.loggers import TensorBoardLogger
from rich.console import Console
from rich.table import Table

from heatsplat.callbacks.board import board
from heatsplat.callbacks.describe import describe_data, describe_effects, describe_run, hyperparameters
from heatsplat.callbacks.images import file_stem
from heatsplat.callbacks.report_text import IN_BOTH, cells, effects_table, markdown
from heatsplat.contracts import Frame, check_count, evenly_spread
from heatsplat.io.files import write_atomically
from heatsplat.io.page import PAGE_FILE, write_page
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, METRICS_FILE, RunResults
from heatsplat.io.tables import read_csv
from heatsplat.io.versions import collect_versions
from heatsplat.metrics.definitions import DEFINITIONS

REPORT_FILE = "report.md"
CURVES_FILE = "renders/curves.png"


class Report(pl.Callback):
    """Writes what a run found, once its test is over and all other callbacks have measured.

    * metrics.json: every number, or null with the reason (``heatsplat.io.results``).
    * report.md: the same for people, with pictures, readable without any tool.
    * report.html: that in one file, pictures and all (``io.page``).
    * TensorBoard's table of hyperparameters with the final scores and costs, so that runs can be compared; and, from the
      start, the table of effects where they were chosen.
    * The table on the screen.

    Args:
        pictures: test views in the report, each with its companions.
        show: print the table.
        html: write report.html.
    """

    def __init__(self, pictures: int = 4, show: bool = True, html: bool = True) -> None:
        check_count("callbacks.report.pictures", pictures, 0)
        self.pictures, self.show, self.html = pictures, show, html

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        writer = board(module)
        if writer is not None and module.config.get("verdicts"):
            table = effects_table(describe_effects(module))
            writer.add_text("effects", "\n".join(table), trainer.global_step)

    def on_test_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        folder, results = module.output_dir, module.results
        results.run = describe_run(trainer, module) | results.run
        results.data = describe_data(module.scene) | results.data
        results.effects = results.effects or describe_effects(module)
        results.versions = collect_versions()
        curves = draw_curves(folder)
        shown = pictures_of(folder / "renders" / "test", module.scene.test.frames, self.pictures)
        text = markdown(results, folder, shown, curves)
        write_atomically(folder / REPORT_FILE, text)
        if self.html:
            write_page(folder / PAGE_FILE, text)
        if trainer.loggers:
            scores = {f"final/{name}": value for name, value in (results.test | results.cost).items()}
            finite = {name: value for name, value in scores.items() if value is not None and math.isfinite(value)}
            log_results(trainer, hyperparameters(module.config), finite)
        results.write(folder / METRICS_FILE)  # last: it says that the run is over, and nothing of it is made again
        if self.show:
            show(results, folder, shown[0] if shown else None)


def log_results(trainer: pl.Trainer, settings: dict[str, Any], scores: dict[str, float]) -> None:
    """Hands the settings and final scores of a run to its loggers, of which TensorBoard keeps both in one table."""
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(settings, scores)
        else:
            logger.log_hyperparams(settings)
            logger.log_metrics(scores, trainer.global_step)


def pictures_of(folder: Path, frames: Iterable[Frame], count: int) -> list[Path]:
    """Pictures of at most ``count`` views, evenly spread over those of which there are some, each before its companions'."""
    stems = [stem for stem in map(file_stem, frames) if (folder / f"{stem}.png").exists()]
    found: list[Path] = []
    for i in evenly_spread(len(stems), count):
        found += [folder / f"{stems[i]}.png", *sorted(folder.glob(f"{escape(stems[i])}_*.png"))]
    return found


def draw_curves(folder: Path) -> Path | None:
    """Draws scores against seconds of training, and returns the picture's path, or None without a course to draw."""
    if not (folder / CURVE_FILE).exists():
        return None
    rows = [row for row in read_csv(folder / CURVE_FILE) if row["train_seconds"] is not None]
    labels = {name: f"{DEFINITIONS[name].heading}, validation" for name in ("psnr", "ssim", "mae_c")}
    scores = [name for name in (*labels, "loss") if any(row.get(name) is not None for row in rows)]
    if len(rows) < 2 or not scores:
        return None
    figure = Figure(figsize=(2.9 * len(scores), 2.6), dpi=110, layout="constrained")
    for i, name in enumerate(scores):
        axes = figure.add_subplot(1, len(scores), i + 1)
        points = [(row["train_seconds"], row[name]) for row in rows if row.get(name) is not None]
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, color=f"C{i}")
        axes.set(xlabel="seconds of training", ylabel=labels.get(name, "loss, training"))
        axes.grid(alpha=0.25)
    write_png(folder / CURVES_FILE, figure_picture(figure))
    return folder / CURVES_FILE


def show(results: RunResults, folder: Path, picture: Path | None, console: Console | None = None) -> None:
    """Prints scores beside cost and where the report and a picture lie."""
    content = results.as_json()
    console = console or Console(markup=False, emoji=False)  # names and paths as they are
    run = content["run"]
    table = Table(title=f"{run.get('method') or run.get('thermal_model')} on {run.get('scene')}", title_justify="left")
    for column, justify in (("score", "left"), ("", "right"), ("cost", "left"), (" ", "right")):
        table.add_column(column, justify=justify)
    for (_, *score), (_, *cost) in zip_longest(cells(content, "test"), cells(content, "cost"), fillvalue=("",) * 3):
        table.add_row(*score, *cost)
    console.print(table)
    if in_both := content["data"].get(IN_BOTH):
        console.print(f"scores:  {in_both}", soft_wrap=True)
    console.print(f"machine: {run.get('machine')}; threads: {run.get('threads')}", soft_wrap=True)
    page = folder / PAGE_FILE
    console.print(f"report:  {page if page.exists() else folder / REPORT_FILE}", soft_wrap=True)
    if picture is not None:
        console.print(f"picture: {picture}", soft_wrap=True)
