"""What a checkpoint counts in: the clock, the temperatures and the cameras of the scene that it was trained on.

Clock and temperatures follow from the training images: time begins at the first of them, and bounds of temperatures may be
theirs. Data that are divided otherwise, or have other bounds, would be read on other scales than those on which a model has
learned.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, ThermalRange, View, ViewSet
from heatsplat.training.trained_frames import check_frames, frames_of

log = logging.getLogger(__name__)


def scales_of(scene: SceneData) -> dict[str, Any]:
    """What a checkpoint tells of a scene: "range_c", its bounds in °C, "first", the name of its first training frame, and
    "frames" (``trained_frames.frames_of``).

    The first two are None where the scene has no temperatures, or no times.
    """
    bounds, frames = scene.thermal_range, scene.train.frames
    timed = "time" in scene.metadata and len(frames) > 0
    return {
        "range_c": None if bounds is None else [bounds.min_c, bounds.max_c],
        "first": min(frames, key=lambda frame: frame.time_s).name if timed else None,
        "frames": frames_of(scene),
    }


def check_same_scene(scene: SceneData, scales: Mapping[str, Any]) -> None:
    """Raises SceneError where training cannot go on with a scene, which is not the one of its checkpoint (``scales_of``)."""
    check_frames(scales.get("frames"), scene, exactly=True)
    here, bounds = scene.thermal_range, scales.get("range_c")
    if bounds is not None and here is not None and bounds != [here.min_c, here.max_c]:
        raise SceneError(
            f"the images of scene '{scene.name}' have bounds of {here.min_c:.6g} to {here.max_c:.6g} °C, and in training had "
            f"{bounds[0]:.6g} to {bounds[1]:.6g} °C: give the data as they were, or train again, in another folder"
        )


def on_scales(
    scene: SceneData, scales: Mapping[str, Any], *, exactly: bool = False, numbered: bool = False
) -> SceneData:
    """The scene on the scales of a checkpoint (``scales_of``): times since its first frame, image values of its bounds.

    Where the first frame is not among the scene's any more, times stay as they are, and a warning says so; and so does one where
    test frames were trained on.

    Args:
        exactly: its training frames have to be those of the checkpoint (``trained_frames.check_frames``).
        numbered: they have to have the same numbers.

    Raises:
        SceneError: its cameras or frames are not those of the checkpoint.
    """
    first, bounds = scales.get("first"), scales.get("range_c")
    if first is not None and "time" in scene.metadata:
        frames = (*scene.train.frames, *scene.val.frames, *scene.test.frames)
        later = next((frame.time_s for frame in frames if frame.name == first), None)
        if later is None:
            log.warning(
                "the run counted time from frame %s, which the data do not have now: moments may be shifted", first
            )
        elif later != 0:
            log.info("times are counted from frame %s, as in training", first)
            scene = _since(scene, later)
    check_frames(scales.get("frames"), scene, exactly=exactly, numbered=numbered)
    # Of frames that the data have in training and test the data say so.
    trained = {*(scales.get("frames") or {}).get("names", ())} - {frame.name for frame in scene.train.frames}
    if seen := [frame.name for frame in scene.test.frames if frame.name in trained]:
        log.warning(
            "%d of the %d test images of scene '%s' were trained on (%s): their scores, and intervals that are fitted to such "
            "images, flatter the run. Leave data.split as it was in training, or hold out other images",
            len(seen), len(scene.test), scene.name, ", ".join(seen[:3]) + ", ..." * (len(seen) > 3),
        )  # fmt: skip
    here = scene.thermal_range
    if bounds is not None and here is not None and bounds != [here.min_c, here.max_c]:
        log.warning(
            "the data now have bounds of %.6g to %.6g °C; those of training stay, %.6g to %.6g °C",
            here.min_c,
            here.max_c,
            *bounds,
        )
        scene = _within(scene, ThermalRange(*bounds))
    return scene


def _since(scene: SceneData, zero_s: float) -> SceneData:
    """The scene with ``zero_s`` of its clock as its new second 0."""
    truth, clock_s = scene.truth, scene.notes.get("clock_at_zero_s")
    return replace(
        _mapped(scene, lambda view: replace(view, frame=replace(view.frame, time_s=_less(view.time_s, zero_s)))),
        weather=None if scene.weather is None else scene.weather.since(zero_s),
        truth=None if truth is None else lambda points, times_s: truth(points, times_s + zero_s),
        notes=scene.notes if clock_s is None else {**scene.notes, "clock_at_zero_s": clock_s + zero_s},
    )


def _less(time_s: float | None, zero_s: float) -> float | None:
    return None if time_s is None else time_s - zero_s


def _within(scene: SceneData, bounds: ThermalRange) -> SceneData:
    """The scene with image values of other bounds, which values outside them leave."""
    here = scene.thermal_range

    def turned(image: Tensor | None) -> Tensor | None:
        return None if image is None else bounds.to_unit(here.to_celsius(image))

    scene = _mapped(scene, lambda view: replace(view, thermal=turned(view.thermal), clean=turned(view.clean)))
    return replace(scene, thermal_range=bounds)


def _mapped(scene: SceneData, changed: Callable[[View], View]) -> SceneData:
    """The scene with every view changed; frames are known without pixels."""

    def of(views: ViewSet) -> ViewSet:
        return ViewSet([changed(View(frame)).frame for frame in views.frames], lambda k: changed(views[k]))

    return replace(scene, train=of(scene.train), val=of(scene.val), test=of(scene.test))
