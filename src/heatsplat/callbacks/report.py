"""The end of a run: metrics.json, report.md, hyperparameters beside the scores, and a table on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from glob import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytorch_lightning as pl
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from heatsplat.callbacks.attributes import LEARNED_FILE
from heatsplat.callbacks.board import board
from heatsplat.callbacks.courses import COURSES_PICTURE
from heatsplat.callbacks.images import file_stem
from heatsplat.callbacks.metrics import TEST_FILE
from heatsplat.callbacks.page import PAGE_FILE, plain, write_page
from heatsplat.callbacks.surfaces import SURFACES_FILE, SURFACES_PICTURE
from heatsplat.callbacks.turntable import TURNTABLE_FILE
from heatsplat.contracts import Frame, SceneData, evenly_spread
from heatsplat.io.citations import citations
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.results import CURVE_FILE, METRICS_FILE, RunResults
from heatsplat.io.settings import walk
from heatsplat.io.tables import NONE, markdown_table, read_csv
from heatsplat.io.versions import collect_versions, processor
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.viewer.page import FILE as VIEWER_FILE

REPORT_FILE = "report.md"
CURVES_FILE = "renders/curves.png"

COST_UNITS = {
    "choosing_seconds": "s",
    "train_seconds": "s",
    "cpu_seconds": "s",
    "steps_per_second": "1/s",
    "render_fps": "1/s",
    "peak_memory_mb": "MB",
    "gaussians": "",
    "warmup_seconds": "s",
    "evaluation_seconds": "s",
    "wall_seconds": "s",
}
# Parts of the configuration that say what was learned and how; the others say where and when, or repeat these.
HYPERPARAMETERS = (
    "name", "seed", "max_steps", "dtype", "data", "thermal", "sensor", "composite", "renderer", "smoothing", "density",
    "merge", "loss", "init", "optim", "stages", "effects",
)  # fmt: skip


class Report(pl.Callback):
    """Writes what a run found, once its test is over and all other callbacks have measured.

    * metrics.json: every number, or null with the reason (``heatsplat.io.results``).
    * report.md: the same for people, with pictures, readable without any tool.
    * report.html: that in one file, pictures and all (``callbacks.page``).
    * TensorBoard's table of hyperparameters with the final scores and costs, so that runs can be compared; and, from the
      start, the table of effects where they were chosen.
    * The table on the screen.

    Args:
        pictures: test views in the report, each with its companions.
        show: print the table.
        html: write report.html.
    """

    def __init__(self, pictures: int = 4, show: bool = True, html: bool = True) -> None:
        self.pictures, self.show, self.html = pictures, show, html

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        writer = board(module)
        if writer is not None and module.config.get("verdicts"):
            table = effects_table(describe_effects(module))
            writer.add_text("effects", "\n".join(table), trainer.global_step)

    def on_test_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        folder, results = module.output_dir, module.results
        results.run = describe_run(trainer, module) | results.run
        results.data = describe_data(module.scene, module.modality) | results.data
        results.effects = results.effects or describe_effects(module)
        results.versions = collect_versions()
        curves = draw_curves(folder)
        shown = pictures_of(folder / "renders" / "test", module.scene.test.frames, self.pictures)
        text = report(results, folder, shown, curves)
        write_atomically(folder / REPORT_FILE, text)
        if self.html:
            write_page(folder / PAGE_FILE, text)
        if trainer.logger is not None:
            scores = {f"final/{name}": value for name, value in (results.test | results.cost).items()}
            finite = {name: value for name, value in scores.items() if value is not None and math.isfinite(value)}
            trainer.logger.log_hyperparams(hyperparameters(module.config), finite)
        results.write(folder / METRICS_FILE)  # last: it says that the run is over, and nothing of it is made again
        if self.show:
            show(results, folder, shown[0] if shown else None)


def pictures_of(folder: Path, frames: Iterable[Frame], count: int) -> list[Path]:
    """Pictures of at most ``count`` views, evenly spread over those of which there are some, each before its companions'."""
    stems = [stem for stem in map(file_stem, frames) if (folder / f"{stem}.png").exists()]
    found: list[Path] = []
    for i in evenly_spread(len(stems), count):
        found += [folder / f"{stems[i]}.png", *sorted(folder.glob(f"{escape(stems[i])}_*.png"))]
    return found


# What is written -----------------------------------------------------------------------------------------------------


def describe_run(trainer: pl.Trainer, module: pl.LightningModule) -> dict[str, Any]:
    """What was run, for metrics.json."""
    return {
        "method": module.config.get("name"),
        "scene": module.scene.name,
        "modality": module.modality,
        "seed": module.config.get("seed"),
        "steps": trainer.global_step or None,
        "thermal_model": type(module.thermal).__name__,
        "multiply_adds_per_gaussian": module.thermal.cost,
        "parameters": sum(parameter.numel() for parameter in module.parameters()),
        "device": str(module.device),
        "machine": _machine(module.device),
        "threads": torch.get_num_threads(),
    }


def _machine(device: torch.device) -> str:
    """What the seconds of a run are seconds of."""
    return f"{torch.cuda.get_device_name(device)}; {processor()}" if device.type == "cuda" else processor()


def describe_data(scene: SceneData, modality: str) -> dict[str, Any]:
    """What the data are, for metrics.json: counts, sizes and ranges, then what the loader found and assumed."""
    frames = [frame for views in (scene.train, scene.val, scene.test) for frame in views.frames]
    sizes = sorted({f"{frame.camera.width}x{frame.camera.height}" for frame in frames})
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    bounds = scene.thermal_range
    return {
        "views": {"train": len(scene.train), "val": len(scene.val), "test": len(scene.test)},
        "image_sizes": sizes[:10],
        "seconds": max(times) - min(times) if times else None,
        "points": len(scene.points),
        "thermal_range_c": None if bounds is None else [bounds.min_c, bounds.max_c],
        "ambient_c": scene.ambient_c,
        "metres_per_unit": scene.metres_per_unit,
        **scene.notes,
    }


def describe_effects(module: pl.LightningModule) -> dict[str, dict[str, Any]]:
    """Physical effects by name, for metrics.json: those that are simulated with their settings.

    Where a scene chose them there is an entry for every effect of the catalogue, with the verdict on it, how many numbers
    it adds to this many Gaussians ("parameters") and what a step of training costs more ("ms_per_step").
    """
    simulated = module.thermal.effects() | module.sensor.effects()
    verdicts = module.config.get("verdicts")
    if not verdicts:
        return {name: {"on": True} | settings for name, settings in simulated.items()}
    described = {}
    for name, verdict in verdicts.items():
        described[name] = {key: verdict[key] for key in ("on", "told", "statistic", "threshold", "gain_db", "reason")}
        priced = "ms_per_step" in verdict
        described[name]["parameters"] = (
            verdict["shared"] + verdict["per_gaussian"] * len(module.splats) if priced else None if verdict["on"] else 0
        )
        described[name]["ms_per_step"] = verdict["ms_per_step"] if priced else None if verdict["on"] else 0.0
        if verdict["on"]:
            described[name]["settings"] = simulated.get(name, {})
    return described


def hyperparameters(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that say what was learned and how, flat: "thermal.frequencies" -> 24."""
    flat: dict[str, Any] = {}
    for key, value in walk({name: config[name] for name in HYPERPARAMETERS if name in config}):
        if key.endswith("._target_"):
            flat[key.removesuffix("._target_")] = str(value).split(".")[-1]
        elif not isinstance(value, Mapping):
            flat[key] = value if isinstance(value, (int, float, str, bool)) else str(value)
    return flat


def draw_curves(folder: Path) -> Path | None:
    """Draws scores against seconds of training, and returns the picture's path, or None without a course to draw."""
    if not (folder / CURVE_FILE).exists():
        return None
    rows = [row for row in read_csv(folder / CURVE_FILE) if row["train_seconds"] is not None]
    scores = [("psnr", "PSNR (dB)"), ("ssim", "SSIM"), ("mae_c", "MAE (°C)"), ("loss", "loss, training")]
    scores = [(name, label) for name, label in scores if any(row.get(name) is not None for row in rows)]
    if len(rows) < 2 or not scores:
        return None
    figure = Figure(figsize=(2.9 * len(scores), 2.6), dpi=110, layout="constrained")
    for i, (name, label) in enumerate(scores):
        axes = figure.add_subplot(1, len(scores), i + 1)
        points = [(row["train_seconds"], row[name]) for row in rows if row.get(name) is not None]
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, color=f"C{i}")
        axes.set(xlabel="seconds of training", ylabel=label if name == "loss" else f"{label}, validation")
        axes.grid(alpha=0.25)
    write_png(folder / CURVES_FILE, figure_picture(figure))
    return folder / CURVES_FILE


def report(results: RunResults, folder: Path, pictures: Sequence[Path], curves: Path | None) -> str:
    """report.md: scores beside cost, the course, pictures by relative path, what was found and learned, data, versions.

    What other callbacks did not leave in the folder is left out.
    """
    content = results.as_json()
    run, reasons = content["run"], content["reasons"]
    lines = [f"# {run.get('method') or run.get('thermal_model')} on {plain(str(run.get('scene')))}", ""]
    pairs = zip_longest(cells(content, "test"), cells(content, "cost"), fillvalue=("", ""))
    table = markdown_table(("score", "value", "", "cost", "value"), [(*score, "", *cost) for score, cost in pairs])
    lines += ["## Scores and cost", "", *table]
    missing: dict[str, list[str]] = {}
    for name in (f"{part}.{score}" for part in ("test", "cost") for score in content[part]):
        if name in reasons:
            missing.setdefault(reasons[name], []).append(f"`{name}`")
    if missing:
        lines += ["", "Not available:", "", *(f"- {', '.join(names)}: {reason}" for reason, names in missing.items())]
    if (folder / VIEWER_FILE).exists():
        lines += ["", f"Interactive 3D view with temperatures: [{VIEWER_FILE}]({VIEWER_FILE})."]
    if pictures:
        lines += ["", "## Test views", ""]
        for path in pictures:
            lines += [_picture(path, folder), ""]
        if (folder / TEST_FILE).exists():
            lines.append(f"Scores of each test image: [{TEST_FILE}]({TEST_FILE}).")
    lines += _picture_section("Around the scene", folder, TURNTABLE_FILE, "the scene, turning")
    if curves is not None:
        lines += ["", "## Quality over training time", "", f"![scores]({curves.relative_to(folder).as_posix()})"]
        lines += ["", f"Values: [{CURVE_FILE}]({CURVE_FILE})."]
    lines += _picture_section("Temperature over time", folder, "renders/probes.png", "probes")
    lines += _picture_section("What all surfaces or images share over time", folder, COURSES_PICTURE, "learned courses")
    lines += _surfaces_section(folder)
    lines += learned_section(folder)
    lines += ["", "## The run", "", *_bullets(run)]
    lines += _effects_section(content["effects"])
    lines += ["", "## Data: findings and assumptions", "", *_bullets(content["data"])]
    lines += ["", "## Definitions of the scores", "", *_bullets(content["definitions"])]
    lines += ["", "## Versions", "", *_bullets(content["versions"])]
    if entries := citations(run.get("method")):
        lines += ["", "## How to cite", "", *(f"- {entry}" for entry in entries)]
    return "\n".join([*lines, ""])


def _picture(path: Path, folder: Path, alternative: str | None = None) -> str:
    """A picture in Markdown, whatever its file is called: images may be named as a camera or a person liked."""
    words = plain(path.stem) if alternative is None else alternative
    return f"![{words}]({quote(path.relative_to(folder).as_posix())})"


def _picture_section(title: str, folder: Path, name: str, alternative: str) -> list[str]:
    return ["", f"## {title}", "", f"![{alternative}]({name})"] if (folder / name).exists() else []


def _surfaces_section(folder: Path) -> list[str]:
    """Hottest and coldest surfaces (``callbacks.surfaces``)."""
    if not (folder / SURFACES_FILE).exists():
        return []
    found = read_csv(folder / SURFACES_FILE)
    rows = [
        (
            f"{row['kind'][0].upper()}{row['number']:.0f}",
            f"{row['mean_c']:.1f} °C",
            f"{row['most_c']:.1f} °C",
            f"{row['area']:g} {row['unit']}",
            ", ".join(f"{row[axis]:.2f}" for axis in "xyz"),
            *([f"{row['latitude_deg']:.6f}, {row['longitude_deg']:.6f}"] if "latitude_deg" in row else []),
        )
        for row in found
    ]
    moment = found[0]["time_s"]
    when = "" if moment is None else f", {moment:.6g} s after the first training frame"
    note = (
        f"Connected surfaces seen by training views, as rendered by the model{when}: H the hottest, C the coldest. "
        "Centres are in scene coordinates. What has no texture and is seen at a flat angle, such as bare ground, may lie less "
        f"deep than it is shown. Table: [{SURFACES_FILE}]({SURFACES_FILE})."
    )
    titles = ("", "mean", "hottest, coldest 2 %", "area", "centre x, y, z", "latitude, longitude")[: len(rows[0])]
    table = markdown_table(titles, rows, "lrrrrr"[: len(titles)])
    picture = [f"![numbered surfaces]({SURFACES_PICTURE})", ""] if (folder / SURFACES_PICTURE).exists() else []
    return ["", "## Hottest and coldest surfaces", "", *picture, *table, "", note]


def learned_section(folder: Path) -> list[str]:
    """What the Gaussians have beside their temperature (``callbacks.attributes``)."""
    found = read_csv(folder / LEARNED_FILE) if (folder / LEARNED_FILE).exists() else []
    if not found:
        return []
    known = any(row["deviation"] for row in found)
    rows = []
    for row in found:
        told = [row["name"], _number(row["median"]), f"{_number(row['low'])} to {_number(row['high'])}"]
        told += [f"± {_number(row['deviation'])}" if row["deviation"] else NONE] * known
        rows.append((*told, row["unit"] or ""))
    note = (
        "The interval contains 90 % of the Gaussians, weighted by opacity and area. It shows how the scene varies, not the "
        "uncertainty of a "
        + ("value, which is the median standard deviation of one Gaussian. " if known else
           "value, which `evaluate.py callbacks=uncertainty` estimates. ")
        + f"Table: [{LEARNED_FILE}]({LEARNED_FILE})."
    )  # fmt: skip
    pictures = sorted((folder / "renders" / "attributes" / "test").glob("*.png"))[:1]
    maps = [_picture(path, folder, "maps of learned quantities") for path in pictures]
    heads = ("", "median", "90 % interval", *["standard deviation"] * known, "unit")
    table = markdown_table(heads, rows, "l" + "r" * (len(heads) - 2) + "l")
    return ["", "## Learned quantities", "", *table, "", note, "", *maps]


EFFECTS_NOTE = (
    "An effect is simulated if its statistic exceeds the threshold and the images can show it. There is no number if the effect "
    "was set by hand or the data are not sufficient. dB: gain on held-out observations. An effect that is off is absent: no "
    "parameter, no operation. Parameters: of the Gaussians at the end. ms per step: difference of whole training steps on the "
    "initial Gaussians with all effects and without this one (and those that depend on it), alternating, fastest of each; a few "
    "hundredths are noise."
)


def _effects_section(effects: Mapping[str, Any]) -> list[str]:
    """A table where a scene chose the effects, a list where the method did."""
    if not any("reason" in effect for effect in effects.values()):
        simulated = {
            name: {key: value for key, value in effect.items() if key != "on"} for name, effect in effects.items()
        }
        return ["", "## Simulated effects", "", *(_bullets(simulated) or ["None."])]
    settings = {name: effect["settings"] for name, effect in effects.items() if effect.get("settings")}
    return ["", "## Effects", "", *effects_table(effects), "", EFFECTS_NOTE, "", *_bullets(settings)]


def effects_table(effects: Mapping[str, Any]) -> list[str]:
    """Lines of a Markdown table of ``describe_effects``: what is simulated, why, and what it costs."""
    rows = []
    for name, effect in effects.items():
        statistic, threshold, parameters, milliseconds = (
            "–" if effect[key] is None else f"{effect[key]:,}" if key == "parameters" else f"{effect[key]:.3g}"
            for key in ("statistic", "threshold", "parameters", "ms_per_step")
        )
        sure = "**yes**" if effect["on"] else "no"
        on = sure if effect["told"] else "yes, but cannot be told" if effect["on"] else "cannot be told"
        gain, cost = effect["gain_db"], effect["ms_per_step"]
        gains = ("–" if gain is None else f"{gain:.1f}", f"{gain / cost:.2g}" if gain and cost and cost > 0 else "–")
        rows.append((name, on, statistic, threshold, *gains, effect["reason"], parameters, milliseconds))
    head = ("effect", "simulated", "statistic", "threshold", "dB", "dB per ms", "reason", "parameters", "ms per step")
    return markdown_table(head, rows, align="llrrrrlrr")


def cells(content: Mapping[str, Any], section: str) -> list[tuple[str, str]]:
    """Names and values of "test" or "cost" with their units, for a table; a dash for what could not be had."""
    units = COST_UNITS | {name: definition.unit for name, definition in DEFINITIONS.items()}
    cells = []
    for name, value in content[section].items():
        unit = units.get(name, units.get(name.partition("_")[2], ""))  # clean_mae_c has the unit of mae_c
        cells.append((name, "–" if value is None else f"{_number(value)} {unit}".rstrip()))
    return cells


def _number(value: float) -> str:
    """Four significant digits, and whole numbers as they are."""
    if float(value).is_integer() or abs(value) >= 1e4:
        return f"{value:,.0f}"
    return f"{value:.4g}"


def _bullets(values: Mapping[str, Any]) -> list[str]:
    """A list of names and values for Markdown, one level of nesting in line."""
    lines = []
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        words = ", ".join(f"{key} {_words(item)}" for key, item in value.items()) or "on" if nested else _words(value)
        lines.append(f"- {name}: {words}")
    return lines


def _words(value: Any) -> str:
    """A value for people, in Markdown: lists with commas, floats with six digits, a dash for nothing."""
    if isinstance(value, (list, tuple)):
        return ", ".join(_words(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "–" if value is None else plain(str(value))


def show(results: RunResults, folder: Path, picture: Path | None, console: Console | None = None) -> None:
    """Prints scores beside cost and where the report and a picture lie."""
    content = results.as_json()
    console = console or Console(markup=False, emoji=False)  # names and paths as they are
    run = content["run"]
    table = Table(title=f"{run.get('method') or run.get('thermal_model')} on {run.get('scene')}", title_justify="left")
    for column, justify in (("score", "left"), ("", "right"), ("cost", "left"), (" ", "right")):
        table.add_column(column, justify=justify)
    for score, cost in zip_longest(cells(content, "test"), cells(content, "cost"), fillvalue=("", "")):
        table.add_row(*score, *cost)
    console.print(table)
    console.print(f"machine: {run.get('machine')}; threads: {run.get('threads')}", soft_wrap=True)
    page = folder / PAGE_FILE
    console.print(f"report:  {page if page.exists() else folder / REPORT_FILE}", soft_wrap=True)
    if picture is not None:
        console.print(f"picture: {picture}", soft_wrap=True)
