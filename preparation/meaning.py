"""What the numbers of images without a camera's calibration mean, and when it is better to ask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError, check_numbers
from heatsplat.datamodules.bounds import BOUNDS_FILE, BOUNDS_TABLE, range_in, read_bounds
from heatsplat.datamodules.formats.dji import PER_KELVIN
from heatsplat.datamodules.formats.radiometric import Calibration, other_unit
from heatsplat.physics.planck import Band
from heatsplat.physics.radiometry import BandResponse, PlanckResponse
from heatsplat.physics.units import CENTIKELVIN, KELVIN_AT_0_C, MAYBE_KELVIN, USUAL_MEDIAN_C, is_centikelvin

# °C per count of other cameras that store kelvin; nothing in a file tells them apart, so they are named and asked for.
OTHERS = {
    "DJI's 1/64 K": 1.0 / PER_KELVIN,
    "0.04 K of FLIR's Vue, Duo and Tau": 0.04,
    "0.1 K of a Lepton in low gain": 0.1,
    "0.4 K of FLIR's low gain": 0.4,
}
# By kind of files, which settings say what their numbers mean; a camera's own calibration goes before scale and bounds.
SETTINGS = {
    "radiometric": ("counts.planck",),
    "counts": ("counts.scale", "counts.offset_c", "counts.planck"),
    "float": ("counts.scale", "counts.offset_c"),
    "grey": ("bounds_c",),
}


@dataclass(frozen=True)
class Meaning:
    """What a user says of the numbers; None leaves it to the files.

    Args:
        scale, offset_c: °C = scale * number + offset_c.
        planck: R1, B, F, O and R2 of a FLIR calibration.
        bounds_c: °C of black and white of greys.
        band_um: wavelengths in which the camera sees.
    """

    scale: float | None = None
    offset_c: float | None = None
    planck: Sequence[float] | None = None
    bounds_c: Sequence[float] | None = None
    band_um: Sequence[float] = (7.5, 14.0)

    def __post_init__(self) -> None:
        for name, value, count in (
            ("counts.planck=[R1,B,F,O,R2]", self.planck, 5),
            ("counts.scale", self.scale, None),
            ("counts.offset_c", self.offset_c, None),
            ("bounds_c=[min,max]", self.bounds_c, 2),
            ("band_um", self.band_um, 2),
        ):
            if value is not None:
                check_numbers(name, value, count, SceneError)
        if self.scale is not None and not self.scale > 0:
            raise SceneError(f"counts.scale must be positive (°C per count), got {self.scale}")
        if not 0 < self.band_um[0] < self.band_um[1]:
            raise SceneError(f"band_um needs two rising wavelengths in µm, got {list(self.band_um)}")

    def check_use(self, kind: str, what: str) -> None:
        """Raises SceneError where something is said that files of this kind, ``what``, have no use for."""
        said = {f"counts.{name}": getattr(self, name) for name in ("scale", "offset_c", "planck")} | {
            "bounds_c": self.bounds_c
        }
        used = SETTINGS[kind]
        if idle := [name for name, value in said.items() if value is not None and name not in used]:
            raise SceneError(
                f"{idle[0]} changes nothing for {what}; what their numbers mean is said by {' or '.join(used)}, or by the files"
            )
        if kind == "counts" and self.offset_c is not None and self.scale is None:
            raise SceneError("counts.offset_c is the °C of count 0 and needs counts.scale, the °C per count, beside it")

    @property
    def response(self) -> BandResponse:
        """Of a camera that sees the band."""
        return BandResponse(Band(*self.band_um, nodes=16))

    def of_temperatures(self, scale: float, offset_c: float) -> Calibration:
        """The calibration of files that hold apparent temperatures."""
        return Calibration(self.response, scale, offset_c)

    def of_counts(self, sample: np.ndarray, path: Path) -> tuple[Calibration, str]:
        """The calibration of 16-bit images, judged from one of them, and a sentence about it.

        Raises:
            SceneError: nothing was said, and they do not look like kelvin x 100.
        """
        if self.planck is not None:
            return Calibration(
                PlanckResponse(*(float(x) for x in self.planck))
            ), "counts, by the constants of counts.planck"
        if self.scale is not None:
            offset = -KELVIN_AT_0_C if self.offset_c is None else self.offset_c
            low, high = self.scale * np.percentile(sample, (1, 99)) + offset
            return (
                self.of_temperatures(self.scale, offset),
                f"counts: °C = {self.scale:g} * count {offset:+g}, for {path.name} {low:.1f} .. {high:.1f} °C",
            )
        percentiles = np.percentile(sample, (1, 50, 99))
        if is_centikelvin(*percentiles):
            low, _, high = CENTIKELVIN * percentiles - KELVIN_AT_0_C
            return (
                self.of_temperatures(CENTIKELVIN, -KELVIN_AT_0_C),
                f"counts taken for kelvin x 100, for {path.name} then has {low:.1f} .. {high:.1f} °C; "
                "counts.scale and counts.offset_c say otherwise",
            )
        middle = float(np.median(sample))
        would = {name: (scale, scale * middle - KELVIN_AT_0_C) for name, scale in OTHERS.items()}
        hints = [
            f" As {name} they would be {celsius:.1f} °C (counts.scale={scale:g})."
            for name, (scale, celsius) in would.items()
            if USUAL_MEDIAN_C[0] < celsius < USUAL_MEDIAN_C[1]
        ]
        raise SceneError(
            f"{path} holds 16-bit counts around {middle:.0f}, which are no kelvin x 100. Say what they mean: "
            "counts.scale and counts.offset_c (°C = scale * count + offset), or counts.planck=[R1,B,F,O,R2] of the camera."
            + "".join(hints)
        )

    def of_floats(self, sample: np.ndarray, path: Path) -> tuple[Calibration, str]:
        """The calibration of floating-point images and a sentence about it.

        Raises:
            SceneError: nothing was said, and they may be kelvin, or the file says that they are, or °F.
        """
        if self.scale is not None or self.offset_c is not None:
            scale = 1.0 if self.scale is None else self.scale
            # A scale alone is one of kelvin, as of counts.
            offset = -KELVIN_AT_0_C if self.offset_c is None else self.offset_c
            return self.of_temperatures(scale, offset), f"floats: °C = {scale:g} * value {offset:+g}"
        if other := other_unit(sample, path):
            raise SceneError(
                f"{path} says that its numbers are {other[0]}: give {other[1]}, or counts.offset_c=0 where they are °C all the "
                "same"
            )
        finite = sample[np.isfinite(sample)]
        if finite.size and MAYBE_KELVIN[0] < np.median(finite) < MAYBE_KELVIN[1]:
            raise SceneError(
                f"{path} holds floats around {np.median(finite):.1f}: kelvin, or a furnace in °C? Say counts.offset_c=-273.15 "
                "for kelvin, counts.offset_c=0 for °C"
            )
        return self.of_temperatures(1.0, 0.0), "floating-point °C"

    def says_counts(self, sample: np.ndarray) -> bool:
        """Whether it is known what 16-bit numbers mean, as it is said, or they look like kelvin x 100."""
        told = self.scale is not None or self.planck is not None
        return told or is_centikelvin(*np.percentile(sample, (1, 50, 99)))

    def of_greys(self, folder: Path) -> tuple[Calibration | None, str]:
        """The calibration of 8-bit greys, None where no bounds are known, and a sentence about it."""
        found = None
        if self.bounds_c is not None:
            found, source = range_in("bounds_c", *self.bounds_c)[0], "bounds_c"
        elif files := [file for place in (folder, folder.parent) if (file := place / BOUNDS_FILE).is_file()]:
            found, source = read_bounds(files[0])[0], str(files[0])
        if found is None:
            by = "bounds_c=[min,max]"
            if (table := folder / BOUNDS_TABLE).is_file():
                by = f"table={table}, with the span of each image,"
            return None, f"greys without bounds: no temperatures ({by} would give them)"
        return (
            self.of_temperatures(found.span_k / 255.0, found.min_c),
            f"8-bit greys, {found.min_c:g} .. {found.max_c:g} °C by {source}",
        )
