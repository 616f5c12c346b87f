"""Bodies that only follow the air, whose temperature there is in closed form."""

import numpy as np
import pytest

from heatsplat.kernels.heat_balance import AIR, Balance
from heatsplat.kernels.marching import march

RATES = np.array([1e-5, 1e-3, 0.1])
STARTS = np.array([-3.0, 0.0, 5.0])
TIMES = np.array([0.0, 600.0, 1800.0])
DRIVERS = np.zeros((12, 3))
DRIVERS[AIR] = 1.0 + 2e-3 * TIMES  # a straight line
MOMENTS = np.array([60.0, 600.0, 1234.5])
NO_BEAM = np.empty((3, 0)), np.zeros(3, dtype=np.int64)


def marched(sensitive: bool, rates=RATES) -> np.ndarray:
    """Temperatures [F, 3, 1] above the reference, with ``sensitive`` derivatives by the start and log r behind."""
    balance = Balance(*[False] * 10, sensitive)
    found = np.empty((len(MOMENTS), 3, 3 if sensitive else 1))
    parameters = np.stack([STARTS, np.log(rates)], axis=1)
    march(balance, 0, parameters, *NO_BEAM, np.arange(3), TIMES, DRIVERS, 288.0, 0.0, 0.0, MOMENTS, found)
    return found


def closed(rates=RATES) -> np.ndarray:
    """dx/dt = r (1 + b t - x) in closed form, [F, 3]."""
    settled = 1.0 + 2e-3 * (MOMENTS[:, None] - 1.0 / rates)
    return settled + (STARTS - (1.0 - 2e-3 / rates)) * np.exp(-rates * MOMENTS[:, None])


def test_temperatures_are_those_of_the_closed_form():
    np.testing.assert_allclose(marched(sensitive=False)[..., 0], closed(), rtol=1e-9, atol=1e-9)


def test_derivatives_come_with_the_same_temperatures():
    found, step = marched(sensitive=True), 1e-5
    assert found[..., :1].tobytes() == marched(sensitive=False).tobytes()
    np.testing.assert_allclose(found[..., 1], np.exp(-RATES * MOMENTS[:, None]), rtol=1e-7, atol=1e-15)
    by_rate = (closed(RATES * np.exp(step)) - closed(RATES * np.exp(-step))) / (2 * step)
    # What drives a derivative is taken for linear over a substep.
    assert found[..., 2] == pytest.approx(by_rate, abs=4e-3) and abs(by_rate).max() > 1.0
