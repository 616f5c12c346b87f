"""The synthetic scenes as data: truth, noise, determinism, presets, and the data module."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import (
    SIZES,
    Recording,
    expose,
    film,
    hits,
    pixel_rays,
)
from heatsplat.datamodules.synthetic_scene.paths import frame_times
from heatsplat.datamodules.synthetic_scene.presets import PRESETS, TABLE_TOP, Pattern, Preset
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.physics.frequencies import default_tau_min, frequency_grid
from heatsplat.physics.relaxation import harmonic_response

CONF = Path(__file__).parents[2] / "conf" / "data" / "synthetic.yaml"
SMALL = replace(SIZES["tiny"], frames=3, points=300)


@pytest.fixture(autouse=True)
def one_thread():
    """Small tensor operations on a busy machine are faster on one thread than on two that wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@cache
def scene_of(preset: str) -> Scene:
    return Scene(PRESETS[preset])


@cache
def recorded(preset: str, noise_k: float = 0.05, scene_seed: int = 0) -> Recording:
    return film(scene_of(preset), SMALL, scene_seed, noise_k)


@cache
def tiny(preset: str) -> Synthetic:
    return Synthetic(scene=preset, size="tiny")


# Presets whose images show surfaces as warm as they are, with points and texture that the tiny size can show; the others are in
# test_flaws.py and test_phenomena.py.
SEEN_AS_THEY_ARE = [
    name
    for name, preset in PRESETS.items()
    if not (
        preset.carried
        or preset.haze
        or preset.flaws
        or preset.gloss
        or any(one.emissivity < 1 for one in preset.surfaces)
    )
    and name not in ("weak_texture", "fine_texture", "swung")
]


def seen_points(preset: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [n, 3] that the camera of the tiny size sees, and their surfaces [n]."""
    scene = scene_of(preset)
    return scene.nearest(tiny(preset).scene.points.double())


# One of each kind of scene, lens, sensor and path; the others combine them.
QUICK = {"static", "heated", "glass", "metals", "haze", "blurred", "noisy_sensor", "auto_gain", "swung"}


@pytest.mark.parametrize(
    "preset", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in PRESETS]
)
def test_the_same_arguments_give_the_same_bits(preset):
    first = recorded(preset)
    torch.set_num_threads(2)
    again = film(Scene(PRESETS[preset]), SMALL)
    assert torch.get_num_threads() == 2
    for key in ("celsius", "rgb", "points", "viewmats", "times_s"):
        assert np.array_equal(getattr(first, key), getattr(again, key)), key


def test_another_seed_is_another_recording_of_the_same_scene():
    first, other = recorded("cooling"), recorded("cooling", scene_seed=1)
    assert not np.array_equal(first.viewmats, other.viewmats)
    assert not np.array_equal(first.times_s, other.times_s)
    assert not np.array_equal(first.points, other.points)
    assert abs(first.celsius[0].mean() - other.celsius[0].mean()) < 5.0


def test_noise_is_white_and_of_the_stated_size():
    noise = (recorded("cooling").celsius.astype(np.float64) - recorded("cooling", 0.0).celsius).reshape(3, 52, 64)
    assert noise.std() == pytest.approx(0.05, rel=0.03)
    assert abs(noise.mean()) < 4 * 0.05 / noise.size**0.5
    for a, b in ((noise[0], noise[1]), (noise[:, :, 1:], noise[:, :, :-1]), (noise[:, 1:], noise[:, :-1])):
        assert abs(np.mean(a * b)) < 4 * 0.05**2 / a.size**0.5


@pytest.mark.parametrize("preset", SEEN_AS_THEY_ARE)
def test_clean_pixels_are_the_truth_at_what_they_show(preset):
    """On smooth surface a pixel is the solver's temperature at its centre; at edges it lies between its neighbours."""
    clean = recorded(preset, 0.0)
    frame = 2
    viewmat, time = torch.from_numpy(clean.viewmats[frame]), float(clean.times_s[frame])
    y, x = np.mgrid[:52, :64] + 0.5
    rays = pixel_rays(clean.lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
    points, which = hits(clean.scene, viewmat, rays)
    assert (which >= 0).all()  # no ray leaves the room
    truth = clean.scene.truth(points, torch.tensor([time]))[:, 0].reshape(52, 64).numpy()
    error = np.abs(clean.celsius[frame] - truth)
    assert np.mean(error < 1e-5) > 0.1  # float32 apart, one ray per pixel
    assert np.mean(error < 0.05) > 0.65
    padded = np.pad(truth, 1, mode="edge")
    around = [padded[i : i + 52, j : j + 64] for i, j in itertools.product(range(3), range(3))]
    between = (clean.celsius[frame] > np.min(around, axis=0) - 0.5) & (
        clean.celsius[frame] < np.max(around, axis=0) + 0.5
    )
    assert between[1:-1, 1:-1].mean() > 0.998


def test_edges_are_averaged_over_the_pixel():
    """A pixel over an edge holds what the mean of 8 x 8 rays holds, far better than its centre does."""
    scene, lens = scene_of("static"), recorded("static").lens
    viewmat, time = torch.from_numpy(recorded("static").viewmats[1]), torch.tensor([100.0])

    def truth(rays_per_side: int) -> torch.Tensor:
        y, x = (np.mgrid[: 52 * rays_per_side, : 64 * rays_per_side] + 0.5) / rays_per_side
        rays = pixel_rays(lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
        each = scene.celsius(scene.heat_at(*hits(scene, viewmat, rays)), time.double()).reshape(1, 1, *x.shape)
        return torch.nn.functional.avg_pool2d(each, rays_per_side)[0, 0]

    y, x = np.mgrid[:52, :64] + 0.5
    rays = pixel_rays(lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
    image, exact = expose(scene, lens, rays, viewmat, 100.0)[0], truth(8)
    error = (image - exact).pow(2).mean().sqrt()
    assert error < 0.25 * (truth(1) - exact).pow(2).mean().sqrt()
    assert (image - exact).abs().max() < 8.0  # K; steps in this picture reach 30 K


def test_static_does_not_change_and_cooling_relaxes_to_the_surroundings():
    times = torch.linspace(0.0, 1800.0, 40, dtype=torch.float64)
    points, _ = seen_points("static")
    static = scene_of("static").truth(points, times)
    assert (static - static[:, :1]).abs().max() < 1e-3
    cooling = scene_of("cooling").truth(points, times)
    assert torch.allclose(cooling[:, 0], static[:, 0], atol=1e-9)
    assert (cooling.diff(dim=1) < 1e-4).all()
    assert (cooling > 22.0 - 1e-3).all()
    # Materials differ: what is left of the start after 30 minutes.
    left = (cooling[:, -1] - 22.0) / (cooling[:, 0] - 22.0)
    assert left.min() < 0.05 and left.max() > 0.25


def test_heated_follows_its_lamp_over_several_periods():
    scene = scene_of("heated")
    times = torch.linspace(0.0, 1800.0, 181, dtype=torch.float64)
    points, which = (of_all[::4] for of_all in seen_points("heated"))
    warm = scene.truth(points, times)
    surface = scene.heat_at(points, which)
    lit, dark = surface.flux_w_m2 > 200.0, surface.flux_w_m2 < 1.0
    assert 0.3 < lit.double().mean() < 0.95 and dark.double().mean() > 0.02
    inner = warm[lit][:, 1:-1]
    peaks = ((inner > warm[lit][:, :-2]) & (inner >= warm[lit][:, 2:])).sum(1)
    assert peaks.double().median() == 3
    assert (warm[dark].diff(dim=1) < 1e-3).all()
    assert warm.amax() - warm.amin() > 30.0


def test_points_are_divided_among_surfaces_and_asked_in_parts():
    scene = scene_of("heated")
    points, which = (of_all.clone() for of_all in seen_points("heated"))
    which[:5] = -1
    parts = scene.parts(points, which)
    for part in parts:
        assert part.surface is scene.preset.surfaces[part.number]
        assert torch.equal(part.here, (which == part.number).nonzero()[:, 0])
        assert torch.equal(part.on, points[part.here])
    assert sum(len(part.here) for part in parts) == (which >= 0).sum() and all(len(part.here) for part in parts)
    for asked in (scene.color, scene.normals, lambda *args: scene.heat_at(*args).flux_w_m2):
        found = asked(points, which)
        assert torch.equal(asked(points, which, parts), found) and (found[:5] == 0).all()
        torch.testing.assert_close(asked(points.flip(0), which.flip(0)), found.flip(0))


def test_the_lamp_casts_shadows():
    """Flux at a point is zero exactly where a straight walk to the lamp meets another object."""
    scene = scene_of("heated")
    points, which = seen_points("heated")
    lamp = torch.tensor(scene.preset.lamp.position, dtype=torch.float64)
    steps = torch.linspace(0.002, 1.0, 500, dtype=torch.float64)
    names = [surface.name for surface in scene.preset.surfaces]
    floor = which == names.index("floor")
    path = points[floor, None] + steps[:, None] * (lamp - points[floor, None])
    center, radius = torch.tensor([0.05, -0.15, 0.22], dtype=torch.float64), 0.22
    behind_vase = ((path - center).norm(dim=2) < radius).any(1)
    flux = scene.heat_at(points, which).flux_w_m2[floor]
    assert behind_vase.sum() > 3
    assert (flux[behind_vase] == 0).all() and (flux > 0).double().mean() > 0.3


@pytest.mark.parametrize("preset", ["cooling", "heated"])
def test_dynamic_presets_are_hard_for_a_static_model_and_possible_for_relaxation_with_harmonics(preset):
    """Per point: the best constant fails by degrees, Newton's law with 24 harmonics gets below a tenth of one."""
    scene = scene_of(preset)
    points, _ = seen_points(preset)
    frames = torch.from_numpy(frame_times(72, 1800.0, 0))
    truth = scene.truth(points[::5], frames)
    test = torch.arange(72) % 8 == 0
    times = frames - frames[1]
    constant = truth[:, ~test].mean(1, keepdim=True)
    assert (truth[:, test] - constant).pow(2).mean().sqrt() > 3.0

    omega = frequency_grid(times[~test], 24, default_tau_min(times[~test]), 0.5**0.5)
    target = truth - 22.0
    best_cost = torch.full((len(target),), torch.inf, dtype=torch.float64)
    fit = torch.zeros_like(target)
    for rate in torch.logspace(-4.0, -2.0, 15, dtype=torch.float64):
        gains = [torch.cat(harmonic_response(rate[None], omega, t), dim=1)[0] for t in times]
        design = torch.cat([torch.exp(-rate * times)[:, None], torch.stack(gains)], dim=1)
        penalty = 10.0 * torch.eye(design.shape[1], dtype=torch.float64)
        penalty[0, 0] = 0.0
        known = design[~test]
        weights = torch.linalg.solve(known.T @ known + penalty, known.T @ target[:, ~test].T)
        cost = (known @ weights - target[:, ~test].T).pow(2).sum(0) + (penalty @ weights * weights).sum(0)
        better = cost < best_cost
        best_cost = torch.where(better, cost, best_cost)
        fit = torch.where(better[:, None], (design @ weights).T, fit)
    assert (fit - target)[:, test].abs().mean() < 0.1


@pytest.mark.parametrize("preset", SEEN_AS_THEY_ARE)
def test_every_object_shows_and_every_surface_is_textured(preset):
    scene = scene_of(preset)
    points, which = seen_points(preset)
    half_way = scene.truth(points, torch.tensor([600.0]))[:, 0]
    for number, surface in enumerate(scene.preset.surfaces):
        own = half_way[which == number]
        assert len(own) >= 4, surface.name
        assert own.max() - own.min() > 10 * 0.05, surface.name


def test_no_surface_lies_on_a_border_between_tiles():
    """Rounding must not decide the colour of a tile: moving a point off its surface by a nanometre changes nothing."""
    points, which = seen_points("cooling")
    for number, surface in enumerate(TABLE_TOP):
        on = points[which == number]
        local, moved = (surface.shape.local(p) for p in (on, on + 1e-9 * surface.shape.normals(on)))
        for pattern in (surface.absorbs, PRESETS["cooling"].start_k[surface.name]):
            assert (pattern(local) - pattern(moved)).abs().max() < 1e-6


def test_pattern_has_its_level_swing_and_step():
    generator = torch.Generator().manual_seed(0)
    points = 4.0 * torch.rand(20000, 3, generator=generator, dtype=torch.float64)
    smooth = Pattern(10.0, 3.0, 0.7)(points)
    assert smooth.mean() == pytest.approx(10.0, abs=0.1) and 7.0 <= smooth.min() < 7.5 and 12.5 < smooth.max() <= 13.0
    tiles = Pattern(10.0, step=2.0, tile_m=0.5)
    assert set(tiles(points).tolist()) == {8.0, 12.0}
    assert tiles(torch.tensor([[0.0, 0.0, 0.0], [0.26, 0.0, 0.0], [0.26, 0.26, 0.0]])).tolist() == [12.0, 8.0, 12.0]


@pytest.mark.parametrize("preset", SEEN_AS_THEY_ARE)
def test_scene_says_what_it_is(preset):
    scene = tiny(preset).scene
    assert (len(scene.train), len(scene.test)) == (16, 3)
    assert [f.name for f in scene.test.frames] == [f"frame_{i:05d}.png" for i in (0, 8, 16)]
    assert scene.train.times_s[0] == 0.0
    assert scene.metadata >= {"time", "thermal_range", "ambient", "metres"}
    assert scene.ambient_c == 22.0 and scene.metres_per_unit == 1.0
    assert scene.notes["noise_k"] == 0.05 and "converged" in scene.notes["heat"]
    assert scene.notes["pixel_type"] == "uint16"
    view = scene.train[5]
    assert view.thermal.shape == (52, 64, 1) and view.rgb.shape == (52, 64, 3)
    assert view.thermal.min() > 0.0 and view.thermal.max() < 1.0
    assert 30.0 < scene.thermal_range.span_k < 55.0
    assert len(scene.points) == len(scene.point_colors) == 600


@pytest.mark.parametrize("preset", SEEN_AS_THEY_ARE)
def test_truth_and_points_fit_the_images_through_the_contract(preset):
    """Points projected into a view find the temperature that the truth gives for the view's time."""
    scene = tiny(preset).scene
    errors = []
    for view in (scene.train[0], scene.train[9], scene.test[0]):
        camera = view.camera
        in_camera = scene.points.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixel = (in_camera @ camera.K.T)[:, :2] / in_camera[:, 2:]
        truth = scene.truth(scene.points, torch.tensor([view.time_s]))[:, 0]
        seen = (pixel > 0).all(1) & (pixel[:, 0] < 64) & (pixel[:, 1] < 52) & (in_camera[:, 2] > 0)
        column, row = pixel[seen].long().unbind(1)
        errors.append((scene.thermal_range.to_celsius(view.thermal[row, column, 0]) - truth[seen]).abs())
    errors = torch.cat(errors)
    assert errors.median() < 0.8  # K; what is hidden behind others makes the tail


def test_probes_are_named_points_on_different_surfaces():
    scene = tiny("heated").scene
    assert scene.notes["probes"] == [surface.name for surface in TABLE_TOP]
    on_surface, which = scene_of("heated").nearest(scene.probes)
    assert which.tolist() == list(range(len(TABLE_TOP)))
    assert (on_surface - scene.probes).norm(dim=1).max() < 1e-6
    times = torch.tensor(scene.train.times_s)
    truth = scene.truth(scene.probes, times)
    assert truth.shape == (len(TABLE_TOP), 16)
    # None stands on a border: a centimetre aside it is much the same, where the scene changes by tens of degrees.
    for offset in 0.01 * torch.cat([torch.eye(3), -torch.eye(3)]):
        assert (scene.truth(scene.probes + offset, times) - truth).abs().max() < 3.0


def test_options_reach_the_scene():
    module = Synthetic(scene="cooling", size="tiny", frames=10, downscale=2.0, noise_k=0.0, split="block", seed=3)
    scene = module.scene
    assert len(scene.train) + len(scene.test) == 10
    assert scene.train[0].thermal.shape == (26, 32, 1)
    assert scene.train[0].camera.K[0, 0] == pytest.approx(0.5 * recorded("cooling").lens.fx)
    assert module.seed == 3


def test_config_makes_the_module():
    config = OmegaConf.merge({"synthetic_preset": "heated", "seed": 5}, {"data": OmegaConf.load(CONF)})
    config.data.size = "tiny"
    module = instantiate(config.data, _convert_="all")
    assert (module.scene_name, module.seed, module.root) == ("heated", 5, None)
    assert module.size == SIZES["tiny"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "boiling"}, "data.scene=boiling: .* choose one of static, cooling, heated"),
        ({"size": "huge"}, "data.size must be one of tiny, demo, benchmark, large"),
        ({"frames": 1}, "data.frames=1: a scene needs at least 2 frames"),
        ({"noise_k": -0.1}, "data.noise_k=-0.1"),
        ({"noise_k": float("nan")}, "data.noise_k=nan"),
        ({"noise_k": float("inf")}, "data.noise_k=inf"),
        ({"pose_error_px": float("inf")}, "data.pose_error_px=inf"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(SceneError, match=message):
        Synthetic(**options)


def test_bad_presets_are_named():
    with pytest.raises(ValueError, match=r"does not have: \['ghost'\]; it has \['floor'"):
        Preset(start_k={"ghost": Pattern(1.0)}, surfaces=TABLE_TOP[:2])
    with pytest.raises(ValueError, match="two surfaces of one name"):
        Preset(surfaces=TABLE_TOP[:1] * 2)
    with pytest.raises(ValueError, match="either held steady or heated"):
        Preset(held=True, lamp=PRESETS["heated"].lamp)


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        ("sparse/0/cameras.bin", "did you mean data=colmap. The folder has sparse/0"),
        ("colmap/sparse/cameras.txt", "did you mean data=colmap. The folder has colmap/sparse"),
        ("scene/transforms.json", "did you mean data=nerfstudio. The folder has scene/transforms.json"),
        ("scene/thermal/sparse/0/cameras.bin", "did you mean data=rhd"),
        ("IR_0001.jpg", "say with data=... what the folder holds .*prepare.py"),
    ],
)
def test_a_folder_that_would_not_be_read_is_refused(tmp_path, mark, said):
    (tmp_path / mark).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / mark).write_text("")
    with pytest.raises(SceneError, match=f"data.root={tmp_path} is given, but data=synthetic .*{said}"):
        Synthetic(root=str(tmp_path))
    with pytest.raises(SceneError, match="there is no such folder"):
        Synthetic(root=str(tmp_path / "nowhere"))
