"""The archive as NumPy alone reads it: temperatures at any time."""

import json

import numpy as np

from heatsplat.export.formats.npz import Npz
from heatsplat.export.moment import moments


def test_numpy_alone_finds_the_temperature_at_another_time(cooling, tmp_path):
    Npz().write(cooling, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        about = json.loads(str(found["about"]))
        assert np.array_equal(found["temperature"], cooling.values) and about["time_s"] == 600.0
        assert np.array_equal(found["means"], cooling.seen.means) and about["unit"] == "°C"
        curves = np.stack([np.interp(250.0, found["basis_times_s"], curve) for curve in found["basis_curves"]])
        blended = found["basis_offsets"] + found["basis_coefficients"] @ curves
        celsius = np.interp(blended, np.linspace(*found["table_ends"], len(found["table"])), found["table"])
    (expected,) = moments(cooling.module, cooling.seen, 250.0)
    assert np.allclose(celsius, expected.values, atol=1e-3)
