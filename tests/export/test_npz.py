"""The archive as NumPy alone reads it: temperatures at any time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from heatsplat.export.formats.npz import Npz
from heatsplat.export.moment import moments


def decoded(path, time_s, clip=True):
    """Values at a time, as docs/export.md says, or without the clipping."""
    with np.load(path, allow_pickle=False) as found:
        curves = np.stack([np.interp(time_s, found["basis_times_s"], curve) for curve in found["basis_curves"]])
        blended = found["basis_offsets"] + found["basis_coefficients"] @ curves
        if clip and json.loads(str(found["about"]))["clipped"]:
            blended = blended.clip(0, 1)
        return np.interp(blended, np.linspace(*found["table_ends"], len(found["table"])), found["table"])


def test_numpy_alone_finds_the_temperature_at_another_time(cooling, tmp_path):
    Npz().write(cooling, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        about = json.loads(str(found["about"]))
        assert np.array_equal(found["temperature"], cooling.values) and about["time_s"] == 600.0
        assert np.array_equal(found["means"], cooling.seen.means) and about["unit"] == "°C" and about["origin"] is None
    (expected,) = moments(cooling.module, cooling.seen, 250.0)
    assert np.allclose(decoded(tmp_path / "a.npz", 250.0), expected.values, atol=1e-3)


def test_a_scene_that_leaves_its_range_is_clipped_as_the_page_says(cooling, tmp_path):
    layer, offsets = cooling.layer, cooling.layer.basis.offsets
    hot = replace(layer, clipped=True, basis=replace(layer.basis, offsets=offsets + 1 - offsets.median()))
    seen = replace(cooling.seen, layers=[hot], table_ends=(0.0, 2.0))
    moment, expected = (moments(cooling.module, seen, time_s)[0] for time_s in (600.0, 250.0))
    Npz().write(moment, tmp_path / "a.npz")
    assert np.allclose(decoded(tmp_path / "a.npz", 250.0), expected.values, atol=1e-3)
    assert np.abs(decoded(tmp_path / "a.npz", 250.0, clip=False) - expected.values.numpy()).max() > 1.0
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")
    assert "Where `clipped` is true in `about`" in page and "clipped" in Npz.__doc__
