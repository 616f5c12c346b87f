"""Haze and camera flaws of the synthetic scenes: what they do to an image, and that scenes know their clean record."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.flaws import CameraFlaws, Haze
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene

SMALL = Size(64, 52, 3, 600)


def test_haze_dims_the_excess_over_the_surroundings_by_beer_lambert():
    haze = Haze(0.25, 0.9, 2.3)
    distance = torch.tensor([0.0, 1.0, 2.0, 4.0], dtype=torch.float64)
    for progress in (0.0, 0.1, 0.7):
        thickness = 0.25 * (1 + 0.9 * math.sin(2 * math.pi * 2.3 * progress))
        assert torch.allclose(haze.transmission(distance, progress), torch.exp(-thickness * distance))
    assert (haze.transmission(distance, 0.3) <= 1).all()


def test_the_hazy_scene_is_the_static_one_through_haze():
    clear = Scene(replace(PRESETS["haze"], haze=None))
    through, without = film(Scene(PRESETS["haze"]), SMALL, noise_k=0.0), film(clear, SMALL, noise_k=0.0)
    ambient = PRESETS["haze"].ambient_c
    for frame in range(SMALL.frames):
        share = (through.celsius[frame] - ambient) / (without.celsius[frame] - ambient)
        smooth = np.abs(without.celsius[frame] - ambient) > 2.0
        progress = float(through.times_s[frame]) / PRESETS["haze"].duration_s
        near, far = (PRESETS["haze"].haze.transmission(torch.tensor(d), progress).item() for d in (4.5, 1.0))
        assert near - 1e-4 < np.quantile(share[smooth], 0.01) and np.quantile(share[smooth], 0.99) < far + 1e-4
    assert len(through.points) == 600 / 8


def test_flaws_are_a_fixed_pattern_a_falloff_and_steps():
    flaws = CameraFlaws(gain=0.03, bias=0.02, columns=0.01, falloff=(-0.12, -0.08), step=0.05, frames_per_step=2)
    clean = torch.rand(5, 26, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gain, bias, falloff = flaws.fields(26, 32, seed=3)
    steps = flaws.steps(5, seed=3)
    assert steps[0] == steps[1] != steps[2] == steps[3] != steps[4]
    seen = flaws.record(clean, seed=3)
    assert torch.allclose(seen, steps[:, None, None] * (clean * (1 + gain) + bias) * falloff)
    assert falloff[0, 0] < falloff.min() + 1e-12 and math.exp(-0.2) < falloff.min() < math.exp(-0.2) + 0.02
    assert falloff.max() > 0.99 and 0.01 < gain.std() < 0.05
    assert not torch.equal(flaws.fields(26, 32, seed=4)[0], gain)


def test_a_flawless_camera_records_the_clean_image():
    clean = torch.rand(4, 13, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(CameraFlaws(0.0, 0.0, 0.0, falloff=(0.0, 0.0)).record(clean, 0), clean)


@pytest.fixture(scope="module")
def noisy():
    return Synthetic(scene="noisy_sensor", size="tiny", frames=9).scene


def test_views_of_the_noisy_sensor_know_their_clean_record(noisy):
    flaws = PRESETS["noisy_sensor"].flaws
    recording = film(Scene(PRESETS["noisy_sensor"]), Size(64, 52, 9, 600))
    clean = film(Scene(replace(PRESETS["noisy_sensor"], flaws=None)), Size(64, 52, 9, 600), noise_k=0.0)
    assert clean.thermal_range == recording.thermal_range
    assert np.array_equal(recording.clean, clean.celsius) and clean.clean is None
    for view in (noisy.train[0], noisy.test[1]):
        unit = noisy.thermal_range.to_unit(torch.from_numpy(clean.celsius[view.frame.frame_id]))
        assert torch.allclose(view.clean[..., 0], unit, atol=1e-5)
    every = noisy.thermal_range.to_unit(torch.from_numpy(clean.celsius).double())
    seen = flaws.record(every, 0)[noisy.test[1].frame.frame_id].clamp(0, 1)
    assert (noisy.test[1].thermal[..., 0] - seen).abs().mean() < 2 * 0.05 / noisy.thermal_range.span_k
    assert (noisy.test[1].thermal - noisy.test[1].clean).abs().mean() > 0.01


def test_other_views_know_of_no_clean_record_but_are_their_own():
    view = Synthetic(scene="static", size="tiny", frames=2).scene.train[0]
    assert view.clean is None and view.image("clean") is view.thermal


def test_a_smaller_scene_has_smaller_clean_records():
    view = Synthetic(scene="noisy_sensor", size="tiny", frames=5, downscale=2.0).scene.train[3]
    assert view.clean.shape == view.thermal.shape == (26, 32, 1)
