"""Which frames of a recording one thermal camera took with one lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from heatsplat.preparation.frame import ThermalFrame

FOCUS = 0.05  # by which the focal length that files say changes with the focus of one lens


@dataclass(frozen=True)
class Device:
    """One thermal camera with one lens; lens, dead pixels and the meaning of counts are its own.

    Args:
        frames: that it took, at least one, in the order of the recording.
        like: the frame that says most of the camera.
    """

    frames: list[ThermalFrame]
    like: ThermalFrame

    @property
    def label(self) -> str:
        """Make, model, serial number, size and focal length, as far as the files say them."""
        about = self.like.camera
        size = None if self.like.size is None else "{}x{} pixels".format(*self.like.size)
        lens = f"{about.field_of_view_deg:.3g}° wide" if about.field_of_view_deg else None
        if lens is None and about.focal_mm:
            lens = f"focal length {about.focal_mm:.3g} mm"
        name = " ".join(filter(None, (about.make, about.model, about.serial))) or "unknown camera"
        return ", ".join(filter(None, (name, size, lens)))


def devices_of(frames: Sequence[ThermalFrame]) -> list[Device]:
    """The cameras that took the frames, in the order of their first ones.

    Frames are of one camera where nothing that both say of it differs: make, model, serial number, image size, and focal
    length or field of view to 5 %. A frame that says little belongs to the first camera that it does not contradict.
    """
    found: list[tuple[ThermalFrame, list[int]]] = []
    for i in sorted(range(len(frames)), key=lambda i: -_said(frames[i])):
        members = next((members for like, members in found if _agree(like, frames[i])), None)
        if members is None:
            found.append((frames[i], [i]))
        else:
            members.append(i)
    found = sorted(((like, sorted(members)) for like, members in found), key=lambda one: one[1][0])
    return [Device([frames[i] for i in members], like) for like, members in found]


def listed(devices: Sequence[Device]) -> str:
    """Several cameras in words: what each is, how many frames it took, and one of them."""
    return "; ".join(f"{d.label} ({len(d.frames)}, such as {d.frames[0].name})" for d in devices)


def _facts(frame: ThermalFrame) -> tuple[list[object], list[float | None]]:
    """What a frame says of its camera: what has to be equal, and what may differ by a little."""
    about = frame.camera
    return [about.make, about.model, about.serial, frame.size], [about.field_of_view_deg, about.focal_mm]


def _said(frame: ThermalFrame) -> int:
    return sum(fact is not None for facts in _facts(frame) for fact in facts)


def _agree(one: ThermalFrame, other: ThermalFrame) -> bool:
    (equal, close), (others_equal, others_close) = _facts(one), _facts(other)
    same = all(a is None or b is None or a == b for a, b in zip(equal, others_equal, strict=True))
    near = (math.isclose(a, b, rel_tol=FOCUS) for a, b in zip(close, others_close, strict=True) if a and b)
    return same and all(near)
