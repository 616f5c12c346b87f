"""Which frames of a recording are held out, and what each of them asks for: another time, another place, another weather."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from heatsplat.contracts import SceneError

TRAIN = "train"


def parts_of(
    times_s: np.ndarray,
    viewmats: np.ndarray,
    near: int = 8,
    views: float = 0.12,
    **stretches: Sequence[Sequence[float]],
) -> list[str]:
    """The part of each frame: "train", or by what it is held out.

    A frame belongs to the first of these that it fits: a stretch of the record by its name; "views", seen from farther to
    one side than any other frame; "near", every so many of those that are left, beginning with the middle of the first.

    Args:
        times_s: [F] times of the frames, increasing.
        viewmats: [F, 4, 4] world-to-camera.
        near: of how many frames one is "near".
        views: share of the frames (of those in no stretch) that are "views": the largest angles about the vertical axis, from
            -180° to 180° with 0° in front.
        stretches: name -> [[from, to], ...] of the record, each as a share of it from its first frame to its last.

    Raises:
        SceneError: no frame is left to train on, or a share or stretch is none.
    """
    if near < 1 or not 0 <= views < 1:
        raise SceneError(
            f"data.parts: near counts frames, from 1 on, and views is a share of them in [0, 1), got {near} and {views}; null "
            "leaves either at its default"
        )
    share = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-12)
    parts = [TRAIN] * len(share)
    for name, bounds in stretches.items():
        if "_" in name:
            raise SceneError(
                f"data.parts.{name}: names of views begin with that of their part and _, so it may hold none"
            )
        for start, end in bounds:
            if not 0 <= start < end <= 1:
                raise SceneError(f"data.parts.{name}: [{start}, {end}] is no stretch of the record from 0 to 1")
            for i in np.nonzero((share >= start) & (share <= end))[0]:
                parts[i] = name
    centers = -np.einsum("fji,fj->fi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    angle = np.arctan2(centers[:, 0], -centers[:, 1])
    left = [i for i, part in enumerate(parts) if part == TRAIN]
    aside = sorted(left, key=lambda i: angle[i])[len(left) - round(views * len(left)) :]
    for i in aside:
        parts[i] = "views"
    left = [i for i in left if i not in set(aside)]
    for i in left[math.ceil(near / 2) :: near]:
        parts[i] = "near"
    if TRAIN not in parts or set(parts) == {TRAIN}:
        raise SceneError(
            f"data.parts leaves {parts.count(TRAIN)} of {len(parts)} frames to train on; give other shares"
        )
    return parts


def rules(parts: Mapping[str, object] | None) -> dict[str, object]:
    """``parts`` without those that are null, which a scene leaves out."""
    return {name: rule for name, rule in (parts or {}).items() if rule is not None}
