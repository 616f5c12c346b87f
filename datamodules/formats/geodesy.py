"""GPS positions as metres east, north and up of a place, and back (WGS 84)."""

from __future__ import annotations

import numpy as np

from heatsplat.datamodules.formats.colmap_library import pycolmap

_EARTH = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


def east_north_up(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Metres [n, 3] east, north and up of a place.

    Args:
        positions: [n, 3] latitude and longitude in degrees, altitude in metres.
        origin: [3] the place, likewise.
    """
    return _EARTH.ellipsoid_to_enu(np.asarray(positions, np.float64).reshape(-1, 3), *map(float, origin))


def latitude_longitude(metres: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """The inverse of ``east_north_up``: latitude, longitude and altitude [n, 3] of ``metres`` [n, 3]."""
    return _EARTH.enu_to_ellipsoid(np.asarray(metres, np.float64).reshape(-1, 3), *map(float, origin))
