"""Bounds against pixels, and saturation."""

from __future__ import annotations

import torch

from heatsplat.doctor.base import Check, Finding, Material
from heatsplat.physics.units import CENTIKELVIN, KELVIN_AT_0_C, MAYBE_KELVIN, is_centikelvin

CLIPPED = 0.005  # share of pixels beyond the bounds
MIDDLE = (0.001, 0.999)  # quantiles: what lies beyond may be a few faulty pixels
NARROW = 0.15  # of the range that pixels use
EARTHLY_C = (-60.0, 650.0)  # what cameras measure without a special range
MAX_VALUES = 1 << 23  # torch takes no quantiles of twice as many
FULL_16_BIT = 65535
PLATEAU = 0.004  # share of an image's pixels at exactly its largest value
BOUNDS_IN = "data.bounds_c or temperature_bounds.json"  # where bounds stand, unless the scene says it
MIN_PLATEAU = 8  # pixels: one always is the largest, and in a small image it is a large share


def find(material: Material) -> list[Finding]:
    sampled, plateaus, at_bound = [], [], []
    for f in range(len(material.images)):
        known = material.known(f)
        sampled.append(known[::7].float())  # a slice would hold the whole image
        # What lies beyond bounds that heatsplat chose is a dead pixel or a hotter held-out image, and saturates nothing.
        known = known[known < 1] if material.bounds_chosen else known
        plateaus.append(_plateau(known))
        at_bound.append(bool(material.clipped) and len(known) > 0 and float(known.max()) >= 1)
    values = torch.cat(sampled)
    if not len(values):
        return []
    counts = _counts_as_greys(material, values)
    cut_off = _cut_off(material, values)
    # Narrower bounds would make other wrong temperatures of counts.
    found = _of_unit(material, values) + counts + (cut_off or ([] if counts else _unused(material, values)))
    flat = [f for f, share in enumerate(plateaus) if share > PLATEAU]
    if len(flat) > 0.1 * len(material.images) and not cut_off:
        share = sum(plateaus[f] for f in flat) / len(flat)
        cost, names = min(1.0, 3.0 * share), tuple(material.name(f) for f in flat)
        where = f"In {len(flat)} of {len(material.images)} frames {100 * share:.1f} % of the pixels"
        if material.bounds_c is not None and all(at_bound[f] for f in flat):
            what = f"{where} lie at or beyond the upper bound {material.bounds_c[1]:g} °C and are cut off."
            found.append(Finding("bounds", cost, what, _wider(material), names))
        else:
            remedy = "The detector or the export saturates: record in the high range, or mask what is hotter."
            found.append(Finding("saturation", cost, f"{where} have the largest value.", remedy, names))
    return found


def _wider(material: Material) -> str:
    return f"Give wider bounds ({material.bounds_in or BOUNDS_IN}), from the same export as the images."


def _cut_off(material: Material, values: torch.Tensor) -> list[Finding]:
    """Pixels beyond the bounds, where they are many."""
    if material.bounds_c is None:
        return []
    clipped = material.clipped
    if clipped is None:
        clipped = float(((values <= 0) | (values >= 1)).double().mean())
    if clipped <= CLIPPED:
        return []
    low, high = material.bounds_c
    what = f"{100 * clipped:.1f} % of the pixels lie at or beyond the bounds {low:g} .. {high:g} °C"
    remedy = _wider(material)
    if material.bounds_chosen:
        what += ", which heatsplat took from the training images without dead pixels,"
        remedy = (
            "Leave dead pixels out with masks/; where held-out images are hotter or colder, give bounds: data.bounds_c "
            "(data=colmap), temperature_bounds.json."
        )
    return [Finding("bounds", min(1.0, 3.0 * clipped), f"{what} and are cut off.", remedy)]


def _unused(material: Material, values: torch.Tensor) -> list[Finding]:
    """Bounds of which images use little."""
    if material.bounds_c is None:
        return []
    low, high = material.bounds_c
    least, most = _celsius(material, values)
    used = (most - least) / (high - low)
    if used >= NARROW:
        return []
    what = f"The images use {100 * used:.0f} % of the bounds {low:g} .. {high:g} °C."
    remedy = "Narrow the bounds to what the scene shows: losses and 8-bit greys spend the rest on nothing."
    if material.bounds_chosen:
        what = (
            f"99.8 % of the pixels lie within {least:.4g} .. {most:.4g} °C, {100 * used:.0f} % of the bounds {low:g} .. "
            f"{high:g} °C, which heatsplat took from the training images."
        )
        remedy = (
            "If what lies outside is a fault, leave it out with masks/, or give bounds: data.bounds_c (data=colmap), "
            "temperature_bounds.json. If it is what you look for, leave it."
        )
    return [Finding("bounds", 0.05, what, remedy)]


def _of_unit(material: Material, values: torch.Tensor) -> list[Finding]:
    """Temperatures that are rather kelvin or counts, by the bounds that were given to a scene, else by the pixels."""
    if material.unit_k is None:
        return []
    given = material.bounds_c is not None and not material.bounds_chosen
    low, high = material.bounds_c if given else _celsius(material, values)
    remedy = _unit_remedy(material)
    if MAYBE_KELVIN[0] <= low and high <= MAYBE_KELVIN[1]:
        kelvin = f"kelvin of {low - KELVIN_AT_0_C:.4g} .. {high - KELVIN_AT_0_C:.4g} °C"
        what = f"All pixels lie within {low:.4g} .. {high:.4g} °C, which may be {kelvin}."
        return [Finding("bounds", 0.9, what, remedy)]
    if not given and material.stored == "celsius" and 0.0 <= low < high <= 1.0:
        what = f"All pixels lie within {low:.3g} .. {high:.3g} °C, which may be shares of a range rather than temperatures."
        return [Finding("bounds", 0.9, what, _shares_remedy(material))]
    if not given:  # a cold sky or a flame may be in view, but no scene consists of them
        low = high = _celsius(material, values.median()[None])[0]
    if low < EARTHLY_C[0] or high > EARTHLY_C[1]:
        shown = f"{low:g} .. {high:g} °C" if low < high else f"{low:.4g} °C (median)"
        return [Finding("bounds", 0.9, f"The images are said to show {shown}.", remedy)]
    return []


def _celsius(material: Material, values: torch.Tensor) -> tuple[float, float]:
    """Least and largest temperature of values; where they have bounds, of the 99.8 % in the middle."""
    if material.bounds_c is None:
        return float(values.min()), float(values.max())
    low, high = material.bounds_c
    middle = _few(values).quantile(values.new_tensor(MIDDLE))
    return tuple(low + float(end) * (high - low) for end in middle)


def _few(values: torch.Tensor) -> torch.Tensor:
    """Evenly spread values, few enough for quantiles."""
    return values[:: 1 + len(values) // MAX_VALUES]


def _unit_remedy(material: Material) -> str:
    """What says of which unit the numbers of such files are."""
    posed = material.cameras is not None
    if material.stored == "counts" and posed:
        return "Check the unit: °C = data.raw_scale * count + data.raw_offset_c."
    if material.stored == "celsius" and posed:
        return (
            "Floats are taken for °C. If they are kelvin, make °C of them: python src/prepare.py source=IMAGES target=FOLDER "
            "counts.offset_c=-273.15 poses=given poses.model=SCENE (with counts.scale, too, if they are counts)."
        )
    if material.stored == "radiometric":
        return "Check the constants of the files: python src/prepare.py takes others as counts.planck=[R1,B,F,O,R2]."
    if material.stored in ("celsius", "counts"):
        return "Check the unit: °C = counts.scale * number + counts.offset_c (-273.15 for kelvin)."
    bounds = material.bounds_in or (BOUNDS_IN if posed else "bounds_c or temperature_bounds.json")
    return f"Check the unit of the bounds ({bounds}): they are the °C of black and white."


def _shares_remedy(material: Material) -> str:
    """What makes temperatures of floats from 0 to 1."""
    command = "counts.scale=SPAN counts.offset_c=MIN"
    if material.cameras is not None:
        command = f"python src/prepare.py source=IMAGES target=FOLDER {command} poses=given poses.model=SCENE"
    return f"If they are: {command}, of the range that 0 and 1 stand for in °C."


def _counts_as_greys(material: Material, values: torch.Tensor) -> list[Finding]:
    """Greys of 16 bits, without temperatures or linear between given bounds, that are rather kelvin x 100."""
    if material.stored != "grey16":
        return []
    ends = values.double().new_tensor([MIDDLE[0], 0.01, 0.5, 0.99, MIDDLE[1]])
    least, low, median, high, most = (FULL_16_BIT * _few(values).double().quantile(ends)).tolist()
    if most - least >= NARROW * FULL_16_BIT or not is_centikelvin(low, median, high):
        return []
    low_c, high_c = (CENTIKELVIN * end - KELVIN_AT_0_C for end in (least, most))
    now = "are no temperatures so far"
    if material.bounds_c is not None:
        black, white = material.bounds_c
        if high_c <= black or low_c >= white:  # bounds of other temperatures were not made for such counts
            return []
        between = [black + end / FULL_16_BIT * (white - black) for end in (least, most)]
        now = f"are taken for {between[0]:.4g} .. {between[1]:.4g} °C, linear between the bounds {black:g} .. {white:g} °C"
    return [
        Finding(
            "bounds",
            0.9,
            f"Greys of 16 bits use {100 * (most - least) / FULL_16_BIT:.1f} % of their range ({least:.0f} .. {most:.0f}) and "
            f"{now}; as kelvin x 100 they would be {low_c:.4g} .. {high_c:.4g} °C.",
            "If they are: data.raw=images data.raw_scale=0.01 with data=colmap (data.raw is the folder of the images), else "
            "python src/prepare.py source=IMAGES target=FOLDER poses=given poses.model=SCENE.",
        )
    ]


def _plateau(values: torch.Tensor) -> float:
    """Share of the pixels that have the largest value; 0 where so few do that chance explains it, or all are the same."""
    count = int((values == values.max()).sum()) if len(values) and values.min() < values.max() else 0
    return count / len(values) if count >= MIN_PLATEAU else 0.0


CHECK = Check("bounds", "whether pixels fit their bounds, and whether images saturate", find)
