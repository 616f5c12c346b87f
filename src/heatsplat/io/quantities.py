"""What people read in place of the name of a quantity: words and a unit."""

from __future__ import annotations

IN_HOURS_S = 3 * 3600.0
SUFFIXES = {
    "_c_per_h": "°C/h",
    "_k_per_kw_m2": "K m²/kW",
    "_kj_m2_k": "kJ/(m² K)",
    "_j_m2_k_s05": "J/(m² K √s)",
    "_w_m2_k": "W/(m² K)",
    "_w_m2": "W/m²",
    "_h": "h",
    "_s": "s",
    "_k": "K",
    "_c": "°C",
}


def words_and_unit(name: str) -> tuple[str, str]:
    """Such as ("time constant", "s") of "time_constant_s"; the unit is empty where the name has none."""
    suffix = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")
    return name.removesuffix(suffix).replace("_", " "), SUFFIXES.get(suffix, "")


def moment(time_s: float) -> str:
    """A time of a record for people: seconds, or hours where there are many."""
    return f"{time_s:.1f} s" if abs(time_s) < IN_HOURS_S else f"{time_s / 3600.0:.2f} h"
