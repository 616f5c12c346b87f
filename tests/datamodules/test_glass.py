"""A pane that is clear to the eye and a wall to heat: what is filmed, and what one and two opacities make of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from running import BARE, run

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, film, pixel_rays
from heatsplat.datamodules.synthetic_scene.presets import PANE, PRESETS, TABLE_TOP, Pattern, Preset
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.synthetic_scene.shapes import Box
from heatsplat.metrics.psnr import psnr

SMALL = replace(SIZES["tiny"], frames=4, points=800)


@cache
def recorded(preset: str) -> Recording:
    return film(Scene(PRESETS[preset]), SMALL, noise_k=0.0)


def rays_through(scene: Scene, frame: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """First points, surfaces and directions of the rays through all pixel centres of a frame."""
    recording = recorded("glass")
    y, x = np.mgrid[:52, :64] + 0.5
    rays = pixel_rays(recording.lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
    viewmat = torch.from_numpy(recording.viewmats[frame])
    directions = rays @ viewmat[:3, :3]
    center = -(viewmat[:3, :3].T @ viewmat[:3, 3])[None]
    return *scene.first_hits(center, directions), directions


def test_the_pane_fills_a_good_part_of_the_frames():
    shares = [recorded("glass").shows(frame, "pane").mean() for frame in range(4)]
    assert min(shares) > 0.1 and max(shares) < 0.6


def test_heat_sees_the_pane_and_light_what_lies_behind():
    with_pane, without = recorded("glass"), recorded("static")
    for frame in range(4):
        pane = with_pane.shows(frame, "pane")
        inside = pane[1:-1, 1:-1] & pane[:-2, 1:-1] & pane[2:, 1:-1] & pane[1:-1, :-2] & pane[1:-1, 2:]
        inside = np.pad(inside, 1)
        celsius = with_pane.celsius[frame][inside]
        assert celsius.min() > 22.0 + 4.0 - 2.1 and celsius.max() < 22.0 + 4.0 + 2.1  # one smooth, lukewarm sheet
        assert without.celsius[frame][inside].max() > 45.0  # which hides something warm
        seen, behind = (film.rgb[frame][inside].astype(float) / 255 for film in (with_pane, without))
        veil = (seen - 0.9 * behind) / 0.1  # what the pane itself adds: its colour in daylight
        assert veil.std(axis=0).max() < 0.15
        assert np.corrcoef(seen.ravel(), behind.ravel())[0, 1] > 0.97
        away = ~pane
        assert np.abs(with_pane.celsius[frame] - without.celsius[frame])[away].mean() < 0.5


def test_the_tracer_adds_shares_of_every_pane_on_the_way():
    second = replace(PANE, name="second", shape=Box((0.05, -0.8, 0.37), (1.1, 0.012, 0.74)), transmits=0.5)
    scene = Scene(Preset(surfaces=(*TABLE_TOP, PANE, second)))
    bare = Scene(Preset(surfaces=TABLE_TOP))
    points, which, directions = rays_through(scene, 0)
    crossing = which == len(TABLE_TOP) + 1
    beyond, which_beyond = scene.beyond(points[crossing], directions[crossing])
    both = which_beyond == len(TABLE_TOP)
    assert both.sum() > 100
    base_points, base_which, _ = rays_through(bare, 0)
    base = bare.color(base_points, base_which)[crossing][both]
    expected = 0.9 * base + 0.1 * scene.color(beyond, which_beyond)[both]
    expected = 0.5 * expected + 0.5 * scene.color(points, which)[crossing][both]
    found = scene.visible(points, which, directions)[crossing][both]
    assert torch.allclose(found, expected, atol=1e-6)


def test_colour_behind_the_pane_is_averaged_over_the_pixel():
    """Heat shows no edge there, so that colour has to find its own: a pixel holds what 8 x 8 rays hold, not one."""
    recording, fine = recorded("glass"), 8
    scene, viewmat = recording.scene, torch.from_numpy(recording.viewmats[1])
    y, x = (np.mgrid[: 52 * fine, : 64 * fine] + 0.5) / fine
    directions = (
        pixel_rays(recording.lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2))) @ viewmat[:3, :3]
    )
    points, which = scene.first_hits(-(viewmat[:3, :3].T @ viewmat[:3, 3])[None], directions)
    each = scene.visible(points, which, directions).reshape(1, 52 * fine, 64 * fine, 3).movedim(3, 1)
    exact = torch.nn.functional.avg_pool2d(each, fine)[0].movedim(0, 2).numpy()
    at_centres = each[0, :, fine // 2 :: fine, fine // 2 :: fine].movedim(0, 2).numpy()
    pane = recording.shows(1, "pane")
    error, of_one_ray = (np.abs(image - exact)[pane] for image in (recording.rgb[1] / 255.0, at_centres))
    assert error.std() < 0.3 * of_one_ray.std() and np.quantile(error, 0.99) < 0.4 * np.quantile(of_one_ray, 0.99)


def test_where_nothing_transmits_light_stops_at_the_first_surface():
    scene = Scene(PRESETS["static"])
    points, which, directions = rays_through(scene, 1)
    assert torch.equal(scene.visible(points, which, directions), scene.color(points, which))


def test_points_lie_on_the_pane_and_behind_it():
    recording = recorded("glass")
    _, which = recording.scene.nearest(torch.from_numpy(recording.points))
    on_pane = int((which == len(TABLE_TOP)).sum())
    assert 50 < on_pane < 200  # half of the rays that meet it
    assert len(recording.points) == 800


def test_it_is_held_and_its_pane_has_a_pattern():
    preset = PRESETS["glass"]
    assert preset.held and isinstance(preset.start_k["pane"], Pattern)
    assert [surface.name for surface in preset.surfaces if surface.transmits] == ["pane"]


# One opacity or two ---------------------------------------------------------------------------------


@cache
def trained_on() -> Recording:
    return film(Scene(PRESETS["glass"]), SIZES["tiny"])


def in_the_pane(module) -> dict[str, float]:
    """Mean PSNR of heat and colour over the pane's pixels of the test views, in dB."""
    recording, scores = trained_on(), {"thermal": [], "rgb": []}
    for view in module.scene.test:
        pane = torch.from_numpy(recording.shows(view.frame.frame_id, "pane"))
        assert view.frame.name == f"frame_{view.frame.frame_id:05d}.png"
        images = module.predict_all(view.frame)
        for modality in scores:
            scores[modality].append(psnr(images[modality], view.image(modality), pane))
    return {modality: sum(values) / len(values) for modality, values in scores.items()}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """What a run of so many steps makes of the scene with so many opacities, once for each pair of numbers."""

    @cache
    def of(opacities: int, steps: int):
        short = (
            *BARE,
            "method=ravigs",
            "data.scene=glass",
            f"max_steps={steps}",
            "density.cap_max=2000",
            "callbacks.attributes=null",
        )
        module, _ = run(tmp_path_factory.mktemp("glass"), *short, f"thermal.dual_opacity={opacities == 2}")
        assert module.splats.opacities.shape[0] == opacities
        return module

    return of


@pytest.mark.slow
def test_one_opacity_fails_in_the_pane_and_two_do_not(trained):
    """Measured: 34.3 dB heat and 30.4 dB colour with two, 31.6 dB and 24.2 dB with one."""
    two, one = in_the_pane(trained(2, 600)), in_the_pane(trained(1, 600))
    assert two["thermal"] > 33.0 and two["rgb"] > 29.0
    assert two["thermal"] - one["thermal"] > 1.5 and two["rgb"] - one["rgb"] > 4.0


def test_the_pane_is_dense_to_heat_and_thin_to_light(trained):
    """Measured: medians of 0.27 and 0.018, which co-support leaves standing."""
    splats = trained(2, 250).splats
    _, which = Scene(PRESETS["glass"]).nearest(splats.means.detach().double())
    heat, light = splats.opacities.detach()[:, which == len(TABLE_TOP)].median(1).values.tolist()
    assert heat > 5 * light > 5 * 0.005


def test_only_the_pixels_of_a_surface_count_when_it_is_named():
    views = Synthetic(scene="glass", size="tiny", frames=SMALL.frames, only="pane").scene
    for view in (*views.train, *views.test):
        assert torch.equal(view.mask, torch.from_numpy(recorded("glass").shows(view.frame.frame_id, "pane")))
    with pytest.raises(SceneError, match="data.only=window: scene 'glass' has floor, wall, .*pane"):
        Synthetic(scene="glass", size="tiny", frames=2, only="window").load()
