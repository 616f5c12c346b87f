import os
from pathlib import Path

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.radiometric import Calibration
from heatsplat.physics.radiometry import Conditions
from heatsplat.preparation.frame import ThermalFrame, frame_name

IMAGE = np.array([[10.0, 20.0], [np.nan, 30.0]], np.float32)


def test_temperatures_are_those_of_the_surface():
    frame = ThermalFrame("a", Path("a.tiff"), 0, load=lambda: IMAGE)
    np.testing.assert_array_equal(frame.temperature(), IMAGE)
    cool = ThermalFrame(
        "a", Path("a.tiff"), 0, load=lambda: IMAGE, conditions=Conditions(emissivity=0.9, reflected_k=253.15)
    )
    assert (cool.temperature() > IMAGE)[np.isfinite(IMAGE)].all()  # it reflects a cold sky
    assert np.isnan(cool.temperature()[1, 0])


def test_an_image_that_is_as_warm_as_all_around_it_stays_as_it_is():
    around = Conditions(emissivity=0.5, reflected_k=293.15, distance_m=50.0, air_k=293.15, humidity=0.8)
    frame = ThermalFrame("a", Path("a.tiff"), 0, load=lambda: np.full((2, 2), 20.0, np.float32), conditions=around)
    np.testing.assert_allclose(frame.temperature(), 20.0, atol=1e-4)


def test_greys_without_a_meaning_are_no_temperatures_but_can_be_looked_at():
    frame = ThermalFrame("a", Path("a.png"), 0, load=lambda: np.full((2, 2), 7, np.uint8), calibration=None)
    assert frame.pixels().dtype == np.float32 and (frame.pixels() == 7).all()
    with pytest.raises(SceneError, match="a.png holds greys without a meaning in °C; give bounds_c"):
        frame.temperature()


def test_counts_become_temperatures_by_their_calibration():
    counts = np.array([[29315, 30315]], np.uint16)
    frame = ThermalFrame(
        "a", Path("a.png"), 0, load=lambda: counts, calibration=Calibration(scale=0.01, offset_c=-273.15)
    )
    np.testing.assert_allclose(frame.temperature(), [[20.0, 30.0]], atol=1e-4)


def test_a_name_that_is_no_text_becomes_one(tmp_path):
    """OpenCV ended Python at such a path, and pictures failed at such a name."""
    path = tmp_path / os.fsdecode(b"Geb\xe4ude") / "a_1.tiff"
    assert frame_name(path, tmp_path) == "Gebäude_a_1"
    assert frame_name(tmp_path / "Straße 1.tiff", tmp_path, 3) == "Straße 1_000003"
