"""Kelvin and degrees Celsius, and constants that are written down once."""

import re
from pathlib import Path

import numpy as np
import torch

from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.kernels import spherical_harmonics as kernel
from heatsplat.physics import units

ROOT = Path(__file__).resolve().parents[2]


def test_zero_celsius_and_back():
    assert units.kelvin(0.0) == 273.15 == units.KELVIN_AT_0_C
    temperatures = torch.tensor([-40.0, 0.0, 36.6], dtype=torch.float64)
    torch.testing.assert_close(units.celsius(units.kelvin(temperatures)), temperatures)


def test_constants_are_defined_once():
    """Kernels may import nothing, so that theirs are copies; everybody else imports."""
    names = re.compile(r"^_?(?:KELVIN_AT_0_C|STEFAN_BOLTZMANN|DAY_S|(?:SH_)?C0) = ", re.MULTILINE)
    sources = [*(ROOT / "src").rglob("*.py"), *(ROOT / "datamodules").rglob("*.py")]
    found = sorted(path.name for path in sources for _ in names.findall(path.read_text()))
    assert found == ["spherical_harmonics.py", "units.py", "units.py", "units.py"]
    assert np.float32(C0) == kernel._A0


def test_counts_that_are_plausible_as_kelvin_x_100():
    assert units.is_centikelvin(28500.0, 29500.0, 31500.0)
    assert not units.is_centikelvin(12000.0, 13000.0, 14000.0)  # -143 °C
    assert not units.is_centikelvin(5000.0, 29500.0, 60000.0)  # 550 K between the coldest and the hottest
