"""East, north and up of a place, against the radii of the ellipsoid."""

import numpy as np

from heatsplat.datamodules.formats.geodesy import east_north_up, latitude_longitude

PLACE = np.array([51.4, 4.43, 75.0])


def test_a_thousandth_of_a_degree_is_as_long_as_the_ellipsoid_says():
    a, e2 = 6378137.0, 0.00669437999014
    sine = np.sin(np.radians(PLACE[0]))
    across = (a / np.sqrt(1 - e2 * sine**2) + 75) * np.cos(np.radians(PLACE[0])) * np.radians(1e-3)
    along = (a * (1 - e2) / (1 - e2 * sine**2) ** 1.5 + 75) * np.radians(1e-3)
    metres = east_north_up(PLACE + np.array([[0, 1e-3, 0], [1e-3, 0, 0], [0, 0, 10.0]]), PLACE)
    np.testing.assert_allclose(metres, [[across, 0, 0], [0, along, 0], [0, 0, 10]], atol=2e-3)


def test_there_and_back():
    metres = np.array([[120.0, -35.0, 8.0], [-4.0, 900.0, -2.0]])
    np.testing.assert_allclose(east_north_up(latitude_longitude(metres, PLACE), PLACE), metres, atol=1e-6)
