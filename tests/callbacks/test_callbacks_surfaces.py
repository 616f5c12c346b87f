"""The table and the picture of hot and cold surfaces, of a wall whose left half is warm."""

from types import SimpleNamespace

import pytest
import torch
from fake_run import RANGE, WIDTH, wall, warmth

from heatsplat.callbacks.surfaces import SURFACES_FILE, SURFACES_PICTURE, ExtremeSurfaces
from heatsplat.geometry.looks import surface_points
from heatsplat.io.tables import read_csv


def render(frame, depth, camera):
    """The wall in z = 4: a warm patch of 0.5 x 0.4 about (-0.5, 0.1), all else at 0.1."""
    away = torch.full((camera.height, camera.width), 4.0)
    points = surface_points(camera, away)
    patch = ((points[..., 0] + 0.5).abs() < 0.25) & ((points[..., 1] - 0.1).abs() < 0.2)
    image = torch.where(patch, warmth(frame.time_s).float(), torch.tensor(0.1) + 0.001 * points[..., 0].float())
    return SimpleNamespace(features=image[..., None], depth=away, alpha=torch.ones(1, *away.shape))


def test_the_warm_patch_is_found(tmp_path):
    module = SimpleNamespace(scene=wall(), modality="thermal", output_dir=tmp_path, render=render)
    ExtremeSurfaces(views=4, share=0.02).on_test_epoch_end(None, module)
    rows = read_csv(tmp_path / SURFACES_FILE)
    hottest, times = rows[0], module.scene.train.times_s
    taken = min(
        times, key=lambda time_s: abs(time_s - (min(times) + max(times)) / 2)
    )  # of an image: not between nights
    assert hottest["kind"] == "hottest" and hottest["time_s"] == pytest.approx(taken)
    assert hottest["mean_c"] == pytest.approx(float(RANGE.to_celsius(warmth(taken))), abs=0.01)
    assert hottest["area"] == pytest.approx(0.2, rel=0.2) and hottest["unit"] == "square units"
    assert [hottest[axis] for axis in "xyz"] == pytest.approx([-0.5, 0.1, 4.0], abs=0.08)
    assert rows[-1]["kind"] == "coldest" and rows[-1]["mean_c"] < 15
    assert (tmp_path / SURFACES_PICTURE).stat().st_size > 1000 and WIDTH == 56


def test_images_that_are_no_temperatures_have_none(tmp_path):
    ExtremeSurfaces().on_test_epoch_end(None, SimpleNamespace(scene=wall(thermal_range=None), modality="thermal"))
    assert not list(tmp_path.iterdir())
