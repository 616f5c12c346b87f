"""Temperature over time at points of the scene: ground truth against model."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytorch_lightning as pl
import torch
from matplotlib.figure import Figure
from torch import Tensor

from heatsplat.callbacks.asked_points import OPTION, AskedPoint, asked_points
from heatsplat.callbacks.board import add_picture
from heatsplat.contracts import Camera, Frame, SceneData, ViewSet, check_count, evenly_spread
from heatsplat.io.pictures import figure_picture, literal, write_png
from heatsplat.io.quantities import clock_of, time_unit
from heatsplat.io.tables import write_csv
from heatsplat.shots import first_free_id

log = logging.getLogger("heatsplat")

PROBES_PICTURE = "renders/probes.png"
CANDIDATES = 16  # validation cameras that are tried for a view of the probes
OCCLUDERS = 3  # this many scene points close to a probe's pixel and well in front of it hide it
NEAR_PIXELS = 0.02  # "close": of the image's width
NEAR_DEPTH = 0.93  # "well in front": nearer than this times the probe's depth
ASKED_CANDIDATES = 64  # training cameras that are tried for points that a table names
DOTS = 200  # training images that are sampled where the true curve is not known


@dataclass(frozen=True)
class Probe:
    """A point whose temperature is drawn: name, place, the frame whose camera looks at it, the pixel it falls on."""

    name: str
    point: Tensor
    frame: Frame
    row: int
    column: int


class TemperatureCurves(pl.Callback):
    """Draws the temperature of probe points over time into TensorBoard and renders/probes.png, the numbers into .csv and the
    places of the points into renders/probe_positions.csv: at the first, second, fourth, eighth, ... validation, and at the test.

    The model's curve is the value of the rendered pixel on which the probe falls, seen from one validation camera at
    all times. The truth is the scene's own where it is synthetic; elsewhere dots show what the training images recorded
    of the probe, each from its own camera. Probes are those of a table, else the scene's, or points of its cloud spread over
    the image. Models that know no time, and scenes without times, have no curves. Moments beyond the training record, of test
    views, are shaded and counted in the table's column "beyond_record_s"; where the clock of the record is known, the table has
    it.

    Args:
        count: how many probes to draw at most, of those that no table names.
        times: how many times the model is rendered at, between the first and the last frame.
        points: CSV of the points whose curves are wanted (``asked_points``); None takes the scene's, or points of its cloud.
    """

    def __init__(self, count: int = 6, times: int = 32, points: str | None = None) -> None:
        check_count("callbacks.probes.count", count, 0)
        check_count("callbacks.probes.times", times)
        self.count, self.times, self.points = count, times, points
        self._asked: list[AskedPoint] = []
        self._probes: list[Probe] | None = None
        self._dots: list[tuple[list[float], list[float]]] = []
        self._validations = 0

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._ask(module)

    def on_test_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._ask(module)
        self._probes = None if self._asked else self._probes  # of pixels the surfaces are known better now

    def _ask(self, module: pl.LightningModule) -> None:
        """Reads the table of points before anything is trained or rendered in vain."""
        if self.points is None or self._asked:
            return
        self._asked = asked_points(self.points, module.scene)
        if not self._changes(module):
            log.warning("%s=%s: a method or scene without time has no curves", OPTION, self.points)

    def on_validation_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if trainer.sanity_checking:
            return
        self._validations += 1
        if self._validations.bit_count() == 1:  # at each of them, it would take a tenth of a short run
            self._draw(module, trainer.global_step, "probes")

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._draw(module, trainer.global_step, "test/probes")

    def state_dict(self) -> dict[str, int]:
        return {"validations": self._validations}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self._validations = state["validations"]

    def _draw(self, module: pl.LightningModule, step: int, tag: str) -> None:
        scene = module.scene
        if not self._changes(module) or not (self.count or self._asked):
            return
        if self._probes is None:
            self._probes = asked_probes(self._asked, module) if self._asked else find_probes(scene, self.count)
            self._dots = (
                [recorded(probe, scene, module.modality) for probe in self._probes] if scene.truth is None else []
            )
        span = [frame.time_s for frame in scene.frames if frame.time_s is not None]
        if not self._probes or min(span) == max(span):
            return
        times = torch.linspace(min(span), max(span), self.times, dtype=torch.float64)
        model = self._rendered(module, times)
        truth = None
        if scene.truth is not None:
            truth = scene.truth(torch.stack([probe.point for probe in self._probes]), times).double().cpu().numpy()
        bounds = scene.range_of(module.modality)
        unit, to_unit = ("image value", lambda value: value) if bounds is None else ("°C", bounds.to_celsius)
        model = to_unit(model)
        dots = [(t, [to_unit(v) for v in values]) for t, values in self._dots]
        names = [probe.name for probe in self._probes]
        title = f"{scene.name}, step {step}" if step else scene.name  # of a checkpoint no step is taken
        clock = clock_of(scene)
        title += "" if clock is None else f", 0 is {clock.at(0.0)}"
        record = min(scene.train.times_s), max(scene.train.times_s)
        picture = figure_picture(_figure(times.numpy(), record, names, model, truth, dots, unit, title))
        png = write_png(module.output_dir / PROBES_PICTURE, picture)
        self._write(module, times.tolist(), model, truth)
        self._write_positions(module)
        add_picture(module, tag, picture, png, step)

    def _changes(self, module: pl.LightningModule) -> bool:
        return "time" in module.thermal.needs and "time" in module.scene.metadata

    def _rendered(self, module: pl.LightningModule, times: Tensor) -> np.ndarray:
        """Image values of the probes' pixels, [n, F] float64; one render per camera and time serves all its probes."""
        values, free_id = np.empty((len(self._probes), len(times))), first_free_id(module.scene)
        for frame_id in {probe.frame.frame_id for probe in self._probes}:
            seen = [i for i, probe in enumerate(self._probes) if probe.frame.frame_id == frame_id]
            frame = self._probes[seen[0]].frame
            for j, time_s in enumerate(times.tolist()):
                # At another moment it is no training image, whose own settings of the camera a part of the sensor may know.
                image = module.predict(replace(frame, frame_id=free_id, time_s=time_s)).mean(-1)
                rows, columns = ([getattr(self._probes[i], axis) for i in seen] for axis in ("row", "column"))
                values[seen, j] = image[rows, columns].double().cpu().numpy()
        return values

    def _write(
        self, module: pl.LightningModule, times: list[float], model: np.ndarray, truth: np.ndarray | None
    ) -> None:
        names = [probe.name for probe in self._probes]
        beyond = [module.scene.beyond_record(time) for time in times]
        columns = ["time_s", "beyond_record_s", *names]
        columns += [] if truth is None else [f"truth of {name}" for name in names]
        stacked = np.concatenate([[times, beyond], model, *([] if truth is None else [truth])])
        rows = [dict(zip(columns, values, strict=True)) for values in stacked.T.tolist()]
        clock = clock_of(module.scene)
        if clock is not None:
            columns.insert(1, "clock")
            rows = [row | {"clock": clock.at(row["time_s"], "seconds")} for row in rows]
        write_csv(module.output_dir / "renders" / "probes.csv", rows, columns)

    def _write_positions(self, module: pl.LightningModule) -> None:
        """Where each probe lies in the coordinates of the data set, and the image and the pixel that its curve is of."""
        rows, origin = [], module.scene.origin
        for probe in self._probes:
            place = dict(zip("xyz", (round(value, 6) for value in (probe.point + origin).tolist()), strict=True))
            rows.append(
                {"name": probe.name, **place, "view": probe.frame.name, "row": probe.row, "column": probe.column}
            )
        write_csv(module.output_dir / "renders" / "probe_positions.csv", rows)


def seen_by(camera: Camera, points: Tensor, cloud: Tensor) -> Tensor:
    """Which points [n, 3] the camera sees, [n] bool: in the image and not behind points of the cloud [P, 3]."""
    pixels, depths = camera.project(points)
    inside = camera.inside(pixels, depths, margin=1)
    others, other_depths = camera.project(cloud)
    for i in inside.nonzero()[:, 0].tolist():
        near = ((others - pixels[i]).abs() < NEAR_PIXELS * camera.width).all(1)
        hiding = near & (other_depths > 0) & (other_depths < NEAR_DEPTH * depths[i])
        inside[i] = int(hiding.sum()) < OCCLUDERS
    return inside


def find_probes(scene: SceneData, count: int) -> list[Probe]:
    """The scene's probes, or points of its cloud, each with a validation camera that sees it; unseen ones are left out.

    Where ``scene.notes["probes"]`` lists a name for each of the scene's probes, they carry it.

    Cameras are chosen greedily, the one that sees most first, so that few renders serve many probes.
    """
    views: ViewSet = scene.val if len(scene.val) else scene.train
    frames = [views.frames[i] for i in evenly_spread(len(views), CANDIDATES)]
    cloud = scene.points[:: max(1, len(scene.points) // 20_000)]
    if scene.probes is not None:
        picked = evenly_spread(len(scene.probes), count)
        points, told = scene.probes[picked], scene.notes.get("probes")
        names = [told[i] for i in picked] if isinstance(told, list) and len(told) == len(scene.probes) else None
    else:
        points, names = _spread_points(frames, cloud, count), None
    if not len(points) or not frames:
        return []
    return _looked_at(points, names or [f"probe {i + 1}" for i in range(len(points))], frames, cloud)


def asked_probes(asked: Sequence[AskedPoint], module: pl.LightningModule) -> list[Probe]:
    """The points of a table, each with a camera that sees it: that of its pixel, or of a training or validation view; those that
    none sees are left out, and the log names them."""
    scene, probes, places, names, unseen = module.scene, [], [], [], []
    for one in asked:
        place = one.placed(module.surface, module.cameras.of)
        if place is None:
            unseen.append(one.name)
        elif one.frame is not None:
            probes.append(Probe(one.name, place.float(), one.frame, one.row, one.column))
        else:
            places.append(place.float())
            names.append(one.name)
    if places:
        views = [*scene.val.frames, *(scene.train.frames[i] for i in evenly_spread(len(scene.train), ASKED_CANDIDATES))]
        cloud = scene.points[:: max(1, len(scene.points) // 20_000)]
        probes += _looked_at(torch.stack(places), names, views, cloud)
        unseen += sorted(set(names) - {probe.name for probe in probes})
    if unseen:
        log.warning("%s: no camera sees %s, of which there is no curve", OPTION, ", ".join(unseen))
    order = [one.name for one in asked]
    return sorted(probes, key=lambda probe: order.index(probe.name))


def _looked_at(points: Tensor, names: Sequence[str], frames: Sequence[Frame], cloud: Tensor) -> list[Probe]:
    """Points [n, 3] with a camera that sees each, chosen greedily; those that none sees are left out."""
    seen = torch.stack([seen_by(frame.camera, points, cloud) for frame in frames])
    chosen: dict[int, Frame] = {}
    left = torch.ones(len(points), dtype=torch.bool)
    while bool((seen & left).any()):
        best = int((seen & left).sum(1).argmax())
        for i in (seen[best] & left).nonzero()[:, 0].tolist():
            chosen[i] = frames[best]
        left &= ~seen[best]
    probes = []
    for i, frame in sorted(chosen.items()):
        column, row = frame.camera.project(points[i : i + 1])[0][0].tolist()
        probes.append(Probe(names[i], points[i].detach().cpu(), frame, int(row), int(column)))
    return probes


def _spread_points(frames: Sequence[Frame], cloud: Tensor, count: int) -> Tensor:
    """Points of the cloud far from each other in the image of the camera that sees most of it, [n, 3]."""
    if not frames or not len(cloud):
        return cloud[:0]
    sample = cloud[:: max(1, len(cloud) // 500)]
    visible = [sample[seen_by(frame.camera, sample, cloud)] for frame in frames[:4]]
    best = max(range(len(visible)), key=lambda i: len(visible[i]))
    points = visible[best]
    if not len(points):
        return points
    pixels, _ = frames[best].camera.project(points)
    picked = [int((pixels - pixels.mean(0)).norm(dim=1).argmin())]
    while len(picked) < min(count, len(points)):
        picked.append(int(torch.cdist(pixels, pixels[picked]).amin(1).argmax()))
    return points[picked]


def recorded(probe: Probe, scene: SceneData, modality: str) -> tuple[list[float], list[float]]:
    """What training images recorded of a probe: times in seconds and image values, from the cameras that see it."""
    cloud = scene.points[:: max(1, len(scene.points) // 5_000)]
    times, values = [], []
    for i in evenly_spread(len(scene.train), DOTS):
        frame = scene.train.frames[i]
        if not bool(seen_by(frame.camera, probe.point[None], cloud)[0]):
            continue
        column, row = (int(x) for x in frame.camera.project(probe.point[None])[0][0].tolist())
        view = scene.train[i]
        value = view.image(modality)[row, column].mean().item()
        if np.isfinite(value) and (view.known is None or bool(view.known[row, column])):
            times.append(frame.time_s)
            values.append(value)
    return times, values


def _figure(
    times: np.ndarray,
    record: tuple[float, float],
    names: Sequence[str],
    model: np.ndarray,
    truth: np.ndarray | None,
    dots: Sequence[tuple[Sequence[float], Sequence[float]]],
    unit: str,
    title: str,
) -> Figure:
    """Curves of all probes: lines are the model, dashes the truth, dots what images recorded; shaded beyond the record."""
    divisor, word = time_unit(times[-1] - times[0])
    figure = Figure(figsize=(9, 4.2), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    outside = [(times[0], record[0]), (record[1], times[-1])]
    outside = [(start, end) for start, end in outside if start < end]
    for start, end in outside:
        axes.axvspan(start / divisor, end / divisor, color="0.9", linewidth=0, zorder=0)
    for i, curve in enumerate(model):
        color = f"C{i}"
        axes.plot(times / divisor, curve, color=color, linewidth=1.6, label=literal(names[i]))
        if truth is not None:
            axes.plot(times / divisor, truth[i], color=color, linewidth=1.2, linestyle=(0, (4, 2)), alpha=0.8)
        elif dots:
            axes.scatter(np.asarray(dots[i][0]) / divisor, dots[i][1], color=color, s=9, alpha=0.55, linewidths=0)
    against = "dashes: truth" if truth is not None else "dots: training images" if dots else "no truth known"
    axes.set(xlabel=f"time ({word})", ylabel=f"temperature ({unit})" if unit == "°C" else unit)
    against += "; grey: beyond the record" if outside else ""
    axes.set_title(f"{literal(title)}   (lines: model, {against})", fontsize=10)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, ncols=2, framealpha=0.7)
    return figure
