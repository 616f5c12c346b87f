"""Where the sun stands and how brightly it shines on a site. Only this file uses pvlib, and only when it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from heatsplat.contracts import SceneError

if TYPE_CHECKING:
    import pandas as pd

Axis = tuple[float, float, float]
# Sine of the sun's height from which its light tells clouds (10 degrees; below, haze and hills take as much), and the time over
# which it does: a cloud before the sun is not one before all of the sky.
CLOUDS_SINE, CLOUDS_S = 0.17, 3600.0
# Light that clouds of full cover take, and the power of the cover with which that falls (Kasten and Czeplak 1980).
FULL_COVER, COVER_POWER = 0.75, 3.4


@dataclass(frozen=True)
class Site:
    """A place on the earth and how the world's axes lie there.

    Args:
        latitude: degrees north of the equator.
        longitude: degrees east of Greenwich, from -180 to 360; kept as -180 to below 180.
        altitude_m: above the sea.
        up, north: directions in the world's axes, of any length; by default z is up, y north and so x east (ENU).
    """

    latitude: float
    longitude: float
    altitude_m: float = 0.0
    up: Axis = (0.0, 0.0, 1.0)
    north: Axis = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        if not (-90.0 <= self.latitude <= 90.0 and -180.0 <= self.longitude <= 360.0):
            raise SceneError(
                f"data.latitude={self.latitude} and data.longitude={self.longitude} (or those of meta.json) are no place "
                "on earth: degrees north (-90 to 90) and degrees east (-180 to 360) are needed"
            )
        if self.longitude >= 180.0:  # pvlib's map of turbidity ends there
            object.__setattr__(self, "longitude", self.longitude - 360.0)
        self.axes()

    def axes(self) -> np.ndarray:
        """East, north and up as rows [3, 3] of unit length, perpendicular to each other, in the world's axes."""
        up = np.array(self.up, dtype=np.float64)
        north = np.array(self.north, dtype=np.float64)
        if up.shape != (3,) or north.shape != (3,) or not np.linalg.norm(up) > 0:
            raise SceneError(f"data.up and data.north are three numbers each, got {self.up} and {self.north}")
        up = up / np.linalg.norm(up)
        level = north - (north @ up) * up
        if not np.linalg.norm(level) > 1e-6 * np.linalg.norm(north) > 0:
            raise SceneError(
                f"data.north={list(self.north)} points up (data.up={list(self.up)}); give a level direction"
            )
        north = level / np.linalg.norm(level)
        return np.stack([np.cross(north, up), north, up])


def sun_directions(site: Site, utc_s: np.ndarray) -> np.ndarray:
    """Unit vectors [T, 3] towards the sun in the world's axes, below the horizon too.

    **Convention:** ``utc_s`` [T] seconds since 1970 UTC; refraction is included while the sun is up.
    """
    position = _position(site, utc_s)
    height = np.radians(position["apparent_elevation"].to_numpy())
    azimuth = np.radians(position["azimuth"].to_numpy())  # clockwise from north
    level = np.cos(height)
    return np.stack([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(height)], axis=1) @ site.axes()


def clear_sky(site: Site, utc_s: np.ndarray) -> np.ndarray:
    """Global horizontal irradiance [T] in W/m² under a cloudless sky (Ineichen and Perez); exactly 0 by night."""
    from pvlib import atmosphere, clearsky, irradiance

    when, position = _moments(utc_s), _position(site, utc_s)
    zenith = position["apparent_zenith"]
    mass = atmosphere.get_absolute_airmass(
        atmosphere.get_relative_airmass(zenith), atmosphere.alt2pres(site.altitude_m)
    )
    turbidity = clearsky.lookup_linke_turbidity(when, site.latitude, site.longitude)
    extra = irradiance.get_extra_radiation(when)
    sky = clearsky.ineichen(zenith, mass, turbidity, altitude=site.altitude_m, dni_extra=extra)
    return np.where(zenith < 90.0, sky["ghi"].fillna(0.0), 0.0)


def split_irradiance(site: Site, utc_s: np.ndarray, global_w_m2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direct normal and diffuse horizontal irradiance [T] that make up a global horizontal one; exactly 0 by night.

    The diffuse share follows from the clearness of the sky (Erbs, Klein and Duffie 1982, in Driesse's smooth form).
    """
    from pvlib import irradiance

    position = _position(site, utc_s)
    zenith = position["apparent_zenith"].to_numpy()
    parts = irradiance.erbs_driesse(np.asarray(global_w_m2, dtype=np.float64), zenith, _moments(utc_s))
    day = zenith < 90.0
    return tuple(np.where(day, np.nan_to_num(np.asarray(parts[key])), 0.0).clip(0.0) for key in ("dni", "dhi"))


def clouds(site: Site, utc_s: np.ndarray, global_w_m2: np.ndarray) -> np.ndarray | None:
    """Share [T] of the clear sky's light that clouds take, in [0, 1]; None where the sun never stands high enough to tell.

    The hour about each moment counts, and by night what lies between dusk and dawn on a straight line (Crawford and Duchon 1999,
    Eq. 5).

    **Convention:** ``utc_s`` [T] seconds since 1970 UTC, increasing.
    """
    high = sun_directions(site, utc_s) @ site.axes()[2] > CLOUDS_SINE
    if not high.any():
        return None
    measured, clear = (_within_the_hour(utc_s, light) for light in (global_w_m2, clear_sky(site, utc_s)))
    share = 1.0 - measured[high] / clear[high]
    return np.interp(utc_s, utc_s[high], share.clip(0.0, 1.0))


def light_taken(cover: np.ndarray) -> np.ndarray:
    """Share of the clear sky's light that clouds of this cover take, of any shape (Kasten and Czeplak 1980)."""
    return FULL_COVER * cover**COVER_POWER


def cover_of(taken: np.ndarray) -> np.ndarray:
    """The cover that takes this share of the clear sky's light, of any shape; inverse of ``light_taken``."""
    return (taken / FULL_COVER) ** (1.0 / COVER_POWER)


def _within_the_hour(utc_s: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Integral [T] over the hour about each moment, as far as the record reaches."""
    so_far = np.concatenate([[0.0], np.cumsum(0.5 * (light[1:] + light[:-1]) * np.diff(utc_s))])
    before, after = (np.interp(utc_s + 0.5 * way * CLOUDS_S, utc_s, so_far) for way in (-1.0, 1.0))
    return after - before


def _moments(utc_s: np.ndarray) -> pd.DatetimeIndex:
    import pandas as pd

    return pd.to_datetime(np.asarray(utc_s, dtype=np.float64), unit="s", utc=True)


def _position(site: Site, utc_s: np.ndarray) -> Any:
    from pvlib import solarposition

    return solarposition.get_solarposition(_moments(utc_s), site.latitude, site.longitude, altitude=site.altitude_m)
