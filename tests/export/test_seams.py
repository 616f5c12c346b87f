"""Seams of drifting images: their steps are measured, and are gone where nothing drifts."""

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.export.seams import comparison, mosaic, seam_lines, shift_between, smoothed, step_across
from heatsplat.geometry.looks import surface_points

RANGE = ThermalRange(10.0, 50.0)
OFFSETS = (0.0, 2.0, -1.0)  # °C by which each image is off
K = torch.tensor([[100.0, 0, 60], [0, 100.0, 40], [0, 0, 1]], dtype=torch.float64)


def camera(x: float, away: float = 10.0) -> Camera:
    """Looks down along z at the plane z = 0."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([-x, 0.0, away])
    return Camera(viewmat, K, 120, 80)


def ground(points):
    return 25 + 2 * torch.sin(points[..., 0] / 3) + 0.5 * points[..., 1]


@pytest.fixture
def flight():
    """Three images of a plane, 4 m apart, each off by a constant."""
    frames = [Frame(f"{i}.png", i, camera(4.0 * i)) for i in range(3)]

    def decode(i):
        there = surface_points(frames[i].camera, torch.full((80, 120), 10.0))
        return View(frames[i], thermal=RANGE.to_unit(ground(there) + OFFSETS[i])[..., None].float())

    views = ViewSet(frames, decode)
    return SceneData("flight", views, views, views, points=torch.zeros(4, 3), thermal_range=RANGE)


def test_steps_are_those_of_the_images(flight):
    wide = Camera(camera(4.0).viewmat, K * torch.tensor([[0.5], [0.5], [1.0]]), 130, 40)
    points = surface_points(wide, smoothed(torch.full((40, 130), 10.0)))
    values, owner = mosaic(flight, points)
    known = np.isfinite(values)
    assert set(np.unique(owner)) == {-1, 0, 1, 2} and (known == (owner >= 0)).all()
    truth = ground(points).numpy()
    off = np.array(OFFSETS)[owner]
    assert np.abs((values - truth - off)[known]).max() < 0.15  # half a pixel of the recorded images
    step, count = step_across(np.where(known, values - truth, np.nan), owner)
    assert count == 2 and step == pytest.approx(np.sqrt((2.0**2 + 3.0**2) / 2), rel=0.05)
    assert step_across(np.where(known, off * 0.0, np.nan), owner)[0] == pytest.approx(0, abs=1e-9)
    assert seam_lines(owner)[20].sum() >= 2
    picture = comparison({"images": values, "other": truth + 1, "this": truth}, owner, "°C", np.abs(values - truth))
    assert picture.ndim == 3 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_the_shift_between_maps_is_found_though_they_know_other_pixels_and_levels():
    rng = np.random.default_rng(0)
    ground = uniform_filter(rng.normal(size=(120, 150)), 5)
    other = ground[20:100, 20:130].copy()
    one = ground[17:97, 25:135] + 3.0  # lies 3 rows further down, 5 columns further to the left
    other[:10], one[:, -20:] = np.nan, np.nan
    rows, columns, there, here = shift_between(one, other)
    assert (rows, columns) == (3, -5) and there > 0.999 and abs(here) < 0.5
    assert shift_between(one * np.nan, other)[:2] == (0, 0)
