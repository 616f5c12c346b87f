"""What a run found to change over the record for the whole scene or the camera: a heat source, the air, a detector's drift."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytorch_lightning as pl
from matplotlib.figure import Figure

from heatsplat.callbacks.board import add_picture
from heatsplat.contracts import SHARE_OF_RANGE, Course
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.quantities import time_unit
from heatsplat.io.tables import write_csv

COURSES_PICTURE, COURSES_FILE = "renders/courses.png", "renders/courses.csv"


class LearnedCourses(pl.Callback):
    """Draws the courses over time that the thermal model and the camera's parts learned (``Heat.courses``) into
    renders/courses.png and TensorBoard at the end of a run, the numbers into .csv. Models that have none have no picture.

    What is a share of the image's range is drawn in °C where that is known.
    """

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        bounds = module.scene.range_of(module.modality)
        span_k = None if bounds is None else bounds.span_k
        found = [
            _in_celsius(course, span_k)
            for part in (module.thermal, *module.sensor.parts.values())
            for course in part.courses()
            if len(course.times_s) > 1
        ]
        if not found:
            return
        rows: list[dict[str, Any]] = [
            {"course": course.name, "unit": course.unit, "time_s": time_s, "value": value}
            for course in found
            for time_s, value in zip(course.times_s, course.values, strict=True)
        ]
        write_csv(module.output_dir / COURSES_FILE, rows)
        picture = figure_picture(_figure(found, sorted(t for t in module.scene.train.times_s if t is not None)))
        png = write_png(module.output_dir / COURSES_PICTURE, picture)
        add_picture(module, "test/courses", picture, png, trainer.global_step)


def _in_celsius(course: Course, span_k: float | None) -> Course:
    if course.unit != SHARE_OF_RANGE or span_k is None:
        return course
    return Course(course.name, course.times_s, [span_k * value for value in course.values], "°C")


def _figure(courses: Sequence[Course], recorded_s: Sequence[float]) -> Figure:
    """One axis below the other, with ticks at the training images."""
    times = [time_s for course in courses for time_s in course.times_s]
    divisor, word = time_unit(max(times) - min(times))
    figure = Figure(figsize=(9, 0.6 + 2.2 * len(courses)), dpi=110, layout="constrained")
    for axes, course in zip(figure.subplots(len(courses), sharex=True, squeeze=False)[:, 0], courses, strict=True):
        axes.plot([t / divisor for t in course.times_s], course.values, linewidth=1.6)
        low = axes.get_ylim()[0]
        axes.plot([t / divisor for t in recorded_s], [low] * len(recorded_s), "|", color="0.5", markersize=7)
        axes.set(title=course.name, ylabel=course.unit)
        axes.title.set_fontsize(10)
        axes.grid(alpha=0.25)
    axes.set_xlabel(f"time ({word}); ticks: training images")
    return figure
