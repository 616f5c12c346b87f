"""Bounds against pixels, and saturation."""

from __future__ import annotations

import torch

from heatsplat.doctor.base import Check, Finding, Material
from heatsplat.physics.units import KELVIN_AT_0_C

CLIPPED = 0.005  # share of pixels beyond the bounds
NARROW = 0.15  # of the range that pixels use
EARTHLY_C = (-60.0, 650.0)  # what cameras measure without a special range
KELVIN_C = (200.0, 400.0)  # "°C" between which a whole scene is rather one of -73 .. 127 °C in kelvin
PLATEAU = 0.004  # share of an image's pixels at exactly its largest value
MIN_PLATEAU = 8  # pixels: one always is the largest, and in a small image it is a large share


def find(material: Material) -> list[Finding]:
    found = []
    sampled, plateaus = [], []
    for f in range(len(material.images)):
        known = material.known(f)
        sampled.append(known[::7].float())  # a slice would hold the whole image
        plateaus.append(_plateau(known))
    values = torch.cat(sampled)
    if not len(values):
        return []
    found += _of_unit(material, values)
    if material.bounds_c is not None:
        low, high = material.bounds_c
        clipped = material.clipped
        if clipped is None:
            clipped = float(((values <= 0) | (values >= 1)).double().mean())
        if clipped > CLIPPED:
            found.append(
                Finding(
                    "bounds",
                    min(1.0, 3.0 * clipped),
                    f"{100 * clipped:.1f} % of the pixels lie at or beyond the bounds {low:g} .. {high:g} °C and are cut off.",
                    "Give wider bounds (data.bounds_c, temperature_bounds.json), from the same export as the images.",
                )
            )
        ends = values.new_tensor([0.001, 0.999])
        used = float(values.quantile(ends).diff()) if len(values) < 1 << 24 else 1.0
        if used < NARROW:
            found.append(
                Finding(
                    "bounds",
                    0.05,
                    f"The images use {100 * used:.0f} % of the bounds {low:g} .. {high:g} °C.",
                    "Narrow the bounds to what the scene shows: losses and 8-bit greys spend the rest on nothing.",
                )
            )
    flat = [f for f, share in enumerate(plateaus) if share > PLATEAU]
    if len(flat) > 0.1 * len(material.images) and not any(
        one.check == "bounds" and "cut off" in one.what for one in found
    ):
        share = sum(plateaus[f] for f in flat) / len(flat)
        found.append(
            Finding(
                "saturation",
                min(1.0, 3.0 * share),
                f"In {len(flat)} of {len(material.images)} frames {100 * share:.1f} % of the pixels have the largest value.",
                "The detector or the export saturates: record in the high range, or mask what is hotter.",
                tuple(material.name(f) for f in flat),
            )
        )
    return found


def _of_unit(material: Material, values: torch.Tensor) -> list[Finding]:
    """Temperatures that are rather kelvin or counts, by the bounds of a scene, else by the pixels of a camera's files."""
    if material.unit_k is None:
        return []
    low, high = material.bounds_c or (float(values.min()), float(values.max()))
    remedy = (
        "Check the unit (°C, kelvin, counts): counts.scale and counts.offset_c of a camera's files, or data.raw_scale and "
        "data.raw_offset_c."
    )
    if KELVIN_C[0] <= low and high <= KELVIN_C[1]:
        kelvin = f"kelvin of {low - KELVIN_AT_0_C:.4g} .. {high - KELVIN_AT_0_C:.4g} °C"
        what = f"All pixels lie within {low:.4g} .. {high:.4g} °C, which may be {kelvin}."
        return [Finding("bounds", 0.9, what, remedy)]
    if material.bounds_c is None:  # a cold sky or a flame may be in view, but no scene consists of them
        low, high = float(values.median()), float(values.median())
    if low < EARTHLY_C[0] or high > EARTHLY_C[1]:
        shown = f"{low:g} .. {high:g} °C" if low < high else f"{low:.4g} °C (median)"
        return [Finding("bounds", 0.9, f"The images are said to show {shown}.", remedy)]
    return []


def _plateau(values: torch.Tensor) -> float:
    """Share of the pixels that have the largest value; 0 where so few do that chance explains it, or all are the same."""
    count = int((values == values.max()).sum()) if len(values) and values.min() < values.max() else 0
    return count / len(values) if count >= MIN_PLATEAU else 0.0


CHECK = Check("bounds", "whether pixels fit their bounds, and whether images saturate", find)
