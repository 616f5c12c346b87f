"""Photos and thermal images: whether they belong together, lie on each other, and share a clock."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.doctor.base import MIN_FRAMES, Check, Finding, Material, coarse
from heatsplat.effects.observations import standardised

BETTER = 0.03  # correlation by which another frame has to fit better than a frame's own
NEARLY_ALL = 0.7
MATCH = 0.3  # correlation of the photo that fits best from which it is one of the same moment
OFF = 0.025  # of the width: how far photos may lie beside thermal images
LEAST_REACH = 3  # coarse pixels to either side in which photos are looked for
# Seconds, and share of the usual step between frames, by which clocks may differ; EXIF often has whole seconds.
CLOCK_S, WHOLE_S, CLOCK_STEP = 0.2, 1.0, 0.1


def find(material: Material) -> list[Finding]:
    found = []
    clocks = _clock(material)
    if clocks is not None:
        found.append(clocks)
    if material.photos is None or len(material.photos) < MIN_FRAMES:
        return found
    heat = torch.stack([_edges(coarse(material.image(f))) for f in range(len(material.images))])
    light = torch.stack([_edges(photo) for photo in material.photos])
    if heat.shape != light.shape:
        return found
    # A closed shutter or a black photo says nothing.
    shows = (heat.flatten(1).std(1) > 0) & (light.flatten(1).std(1) > 0)
    heat, light = heat[shows], light[shows]
    if len(heat) < MIN_FRAMES:
        return found
    fits = torch.einsum("fp,gp->fg", standardised(heat.flatten(1)), standardised(light.flatten(1)))
    count = len(fits)
    own = fits.diagonal()
    best = float(fits.max(1).values.median())
    steps = {k: _gain(fits, k, best) for k in (-3, -2, -1, 1, 2, 3) if abs(k) < count - 2}
    step, gain = max(steps.items(), key=lambda item: item[1])
    strangers = float(fits[~torch.eye(count, dtype=torch.bool)].median())
    if gain > BETTER:
        late = _late(material, step)
        found.append(
            Finding(
                "pairing",
                0.6,
                f"Thermal images fit the photo {abs(step)} frame(s) {'later' if step > 0 else 'earlier'} better than their "
                f"own{late}.",
                "Pair them anew: shift one list, or correct the clock of one camera.",
            )
        )
    elif float(own.median()) < strangers + BETTER and best > max(MATCH, float(own.median()) + MATCH / 3):
        found.append(
            Finding(
                "pairing",
                0.5,
                "Photos do not fit their thermal images better than those of other frames.",
                "Check that both folders list the same moments under the same names.",
            )
        )
    else:
        shift = _shift(heat, light)
        if shift is not None and shift.norm() > OFF * heat.shape[2]:
            x, y = (shift * material.images.shape[2] / heat.shape[2]).tolist()
            found.append(
                Finding(
                    "pairing",
                    0.3,
                    f"Photos lie beside their thermal images, by about ({x:.0f}, {y:.0f}) pixels (right, down).",
                    "Rectify them onto the thermal camera first: data.rgb are images of the same camera.",
                )
            )
    return found


def _gain(fits: Tensor, step: int, best: float) -> float:
    """By how much photos ``step`` frames later fit better than their own; 0 where they are not the ones that fit best."""
    other, own = fits.diagonal(step), fits.diagonal()
    own = own[: len(other)] if step > 0 else own[-len(other) :]
    if float((other > own).double().mean()) < NEARLY_ALL or float(other.median()) < best - BETTER:
        return 0.0
    return float(other.median() - own.median())


def _clock(material: Material) -> Finding | None:
    if material.rgb_times_s is None or material.times_s is None:
        return None
    apart = torch.tensor(material.rgb_times_s, dtype=torch.float64) - torch.tensor(
        material.times_s, dtype=torch.float64
    )
    usual = float(torch.tensor(sorted(material.times_s), dtype=torch.float64).diff().median())
    offset = float(apart.median())
    whole = not any(time % 1.0 for time in (*material.times_s, *material.rgb_times_s))
    if abs(offset) <= max(CLOCK_STEP * usual, WHOLE_S if whole else CLOCK_S):
        return None
    return Finding(
        "pairing",
        0.1,
        f"The clock of the visible camera is {offset:+.1f} s against that of the thermal one.",
        "Set both clocks, or trust the order of the files; times come from the thermal files.",
    )


def _late(material: Material, step: int) -> str:
    if material.times_s is None or len(material.chosen) != len(material.names):
        return ""
    usual = float(torch.tensor(sorted(material.times_s), dtype=torch.float64).diff().median())
    return f" (about {abs(step) * usual:.3g} s)"


def _edges(image: Tensor) -> Tensor:
    """Strength of edges of a coarse image [H, W], compressed so that no single one rules."""
    x = functional.pad(image.diff(dim=1), (0, 1))
    y = functional.pad(image.diff(dim=0), (0, 0, 0, 1))
    strength = torch.hypot(x, y)
    strength = strength / (strength + strength.mean()).clamp_min(1e-30)
    return functional.avg_pool2d(strength[None, None], 3, stride=1, padding=1)[0, 0]


def _shift(heat: Tensor, light: Tensor) -> Tensor | None:
    """By how much photos lie beside thermal images, on the coarse grid [2] (right, down); None where edges do not tell."""
    a = torch.fft.rfft2(heat - heat.mean((1, 2), keepdim=True))
    b = torch.fft.rfft2(light - light.mean((1, 2), keepdim=True))
    height, width = heat.shape[1:]
    if min(height, width) <= 2 * LEAST_REACH:
        return None
    fits = torch.fft.irfft2(a.conj() * b, s=(height, width)).sum(0)
    fits = fits / (heat.std() * light.std() * heat.numel())
    reach = max(LEAST_REACH, width // 6)
    fits = torch.roll(fits, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    best = int(fits.argmax())
    if float(fits.max()) < 0.25 or float(fits.max()) < float(fits[reach, reach]) + 2 * BETTER:
        return None
    return torch.tensor([best % fits.shape[1] - reach, best // fits.shape[1] - reach], dtype=torch.float64)


CHECK = Check("pairing", "whether photos and thermal images belong together, lie on each other and share a clock", find)
