"""Video whose contrast the camera stretched, taken for temperatures."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.doctor.base import MIN_FRAMES, MIN_POINTS, Check, Finding, Material
from heatsplat.doctor.checks.drift import frame_levels
from heatsplat.physics.noise import quantum_of

GAIN = 0.06  # spread of gains from frame to frame from which contrast is not fixed
ROUGH = 0.4  # leaps in spreads of the gains: 1.2 where they have no order in time, 0.13 to 0.16 where mist drifts
EXPLAINED = 0.5  # share of what levels leave that gains have to explain
ALIKE = 0.8  # correlation of what two halves of the points tell of the gains; a pane changes only what it mirrors
FULL, MOST = 0.012, 0.9  # how near black and white frames reach that the camera stretched, and the share of such frames
FINEST = 1.0 / 300.0  # of the range; steps of 8-bit greys are 1/255
REACH = 3  # pixels that have to: a dead one alone does not count


def find(material: Material) -> list[Finding]:
    if material.unit_k is None or len(material.images) < MIN_FRAMES:
        return []
    gains = _gains(material)
    stretched = _fills_the_range(material)
    if gains is None and not stretched:
        return []
    said = []
    if stretched:
        said.append("every frame reaches from black to white")
    if gains is not None:
        said.append(f"the contrast of the same points changes by {100 * gains:.0f} % from frame to frame")
    return [
        Finding(
            "agc",
            0.5 if gains is None else min(1.0, 2.0 * gains + 0.1),
            f"The images have temperature bounds, but {' and '.join(said)}: the camera adjusted them (AGC), and greys are no "
            "temperatures.",
            "Export radiometric files (16 bits, TIFF, R-JPEG) or switch AGC off; where the ends of each image are known, give "
            "each its own span (temperature_bounds.csv, or table= of prepare.py); of video that is all there is, take the "
            "bounds away and let method=auto simulate agc.",
        )
    ]


def _gains(material: Material) -> float | None:
    """Spread of the contrast of the same points from frame to frame where it explains what they change by; else None."""
    tracks = material.tracks
    if tracks is None or len(tracks.points) < MIN_POINTS:
        return None
    levels = frame_levels(tracks.values, tracks.weights)
    used = tracks.weights > 0
    known = torch.where(used, tracks.values - levels, torch.nan)
    points = known.nanmean(dim=1, keepdim=True)
    points = torch.where(used, points - torch.where(used, points, torch.nan).nanmean(dim=0), torch.nan)
    own = known - known.nanmean(dim=0)
    kept = used.sum(0) >= MIN_POINTS // 2
    kept[material.blank] = False
    own, points = own[:, kept], points[:, kept]
    times = None if material.chosen_times_s is None else material.chosen_times_s[kept]
    gain = _gain(own, points)
    left, after = (own - points).abs().nanmedian(), (own - gain * points).abs().nanmedian()
    if len(gain) < MIN_FRAMES or float(after) > (1.0 - EXPLAINED) * float(left):
        return None
    # A scene that cools loses contrast smoothly, and so does one that mist drifts through; a camera leaps.
    leaps = float(_leaps(gain, times).std()) / float(gain.mean().abs().clamp_min(1e-9))
    if leaps <= GAIN or leaps * float(gain.mean().abs()) <= ROUGH * float(gain.std()):
        return None
    share = (own - gain * points).abs().nanmean(1) / points.abs().nanmean(1).clamp_min(1e-12)
    upper = share > share.nanmedian()
    one, other = (_leaps(_gain(own[half], points[half]), times) for half in (upper, ~upper))
    return leaps if float(torch.corrcoef(torch.stack([one, other]))[0, 1]) > ALIKE else None


def _gain(own: Tensor, points: Tensor) -> Tensor:
    """Contrast [F] of each frame against that of all, from values and means [P, F] of points; NaN is unseen."""
    return (own * points).nansum(0) / points.square().nansum(0).clamp_min(1e-12)


def _leaps(gain: Tensor, times_s: Tensor | None) -> Tensor:
    """What a contrast has beyond the straight line between its neighbours in time; evenly spread without times."""
    if times_s is None:
        times_s = torch.arange(len(gain), dtype=gain.dtype)
    share = (times_s[1:-1] - times_s[:-2]) / (times_s[2:] - times_s[:-2]).clamp_min(1e-9)
    return gain[1:-1] - torch.lerp(gain[:-2], gain[2:], share)


def _fills_the_range(material: Material) -> bool:
    """Whether nearly all greys of 8 bits reach from black to white. What has bounds and finer steps was no picture: a scene
    whose warmest and coldest spots every frame shows fills the bounds that it was given after them."""
    if material.bounds_c is None or quantum_of(material.known(0)) < FINEST:
        return False
    full = 0
    for f in range(len(material.images)):
        known = material.known(f)
        if len(known) >= REACH:
            low, high = known.kthvalue(REACH).values, known.topk(REACH).values[-1]
            full += bool(low <= FULL) and bool(high >= 1 - FULL)
    return full >= MOST * len(material.images)


CHECK = Check("agc", "whether bounds are given to images whose contrast the camera changed", find)
