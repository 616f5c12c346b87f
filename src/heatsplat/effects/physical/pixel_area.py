"""Pixels that average over what they cover."""

from __future__ import annotations

from heatsplat.contracts import SceneData
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.geometry.resampling import scale_between


def fineness(scene: SceneData) -> int | None:
    """By which whole number the views that are asked for are finer than the training images; None where there is none.

    Views that are asked for are the test views, or the validation views where there are none.
    """
    asked = scene.test if len(scene.test) else scene.val
    if len(asked) == 0 or len(scene.train) == 0:
        return None
    (fine, *others), coarse = (
        sorted({(frame.camera.height, frame.camera.width) for frame in views.frames}) for views in (asked, scene.train)
    )
    return scale_between(fine, coarse[0]) if len(coarse) == 1 and not others else None


def evidence(inspected: Inspection) -> Evidence:
    """Whether finer images are asked for than were recorded. Sizes of images say it, not what they show."""
    factor = fineness(inspected.given)
    if factor is None:
        return Evidence(None, "training views and those that are asked for have no whole number between their sizes")
    if factor == 1:
        return Evidence(1.0, "views that are asked for are as fine as the training images")
    said = f"views that are asked for have {factor} x {factor} pixels where the training images have one"
    return Evidence(float(factor), said, {"factor": factor})


def missing(scene: SceneData) -> str | None:
    """That nothing finer is asked for."""
    factor = fineness(scene)
    if factor is None or factor == 1:
        return "no views are asked for that are finer than the training images by a whole number"
    return None


EFFECT = Effect(
    name="pixel_area",
    stage="sensor",
    place=8,
    summary="pixels average over their area",
    source="detector footprint; SupIR-GS, degradation model",
    null="test views are no finer than the training images",
    # Their sizes decide: one pixel, or several.
    threshold=1.0,
    adds="rendering at the resolution of the test views, averaged over the pixels of the training images",
    evidence=evidence,
    part=Part("grid", "pixel_area"),
    missing=missing,
)
