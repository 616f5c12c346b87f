"""What people read of quantities and moments: words and units in place of names, dates in place of seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from heatsplat.contracts import SceneData

# From how many seconds on which unit is read best.
TIME_UNITS = ((3 * 86400.0, 86400.0, "d"), (3 * 3600.0, 3600.0, "h"), (300.0, 60.0, "min"), (-math.inf, 1.0, "s"))
TOLD_IMPOSSIBLE = 0.05  # share of a quantity beyond what is possible that people are told of
# What no surface can have less or more of.
POSSIBLE = {
    "absorptivity": (0.0, 1.0),
    "emissivity": (0.0, 1.0),
    "reflectance": (0.0, 1.0),
    "sky_reflectance": (0.0, 1.0),
    "convection": (0.0, math.inf),
    "convection_w_m2_k": (0.0, math.inf),
    "u_value_w_m2_k": (0.0, math.inf),
}
# Names of what the clocks of a record show at its second 0, and their zones; a camera's own is not known.
CLOCKS = {"utc_at_zero_s": "UTC", "clock_at_zero_s": ""}
YEARS_S = (-3.0e10, 2.53e11)  # seconds since 1970 of the years 1019 to 9987, which dates can have
SUFFIXES = {
    "_c_per_h": "°C/h",
    "_k_per_kw_m2": "K m²/kW",
    "_kj_m2_k": "kJ/(m² K)",
    "_j_m2_k_s05": "J/(m² K √s)",
    "_j_m3_k": "J/(m³ K)",
    "_j_m2_k": "J/(m² K)",
    "_w_m2_k": "W/(m² K)",
    "_w_m2": "W/m²",
    "_m_s": "m/s",
    "_ms": "ms",
    "_db": "dB",
    "_mb": "MB",
    "_h": "h",
    "_s": "s",
    "_m": "m",
    "_k": "K",
    "_c": "°C",
}
WRITTEN = {"u_value": "U-value"}  # names that are written otherwise than with spaces
# Names of ThermoGS, which do not end with their unit.
WITHOUT_SUFFIX = {"convection": ("convection", "W/(m² K)"), "capacity": ("heat capacity", "J/(m³ K)")}


def words_and_unit(name: str) -> tuple[str, str]:
    """Such as ("time constant", "s") of "time_constant_s"; the unit is empty where the name has none."""
    if name in WITHOUT_SUFFIX:
        return WITHOUT_SUFFIX[name]
    suffix = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")
    bare = name.removesuffix(suffix)
    return WRITTEN.get(bare, bare.replace("_", " ")), SUFFIXES.get(suffix, "")


def impossible(name: str, values: np.ndarray, weights: np.ndarray | None = None) -> str:
    """Such as "93 % above 1, which is impossible", where that is a twentieth of a quantity or more; else empty.

    Args:
        name: of the quantity, as of ``ThermalModel.attributes``.
        values: of any shape; NaN where there is none.
        weights: as many, how much each value counts; None has all count alike.
    """
    low, high = POSSIBLE.get(name, (-math.inf, math.inf))
    counted = np.isfinite(values) * (np.ones_like(values) if weights is None else weights)
    told = []
    for side, end, there in (("below", low, values < low), ("above", high, values > high)):
        share = counted[there].sum() / max(counted.sum(), 1e-300)
        if share >= TOLD_IMPOSSIBLE:
            told.append(f"{100 * share:.0f} % {side} {end:g}")
    return f"{' and '.join(told)}, which is impossible" if told else ""


def time_unit(span_s: float) -> tuple[float, str]:
    """Seconds in the unit that suits so many seconds, and its sign: s, min, h or d."""
    return next((unit_s, sign) for least, unit_s, sign in TIME_UNITS if span_s >= least)


@dataclass(frozen=True)
class Clock:
    """The clock of a record.

    Args:
        at_zero_s: what it shows at the record's second 0, in seconds since 1970.
        zone: "UTC", or empty for a camera's own clock, whose zone is not known.
    """

    at_zero_s: float
    zone: str = "UTC"

    def at(self, time_s: float, to: str = "minutes") -> str:
        """What it shows at a time of the record, such as "2024-08-07 09:12 UTC"; with ``to`` "seconds", to these."""
        shown = datetime.fromtimestamp(self.at_zero_s + time_s, UTC).replace(tzinfo=None)
        return f"{shown.isoformat(' ', to)} {self.zone}".rstrip()


def clock_of(scene: SceneData) -> Clock | None:
    """The clock of a scene's record (``SceneData.clock_at_zero_s``), in UTC where it is that of the weather; None where none is
    known."""
    known = scene.clock_at_zero_s
    return None if known is None else Clock(known, "" if scene.weather is None else "UTC")


def moment(time_s: float, clock: Clock | None = None) -> str:
    """A time of a record for people, such as "90.0 s", or "24.14 h (2024-08-07 09:12 UTC)" where its clock is known and shows a
    year of four digits."""
    unit_s, sign = time_unit(abs(time_s))
    told = f"{time_s / unit_s:.{1 if unit_s < 3600.0 else 2}f} {sign}"
    dated = clock is not None and YEARS_S[0] <= clock.at_zero_s + time_s < YEARS_S[1]
    return f"{told} ({clock.at(time_s)})" if dated else told
