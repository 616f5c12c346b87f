"""A hot ball on its way: what it radiates against the view factor of a sphere, and its trail against one solve of the whole."""

import math

import numpy as np
import pytest
import torch

from heatsplat.datamodules.synthetic_scene.carried import Carried
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.heat import Waveform, solve
from heatsplat.datamodules.synthetic_scene.presets import CERAMIC, LINOLEUM, PRESETS, Preset
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.synthetic_scene.shapes import Plane, Sphere

PRESET = PRESETS["moving_source"]


def test_a_closed_shell_gets_all_that_the_ball_sends():
    ball = Carried(((0.2, 0.1, 0.0), (0.0, 0.0, 0.0)), radius_m=0.05, celsius=400.0)
    sides = torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shell = torch.nn.functional.normalize(sides, dim=1)
    flux = ball.fluxes(shell, -shell, [], 22.0).mean(0) * 4.0 * math.pi
    sent = 4.0 * math.pi * 0.05**2 * 5.670374419e-8 * (673.15**4 - 295.15**4)
    assert flux.tolist() == pytest.approx([sent, sent], rel=2e-3)


def test_what_stands_between_casts_a_shadow():
    ball = Carried(((0.0, 0.0, 1.0), (2.0, 0.0, 1.0)), 0.05, 400.0)
    floor, up = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    flux = ball.fluxes(floor, up, [Plane((0, 0, 0), (0, 0, 1)), Sphere((0.0, 0.0, 0.5), 0.1)], 22.0)[0]
    assert flux[0] == 0 and flux[1] > 0


def test_the_trail_is_that_of_one_solve_with_the_whole_flux():
    scene = Scene(PRESET)
    points = torch.tensor([[-0.2, -0.72, 0.0], [0.2, -0.3, 0.0]], dtype=torch.float64)
    heat = scene.heat_at(points, torch.tensor([0, 0]))
    times = np.linspace(5.0, 900.0, 23)
    found = scene.celsius(heat, torch.from_numpy(times)).numpy()
    step = PRESET.carried.interval_s(900.0)
    knots = step * np.arange(len(PRESET.carried.stations))
    for row, fluxes, start in zip(found, heat.carried_w_m2.numpy(), heat.start_k.numpy(), strict=True):
        wave = Waveform((0.0, *(knots + step)), (0.0, *fluxes))  # one interval earlier: it rises before the record
        driven = solve([LINOLEUM], wave, 900.0 + step, flux_w_m2=1.0).at(times + step)[:, 0, 1]
        expected = 22.0 + scene.responses.at(times)[:, 0, 0] * start + driven
        assert fluxes.max() > 100.0 and np.ptp(driven) > 2.0
        assert np.abs(row - expected).max() < 4e-3


def test_the_ball_touches_nothing_on_its_way():
    scene = Scene(PRESET)
    way = torch.tensor([PRESET.carried.ball(share).center for share in np.linspace(0, 1, 400)], dtype=torch.float64)
    on_surface, _ = scene.nearest(way)
    assert (way - on_surface).norm(dim=1).min() > PRESET.carried.radius_m


def test_it_is_seen_where_nothing_hides_it_and_is_as_hot_as_the_camera_can_say():
    recording = film(Scene(PRESET), Size(80, 64, 4, 50), noise_k=0.0)
    seen = [int((image > 399.0).sum()) for image in recording.exact]
    assert max(seen) > 12 and (recording.thermal_range.min_c, recording.thermal_range.max_c) == PRESET.bounds_c
    frame = int(np.argmax(seen))
    rows, columns = np.nonzero(recording.exact[frame] > 399.0)
    center = np.append(PRESET.carried.ball(recording.times_s[frame] / 900.0).center, 1.0)
    local = recording.viewmats[frame] @ center
    pixel = recording.lens.matrix() @ (local[:3] / local[2])
    assert np.hypot(columns.mean() + 0.5 - pixel[0], rows.mean() + 0.5 - pixel[1]) < 2.0


def test_a_scene_has_one_source_of_heat():
    with pytest.raises(ValueError, match="neither a lamp, nor held"):
        Preset(carried=PRESET.carried, lamp=PRESETS["heated"].lamp)
    assert CERAMIC in Scene(PRESET).materials
