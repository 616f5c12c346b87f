"""Smooth curves through values at even steps, against SciPy's cubics of the same slopes."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from heatsplat.physics.curves import cubic_rows, smooth_values

DOUBLE = torch.float64


def test_the_curve_is_the_cubic_hermite_spline_whose_slopes_are_those_between_neighbours():
    values = torch.randn(9, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    beyond = torch.cat([2 * values[:1] - values[1:2], values, 2 * values[-1:] - values[-2:-1]])
    slopes = (beyond[2:] - beyond[:-2]) / 2
    places = torch.linspace(0, 8, 101, dtype=DOUBLE)
    expected = CubicHermiteSpline(np.arange(9), values.numpy(), slopes.numpy())(places.numpy())
    torch.testing.assert_close(cubic_rows(places, 9) @ values, torch.from_numpy(expected), rtol=0, atol=1e-14)


@pytest.mark.parametrize("count", [2, 3, 17])
def test_it_goes_through_its_values_and_keeps_straight_lines(count):
    knots = torch.arange(count, dtype=DOUBLE)
    torch.testing.assert_close(cubic_rows(knots, count), torch.eye(count, dtype=DOUBLE), rtol=0, atol=1e-15)
    places = torch.linspace(0, count - 1, 50, dtype=DOUBLE)
    rows = cubic_rows(places, count)
    torch.testing.assert_close(rows.sum(1), torch.ones(50, dtype=DOUBLE), rtol=0, atol=1e-14)
    torch.testing.assert_close(rows @ (3 * knots - 1), 3 * places - 1, rtol=0, atol=1e-13)


def test_errors_fall_with_the_third_power_of_the_step():
    def error(count: int) -> float:
        at = torch.linspace(0, 1, 997, dtype=DOUBLE)
        inner = (at > 0.2) & (at < 0.8)  # beyond the ends the slope is only of the first order
        found = cubic_rows(at * (count - 1), count) @ torch.sin(9 * torch.linspace(0, 1, count, dtype=DOUBLE))
        return (found - torch.sin(9 * at))[inner].abs().max().item()

    assert error(17) / error(33) == pytest.approx(8, rel=0.1) and error(33) < 2e-3


def test_values_pass_near_heights_and_through_a_gap_as_the_curve_bends_on_both_sides():
    truth = lambda at: 1 - ((at - 15) / 15) ** 2  # noqa: E731
    places = torch.cat([torch.linspace(0, 10, 40, dtype=DOUBLE), torch.linspace(20, 30, 40, dtype=DOUBLE)])
    found = smooth_values(places, truth(places), 31, 1e-4)
    assert (found - truth(torch.arange(31, dtype=DOUBLE))).abs().max() < 0.01  # 0.56 at the top on a straight line


def test_few_places_are_enough():
    found = smooth_values(torch.tensor([0.0, 7.0], dtype=DOUBLE), torch.tensor([1.0, 2.0], dtype=DOUBLE), 8, 1e-4)
    torch.testing.assert_close(found, torch.linspace(1, 2, 8, dtype=DOUBLE), rtol=0, atol=1e-6)
