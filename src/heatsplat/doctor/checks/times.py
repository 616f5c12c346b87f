"""Times of frames: their order, gaps and repeats."""

from __future__ import annotations

from itertools import pairwise
from pathlib import PurePosixPath

import torch

from heatsplat.doctor.base import Check, Finding, Material, some
from heatsplat.io.files import by_numbers

GAP = 12.0  # times the usual step; recordings by hand have steps up to 6 times it


def find(material: Material) -> list[Finding]:
    if material.times_s is None or len(material.times_s) < 5:
        return []
    times = torch.tensor([float(t) for t in material.times_s], dtype=torch.float64)
    found = []
    # Each camera, told by its lens or by its folder, has names of its own.
    own: dict[object, list[int]] = {}
    for i, name in enumerate(material.names):
        own.setdefault((material.lenses[i] if material.lenses else 0, PurePosixPath(name).parent), []).append(i)
    by_name = [sorted(frames, key=lambda i: by_numbers(material.names[i])) for frames in own.values()]
    back = [
        material.names[after]
        for frames in by_name
        for before, after in pairwise(frames)
        if times[after] < times[before]
    ]
    if 0 < len(back) < 0.2 * len(times):
        found.append(
            Finding(
                "times",
                0.1,
                f"Times run backwards at {some(back)} while names go on.",
                "Check the camera's clock: it was set, or changed its zone, during the recording.",
                tuple(back),
            )
        )
    steps = times.sort().values.diff()
    # Cameras may be triggered together.
    same = sum(int((times[frames].sort().values.diff() == 0).sum()) for frames in own.values())
    if same > 0.05 * len(steps):
        found.append(
            Finding(
                "times",
                0.02,
                f"{same} frames have the time of another one.",
                "Give times with fractions of a second (data=colmap and nerfstudio take data.time_csv); methods of time cannot "
                "tell these apart.",
            )
        )
    usual = float(steps[steps > 0].median()) if (steps > 0).any() else 0.0
    gaps = [i for i, step in enumerate(steps.tolist()) if usual and step > GAP * usual]
    if gaps:
        at = times.argsort()
        longest = max(gaps, key=lambda i: float(steps[i]))
        found.append(
            Finding(
                "times",
                0.03,
                f"{len(gaps)} gap(s) in the record; the longest, of {_spoken(float(steps[longest]))} (usual: {_spoken(usual)}), "
                f"comes before {material.names[int(at[longest + 1])]}.",
                "What happened within a gap is a guess; check that no frames were lost.",
                tuple(material.names[int(at[i + 1])] for i in gaps),
            )
        )
    return found


def _spoken(seconds: float) -> str:
    """A length of time in the unit that people would take."""
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


CHECK = Check("times", "order of times against names, repeats and gaps", find)
