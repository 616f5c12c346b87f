"""Places on the earth as metres east, north and up of one of them, and back (WGS 84)."""

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


def from_geocentric(metres: np.ndarray) -> np.ndarray:
    """Latitude, longitude and altitude [n, 3] of metres [n, 3] from the middle of the earth, whose axes turn with it."""
    return _EARTH.ecef_to_ellipsoid(np.asarray(metres, np.float64).reshape(-1, 3))


def east_north_up_axes(place: np.ndarray) -> np.ndarray:
    """Directions [3, 3] of east, north and up, one a row, in geocentric axes, at a latitude and longitude in degrees."""
    latitude, longitude = np.radians(np.asarray(place, np.float64)[:2])
    (sin, cos), (sin_l, cos_l) = (np.sin(latitude), np.cos(latitude)), (np.sin(longitude), np.cos(longitude))
    return np.array([[-sin_l, cos_l, 0.0], [-sin * cos_l, -sin * sin_l, cos], [cos * cos_l, cos * sin_l, sin]])


def from_utm(metres: np.ndarray, zone: int, north: bool) -> np.ndarray:
    """Latitude, longitude and altitude [n, 3] of eastings, northings and heights [n, 3] in a UTM zone, to a millimetre."""
    return _EARTH.utm_to_ellipsoid(np.asarray(metres, np.float64).reshape(-1, 3), zone, north)
