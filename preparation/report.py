"""The page of a preparation: what it found, what the conditions bring, and pictures of the recording."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from heatsplat.contracts import counted, evenly_spread
from heatsplat.datamodules.timestamps import instant
from heatsplat.io.files import write_atomically
from heatsplat.io.page import PAGE_FILE, plain, write_page
from heatsplat.io.pictures import literal
from heatsplat.io.tables import markdown_table
from heatsplat.physics.radiometry import LIMITS, Conditions, measured_signal, surface_temperature, uncertainty
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C
from heatsplat.preparation.conditions import InputUncertainty
from heatsplat.preparation.devices import devices_of
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.target import PREPARED, REPORT
from heatsplat.preparation.writer import QUANTILES, rows

BINS = 160
SHOWN, ACROSS = 6, 3  # frames that are shown, and how many of them in a row
LOW, MIDDLE, HIGH = 2, len(QUANTILES) // 2, len(QUANTILES) - 3  # 5 %, 50 % and 95 % of the pixels
TIMES = ((DAY_S, "days"), (3600.0, "hours"), (60.0, "minutes"), (1.0, "seconds"))
LABELS = {
    "emissivity": "emissivity",
    "reflected_k": "reflected temperature",
    "distance_m": "distance",
    "air_k": "air temperature",
    "humidity": "relative humidity",
    "window_transmission": "window's transmittance",
    "window_k": "window's temperature",
    "camera": "camera",
}
SUFFIX = {"reflected_k": " °C", "distance_m": " m", "air_k": " °C", "humidity": " %", "window_k": " °C"}
APPARENT = (
    "Apparent temperatures: emissivity is 1, and neither air nor window is corrected; files and settings say nothing else. "
    "`conditions.emissivity=0.95 conditions.reflected_c=5 conditions.distance_m=20` would."
)
# Kelvin by which conditions change the temperature of half of the pixels; under a clear sky metals have more (ours).
LARGE_K = 20.0
NEUTRAL = {"emissivity": 1.0, "distance_m": 0.0, "window_transmission": 1.0}


@dataclass(frozen=True)
class Section:
    """A part of the report: Markdown under a heading.

    Args:
        title: of the heading.
        lines: Markdown; pictures are linked by their names relative to the prepared folder.
        values: what a program may want to read of it, as plain JSON values.
        findings: what is wrong or doubtful, a sentence or two each; they stand at the top of the page.
    """

    title: str
    lines: list[str]
    values: dict[str, object] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)


def write_report(target: Path, sections: Sequence[Section], made: str = PREPARED) -> Path:
    """Writes report.md, and report.html with the pictures in it; returns the path of the first. All findings stand first."""
    lines = [f"# {plain(target.name)}, {made}", ""]
    if findings := dict.fromkeys(finding for section in sections for finding in section.findings):
        lines += ["## Findings", "", *(f"- {finding}" for finding in findings), ""]
    for section in sections:
        lines += [f"## {section.title}", "", *section.lines, ""]
    text = "\n".join(lines)
    write_atomically(target / REPORT, text)
    write_page(target / PAGE_FILE, text)
    return target / REPORT


def recording(
    frames: Sequence[ThermalFrame],
    records: Sequence[Mapping[str, Any]],
    notes: Sequence[str],
    doubts: Sequence[str] = (),
) -> Section:
    """What was read; ``doubts`` about the settings are its findings."""
    findings = list(doubts)
    devices = devices_of(frames)
    lines = [f"- {counted(len(frames), 'frame')}, camera {devices[0].label}"]
    if len(devices) > 1:
        lines = [
            f"- {counted(len(frames), 'frame')} of {len(devices)} cameras, each with a lens and dead pixels of its own:"
        ]
        lines += [
            f"    - {d.label}: {counted(len(d.frames), 'frame')}, such as {plain(d.frames[0].name)}" for d in devices
        ]
    timed = [f.time for f in frames if f.time is not None]
    if timed:
        zones = "" if all(t.tzinfo for t in timed) else " (without a zone; zone=Europe/Berlin would say which)"
        ends = dict.fromkeys(time.isoformat() for time in (timed[0], timed[-1]))
        lines.append(f"- with a time: {len(timed)}, {' to '.join(ends)}{zones}")
        findings += _days_apart([frame for frame in frames if frame.time is not None])
    lines.append(f"- with a GPS position: {sum(f.position is not None for f in frames)}")
    if photos := sum(r["photo"] is not None for r in records):
        lines.append(f"- with a photo of the same moment: {photos}")
    if unknown := sum(r["unknown_pixels"] for r in records):
        lines.append(
            f"- {unknown} pixels have no temperature in their files, or one outside the camera's calibration, and are NaN"
        )
    if any(f.calibration is not None for f in frames):
        known = [r["quantiles"] for r in records if r["quantiles"]]
        lines.append(
            f"- {min(q[0] for q in known):.2f} .. {max(q[-1] for q in known):.2f} °C" if known else "- no temperature"
        )
        if not known:
            findings.append("No pixel has a temperature under these settings: check `conditions` and `counts`.")
    return Section("The recording", [*lines, *(f"- {note}" for note in notes)], findings=findings)


def _days_apart(timed: Sequence[ThermalFrame]) -> list[str]:
    """What to say where the longest pause between frames is one of days."""
    ordered = sorted(timed, key=lambda frame: instant(frame.time))
    pauses = [(instant(after.time) - instant(before.time), before, after) for before, after in pairwise(ordered)]
    length, before, after = max(pauses, key=lambda pause: pause[0], default=(0.0, None, None))
    if length < 2 * DAY_S:
        return []
    return [
        f"{length / DAY_S:.0f} days lie between {plain(before.name)} and {plain(after.name)}, and one scene is made of both. If "
        "these are two surveys, prepare each from a folder of its own into a target of its own."
    ]


def radiometry(
    frames: Sequence[ThermalFrame], records: Sequence[Mapping[str, Any]], uncertain: InputUncertainty
) -> Section | None:
    """What each condition is, where it comes from, what it changes and what uncertainty it brings; None for greys.

    At the temperatures that 5 %, half and 95 % of the pixels of the frame in the middle lie below. Its findings are
    what a thermographer would ask about.
    """
    usable = [i for i, r in enumerate(records) if frames[i].calibration is not None and r["quantiles"]]
    if not usable:
        return None
    frame, record = frames[usable[len(usable) // 2]], records[usable[len(usable) // 2]]
    response, c = frame.calibration.response, frame.conditions
    celsius = torch.tensor([record["quantiles"][k] for k in (LOW, MIDDLE, HIGH)], dtype=torch.float64)
    signal = measured_signal(celsius + KELVIN_AT_0_C, response, c)
    standard = uncertain.standard(c)
    parts = uncertainty(signal, response, c, standard)
    head = ["", "value", "from", *(f"changes {x:.1f} °C by" for x in celsius.tolist())]
    different = len({repr(f.conditions) for f in frames})
    stated = [
        f"Temperatures of surfaces, frame {plain(frame.name)}; the air lets {float(c.transmittance()):.4f} pass.",
        *(
            [f"The conditions differ between frames ({different} sets); each frame has its own."]
            if different > 1
            else []
        ),
        "",
        *markdown_table(head, _conditions(frame, celsius + KELVIN_AT_0_C, signal), "llrrrr"[: len(head)]),
    ]
    lines = [
        *(stated if any(_is_corrected(f) for f in frames) else [APPARENT]),
        "",
        "Uncertainty in °C by the GUM's law of propagation, for inputs that are independent of each other:",
        "",
        *markdown_table(
            ["input", "±", *(f"at {x:.1f} °C" for x in celsius.tolist())], _unsure(standard, parts), "llrrr"
        ),
    ]
    values = {"combined_c": parts["combined"].tolist(), "at_c": celsius.tolist()}
    apparent_c = float(surface_temperature(signal, response, Conditions())[1]) - KELVIN_AT_0_C
    surface_c = float(celsius[1])
    findings = _doubts(frames)
    if abs(surface_c - apparent_c) > LARGE_K:
        findings.append(
            f"The conditions turn an apparent {apparent_c:.1f} °C, the median of {plain(frame.name)}, into {surface_c:.1f} °C. "
            "Check emissivity, reflected temperature and window under Radiometry."
        )
    return Section("Radiometry", lines, values, findings)


def _conditions(frame: ThermalFrame, surface: torch.Tensor, signal: torch.Tensor) -> list[list[str]]:
    """A row for each condition: its value, where it comes from, and what it changes at temperatures of surfaces in kelvin."""
    rows, c = [], frame.conditions
    for name in LIMITS:
        value = float(getattr(c, name))
        shown = value - KELVIN_AT_0_C if name.endswith("_k") else 100 * value if name == "humidity" else value
        change = [""] * 3
        if name in NEUTRAL and value != NEUTRAL[name]:
            without = surface_temperature(signal, frame.calibration.response, replace(c, **{name: NEUTRAL[name]}))
            change = _cells(surface - without, "+.2f")
        source = frame.sources.get(name, "no correction")
        rows.append([LABELS[name], f"{shown:.4g}{SUFFIX.get(name, '')}", source, *change])
    return rows


def _unsure(standard: Mapping[str, float], parts: Mapping[str, torch.Tensor]) -> list[list[str]]:
    """A row for each input whose uncertainty can be seen in its parts, the largest first, and for all of them."""
    rows = [
        [LABELS[name], _plus_minus(name, value), *_cells(parts[name], ".2f")]
        for name, value in sorted(standard.items(), key=lambda item: -float(parts[item[0]].nan_to_num().max()))
        if value
    ]
    rows.append(["**all, standard**", "", *_cells(parts["combined"], ".2f")])
    rows.append(["**all, expanded (k = 2, 95 %)**", "", *_cells(2 * parts["combined"], ".2f")])
    return [row for row in rows if any(float(cell or 0.0) for cell in row[2:])]


def _cells(values: torch.Tensor, form: str) -> list[str]:
    return [format(x, form) if np.isfinite(x) else "" for x in values.tolist()]


def _is_corrected(frame: ThermalFrame) -> bool:
    """Whether its temperatures are those of surfaces; without an effect of emissivity, air and window they are apparent."""
    return any(float(getattr(frame.conditions, name)) != neutral for name, neutral in NEUTRAL.items())


def _plus_minus(name: str, value: float) -> str:
    shown = 100 * value if name == "humidity" else value
    return f"{shown:.3g}{SUFFIX.get(name, ' °C' if name == 'camera' else '')}"


def _doubts(frames: Sequence[ThermalFrame]) -> list[str]:
    """What the files say and a thermographer would ask about."""
    found = []
    behind = [
        f for f in frames if f.conditions.window_transmission < 1 and f.sources.get("window_transmission") == "file"
    ]
    if behind:
        found.append(
            f"The files of {counted(len(behind), 'frame')}, such as {plain(behind[0].name)}, say that a window of "
            f"{float(behind[0].conditions.window_transmission):g} was in front of the camera. If there was none, set "
            "conditions.window_transmission=1."
        )
    for f in frames:
        high = f.position.above_takeoff_m if f.position else None
        down = f.attitude is not None and f.attitude.pitch_deg < -60
        if high and down and f.sources.get("distance_m") == "file" and high > 2 * f.conditions.distance_m:
            found.append(
                f"The files say {f.conditions.distance_m:g} m to the surface, but the camera looked down from {high:.0f} m: "
                f"conditions.distance_m={high:.0f} corrects the air."
            )
            break
    return found


def pictures(target: Path, frames: Sequence[ThermalFrame], records: Sequence[Mapping[str, Any]]) -> Section:
    """A few frames, the histogram of every frame, and how temperatures run over time where there are several."""
    shown = [frame for frame, record in zip(frames, records, strict=True) if record["quantiles"]]
    known = [(row, r["quantiles"]) for row, r in zip(rows(frames, records), records, strict=True) if r["quantiles"]]
    if not known:
        return Section("Pictures", ["No frame has a temperature."])
    quantiles = np.array([q for _, q in known])
    unit = "°C" if frames[0].calibration is not None else "grey"
    save_picture(_few_frames(shown, quantiles, unit), target / "report" / "frames.png")
    save_picture(_histograms(quantiles, unit), target / "report" / "histograms.png")
    lines = [
        f"![{counted(min(len(shown), SHOWN), 'frame')}, one scale for all](report/frames.png)",
        "",
        "![histogram of every frame](report/histograms.png)",
        "",
    ]
    if len(known) == 1:
        return Section("Pictures", lines)
    times = np.array([row["time_s"] for row, _ in known]) if "time_s" in known[0][0] else None
    save_picture(_over_time(times, quantiles, unit), target / "report" / "over_time.png")
    middle = quantiles[:, MIDDLE]
    jump = np.abs(np.diff(middle)).max()
    lines += [
        "![temperatures over time](report/over_time.png)",
        "",
        f"The median runs from {middle.min():.2f} to {middle.max():.2f} {unit}; from one frame to the next it moves by up to "
        f"{jump:.2f} {unit}. Steps and slopes that all pixels share are drift and shutter of the camera, unless it saw another "
        "part of the scene.",
    ]
    return Section("Pictures", lines, {"median_span": float(np.ptp(middle)), "largest_step": float(jump)})


def _few_frames(frames: Sequence[ThermalFrame], quantiles: np.ndarray, unit: str) -> Figure:
    """Frames spread over the recording, in colours that they share, from their quantiles [n, q]."""
    few = [frames[i] for i in evenly_spread(len(frames), SHOWN)]
    columns = min(len(few), ACROSS)
    lines = -(-len(few) // columns)
    height, width = few[0].pixels().shape
    across = 9.0 / columns if columns > 1 else 6.0
    figure = Figure(figsize=(across * columns + 1.0, (across * height / width + 0.3) * lines), layout="compressed")
    places = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    low, high = np.percentile(quantiles[:, 1], 5), np.percentile(quantiles[:, -2], 95)
    for place, frame in zip(places, few, strict=False):
        image = place.imshow(frame.pixels(), cmap="inferno", vmin=low, vmax=max(high, low + 1e-6))
        place.set_title(literal(frame.name), fontsize=7)
    for place in places:
        place.set_axis_off()
    # The hottest and the coldest lie beyond.
    figure.colorbar(image, ax=list(places), label=unit, shrink=0.8, extend="both")
    return figure


def _histograms(quantiles: np.ndarray, unit: str) -> Figure:
    """The shares of pixels in each bin of value, frame after frame; of one frame alone as steps."""
    edges = np.linspace(quantiles[:, 0].min(), max(quantiles[:, -1].max(), quantiles[:, 0].min() + 1e-6), BINS + 1)
    # A frame's share of pixels in each bin, from its distribution function, which its quantiles give.
    share = np.stack([np.diff(np.interp(edges, *_rising(q), left=0.0, right=1.0)) for q in quantiles])
    per_bin = f"% of pixels per {edges[1] - edges[0]:.2g} {unit}"
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    if len(share) == 1:
        axes.stairs(100 * share[0], edges, fill=True, color="tab:red")
        axes.set(xlabel=unit, ylabel=per_bin, title="Histogram")
        axes.margins(x=0)
        return figure
    image = axes.imshow(
        100 * share.T,
        origin="lower",
        aspect="auto",
        extent=(-0.5, len(share) - 0.5, edges[0], edges[-1]),
        cmap="magma",
        vmax=100 * np.quantile(share, 0.995) or None,
        interpolation="nearest",
    )
    figure.colorbar(image, label=per_bin)
    axes.set(xlabel="frame", ylabel=unit, title="Histogram of every frame")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _over_time(times_s: np.ndarray | None, quantiles: np.ndarray, unit: str) -> Figure:
    """How quantiles run over time, or from frame to frame where times are not known."""
    place, along = np.arange(len(quantiles), dtype=float), "frame"
    if times_s is not None:
        length, unit_of_time = next((one for one in TIMES if np.ptp(times_s) >= 2 * one[0]), TIMES[-1])
        place, along = times_s / length, f"{unit_of_time} since the first frame"
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots()
    for low, high, alpha in ((0, -1, 0.12), (LOW, HIGH, 0.25)):
        axes.fill_between(place, quantiles[:, low], quantiles[:, high], alpha=alpha, color="tab:red", linewidth=0)
    axes.plot(place, quantiles[:, MIDDLE], color="tab:red", marker=".", linewidth=1)
    axes.set(xlabel=along, ylabel=unit, title="Median of every frame, 5 .. 95 % of its pixels, and all of them")
    axes.margins(x=0.01)
    return figure


def _rising(quantiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Temperatures that rise, and the share of pixels below each: of equal ones the largest share."""
    last = np.append(np.diff(quantiles) > 0, True)
    return np.append(quantiles[0] - 1e-9, quantiles[last]), np.append(0.0, QUANTILES[last])


def save_picture(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomically(path, buffer.getvalue())
