"""Kelvin and degrees Celsius."""

import torch

from heatsplat.contracts import KELVIN_AT_0_C
from heatsplat.physics import units


def test_zero_celsius_and_back():
    assert units.kelvin(0.0) == 273.15 == units.KELVIN_AT_0_C == KELVIN_AT_0_C
    temperatures = torch.tensor([-40.0, 0.0, 36.6], dtype=torch.float64)
    torch.testing.assert_close(units.celsius(units.kelvin(temperatures)), temperatures)
