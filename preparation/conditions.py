"""What a user says of the conditions of a recording, in °C and per cent, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from heatsplat.contracts import SceneError, check_numbers
from heatsplat.physics.radiometry import LIMITS, Conditions
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.preparation.frame import ThermalFrame

# The name of a setting -> that of the condition, and how its value becomes one.
UNITS = {
    "emissivity": ("emissivity", 1.0, 0.0),
    "reflected_c": ("reflected_k", 1.0, KELVIN_AT_0_C),
    "distance_m": ("distance_m", 1.0, 0.0),
    "air_c": ("air_k", 1.0, KELVIN_AT_0_C),
    "humidity_percent": ("humidity", 0.01, 0.0),
    "window_transmission": ("window_transmission", 1.0, 0.0),
    "window_c": ("window_k", 1.0, KELVIN_AT_0_C),
}
HOT_C = 100.0  # above it a temperature of the surroundings was rather given in kelvin
# A setting that changes nothing while another one has this value.
NEEDS = {
    "reflected_c": ("emissivity", 1.0),
    "air_c": ("distance_m", 0.0),
    "humidity_percent": ("distance_m", 0.0),
    "window_c": ("window_transmission", 1.0),
}


@dataclass(frozen=True)
class GivenConditions:
    """Conditions that go before those of the files; None takes the file's.

    Args:
        emissivity, window_transmission: in (0, 1].
        reflected_c, air_c, window_c: temperatures in °C.
        distance_m: metres.
        humidity_percent: relative.
    """

    emissivity: float | None = None
    reflected_c: float | None = None
    distance_m: float | None = None
    air_c: float | None = None
    humidity_percent: float | None = None
    window_transmission: float | None = None
    window_c: float | None = None

    def __post_init__(self) -> None:
        for name, (condition, scale, offset) in UNITS.items():
            value, (low, high) = getattr(self, name), LIMITS[condition]
            if value is None:
                continue
            check_numbers(f"conditions.{name}", value, error=SceneError)
            if not low <= scale * value + offset <= high:
                least, most = (low - offset) / scale, (high - offset) / scale
                raise SceneError(f"conditions.{name}={value} must lie between {least:g} and {most:g}")

    def _given(self) -> dict[str, float]:
        return {
            condition: scale * value + offset
            for name, (condition, scale, offset) in UNITS.items()
            if (value := getattr(self, name)) is not None
        }

    def doubts(self) -> list[str]:
        """What can be and is hardly meant: temperatures that look like kelvin, a humidity that looks like a share."""
        temperatures = {name: getattr(self, name) for name in UNITS if name.endswith("_c")}
        found = [
            f"conditions.{name}={value:g} is in °C; if it was meant in kelvin, give {value - KELVIN_AT_0_C:.4g}."
            for name, value in temperatures.items()
            if value is not None and value > HOT_C
        ]
        if self.humidity_percent is not None and 0 < self.humidity_percent < 1:
            share = self.humidity_percent
            found.append(
                f"conditions.humidity_percent={share:g} is in per cent; if it was meant as a share, give {100 * share:g}."
            )
        return found

    def conditions(self, others: Conditions) -> Conditions:
        """These conditions, the rest from others."""
        return replace(others, **self._given())

    def check_use(self, frames: Sequence[ThermalFrame]) -> None:
        """Raises SceneError where something is given that changes nothing for any of the frames, which are settled."""
        given = [name for name in UNITS if getattr(self, name) is not None]
        warm = [frame.conditions for frame in frames if frame.calibration is not None]
        if given and not warm:
            raise SceneError(
                f"conditions.{given[0]} changes nothing for greys, which are no temperatures; give bounds_c=[min,max], too"
            )
        for name in given:
            needed, neutral = NEEDS.get(name, (None, None))
            if needed is not None and all(getattr(c, UNITS[needed][0]) == neutral for c in warm):
                raise SceneError(
                    f"conditions.{name}={getattr(self, name)} changes nothing while {needed} is {neutral:g}, which it is for "
                    f"all frames; give conditions.{needed}, too, or leave it out"
                )

    def settled(self, frame: ThermalFrame) -> ThermalFrame:
        """The frame under these conditions, the rest from its file."""
        given = self._given()
        conditions = self.conditions(frame.conditions)
        if frame.calibration is not None and not conditions.transmittance() > 0:
            raise SceneError(
                f"{frame.path}: at {conditions.distance_m:g} m of air with {100 * conditions.humidity:g} % humidity the "
                "formula of the air has no answer; set conditions.distance_m to what is in view, or 0 for no air"
            )
        return replace(frame, conditions=conditions, sources={**frame.sources, **dict.fromkeys(given, "given")})


@dataclass(frozen=True)
class InputUncertainty:
    """Standard uncertainties (one standard deviation), in the units of ``GivenConditions``; of the distance in per cent of it.

    Args:
        camera_c: of the apparent temperature, from the camera's data sheet.
    """

    emissivity: float = 0.02
    reflected_c: float = 5.0
    distance_percent: float = 10.0
    air_c: float = 3.0
    humidity_percent: float = 10.0
    window_transmission: float = 0.02
    window_c: float = 3.0
    camera_c: float = 1.0

    def __post_init__(self) -> None:
        for f in fields(self):
            check_numbers(f"uncertainty.{f.name}", getattr(self, f.name), error=SceneError)
            if not getattr(self, f.name) >= 0:
                raise SceneError(f"uncertainty.{f.name} must not be negative, got {getattr(self, f.name)}")

    def standard(self, conditions: Conditions) -> dict[str, float]:
        """In the units of the conditions. A window that is not there is not uncertain."""
        window = conditions.window_transmission < 1
        return {
            "emissivity": self.emissivity,
            "reflected_k": self.reflected_c,
            "distance_m": self.distance_percent / 100 * conditions.distance_m,
            "air_k": self.air_c,
            "humidity": self.humidity_percent / 100,
            "window_transmission": self.window_transmission if window else 0.0,
            "window_k": self.window_c if window else 0.0,
            "camera": self.camera_c,
        }
