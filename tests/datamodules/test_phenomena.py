"""Scenes that each show what a part of a method is for: their truth against formulae that are worked out anew here."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import SIZES, Size, film, hits, pixel_rays
from heatsplat.datamodules.synthetic_scene.flaws import CameraFlaws
from heatsplat.datamodules.synthetic_scene.heat import Material
from heatsplat.datamodules.synthetic_scene.presets import PRESETS, Pattern, Preset, Surface, droplets
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.synthetic_scene.shapes import Plane

SMALL = Size(64, 52, 3, 600)
ANY = Material(1.0, 1e6, 0.01, 10.0)


def rays_of(recording, frame):
    """First points, surfaces and unit directions through the pixel centres of a frame."""
    y, x = np.mgrid[: recording.lens.height, : recording.lens.width] + 0.5
    rays = pixel_rays(recording.lens, torch.from_numpy(np.stack([x, y], axis=-1).reshape(-1, 2)))
    viewmat = torch.from_numpy(recording.viewmats[frame])
    sight = torch.nn.functional.normalize(rays @ viewmat[:3, :3], dim=1)
    return *hits(recording.scene, viewmat, rays), sight


def band_radiance(celsius):
    """Planck's law between 7.5 and 14 µm by adaptive quadrature over the wavelength, in W/(m² sr)."""
    h, c, k, kelvin = 6.62607015e-34, 299792458.0, 1.380649e-23, celsius + 273.15
    return quad(lambda w: 2 * h * c**2 / w**5 / math.expm1(h * c / (w * k * kelvin)), 7.5e-6, 14e-6, epsrel=1e-10)[0]


# Few, misplaced points --------------------------------------------------------------------------------


def test_weak_texture_has_few_points_off_their_surfaces_and_none_on_what_is_bare():
    preset = PRESETS["weak_texture"]
    size = Size(16, 13, 8, SIZES["demo"].points)
    recording, plain = (film(Scene(p), size) for p in (preset, replace(preset, point_noise_m=0.0)))
    assert 20 < len(recording.points) < 200
    _, which = plain.scene.nearest(torch.from_numpy(plain.points))
    names = {preset.surfaces[i].name for i in which.tolist()}
    assert len(names) >= 4 and not names & preset.bare
    off = recording.points - plain.points
    assert off.std() == pytest.approx(0.05, rel=0.25)
    for name in preset.bare:
        assert preset.start_k[name].step == 0 and preset.start_k[name].swing > 0


def test_points_cannot_be_missing_from_surfaces_that_are_not_there():
    with pytest.raises(ValueError, match="preset has no points on surfaces that it does not have"):
        Preset(surfaces=PRESETS["static"].surfaces, bare=frozenset({"ghost"}))


# Air, and the camera that drifts ----------------------------------------------------------------------


def test_fog_weakens_by_its_water_and_the_true_distance():
    assert droplets(1.0) == pytest.approx(0.128, abs=0.001)  # Chýlek: 128 per km and g/m³ at 11 µm
    preset = PRESETS["fog"]
    through, clear = (film(Scene(p), SMALL, noise_k=0.0) for p in (preset, replace(preset, haze=None)))
    for frame in range(SMALL.frames):
        points, _, _ = rays_of(clear, frame)
        center = np.linalg.inv(clear.viewmats[frame])[:3, 3]
        share = np.exp(-droplets(2.0) * np.linalg.norm(points.numpy() - center, axis=1)).reshape(52, 64)
        expected = 22.0 + (clear.celsius[frame] - 22.0) * share
        error = np.abs(through.celsius[frame] - expected)
        assert np.median(error) < 1e-3 and np.quantile(error, 0.9) < 0.02  # pixels over an edge are means


def test_in_fog_the_camera_comes_near_and_goes_away():
    recording = film(Scene(PRESETS["fog"]), Size(8, 6, 40, 16), noise_k=0.0)
    centers = np.linalg.inv(recording.viewmats)[:, :3, 3]
    apart = np.linalg.norm(centers - (0.0, 0.15, 0.3), axis=1)
    assert apart.min() < 1.75 and apart.max() > 2.65
    assert np.abs(centers[:, 0]).max() < 1.68 and centers[:, 1].max() < -0.9  # in the room, before the objects


def test_a_fading_sensor_has_one_gain_for_each_image_that_walks():
    preset = PRESETS["fading"]
    recording = film(Scene(preset), Size(16, 13, 30, 16), noise_k=0.0)
    unit = [
        recording.thermal_range.to_unit(images.astype(np.float64)) for images in (recording.celsius, recording.clean)
    ]
    gains = np.array([np.median(seen / clean) for seen, clean in zip(*unit, strict=True)])
    assert np.allclose(unit[0], gains[:, None, None] * unit[1], atol=1e-6)
    assert np.allclose(gains, preset.flaws.steps(30, 0).numpy(), atol=1e-6)
    assert gains.mean() == pytest.approx(1.0, abs=1e-6)
    assert np.diff(gains).std() == pytest.approx(0.02, rel=0.4) and gains.std() > 0.02


def test_gain_control_stretches_logits_evenly_over_the_frames():
    flaws = CameraFlaws(gain=0.0, bias=0.0, falloff=(0.0, 0.0), stretch=0.3, shift=0.2)
    clean = 0.05 + 0.9 * torch.rand(40, 6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen, settings = flaws.record(clean, 5), flaws.stretches(40, 5)
    stretch, shift = settings.exp()[:, :1, None], settings[:, 1:, None]
    assert torch.allclose(torch.logit(seen), stretch * torch.logit(clean) + shift)
    most = settings.abs().amax(0)
    assert 0.25 < most[0] <= 0.3 and 0.17 < most[1] <= 0.2
    between = 0.5 * (settings[:-2] + settings[2:])
    assert (settings[1:-1] - between).abs().max() < 0.04  # what a view has lies between its neighbours'
    ends = flaws.record(torch.tensor([-0.1, 0.0, 1.0, 1.2], dtype=torch.float64).reshape(4, 1, 1), 0).flatten()
    assert torch.equal(ends, torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64))


# Metals -----------------------------------------------------------------------------------------------


def test_a_mirror_shows_what_it_faces_by_plancks_and_kirchhoffs_laws():
    """A floor of ε 0.3 at 30 °C before a wall of 80 °C, and under nothing where its mirrored ray leaves."""
    floor = Surface("floor", Plane((0, 0, 0), (0, 0, 1)), ANY, emissivity=0.3)
    wall = Surface("wall", Plane((0, 1, 0), (0, -1, 0)), ANY)
    start = {"floor": Pattern(8.0), "wall": Pattern(58.0)}
    scene = Scene(Preset(start_k=start, held=True, surfaces=(floor, wall), ambient_c=22.0))
    assert scene.mirrors
    points = torch.zeros(3, 3, dtype=torch.float64)
    points[2, 1], points[2, 2] = 1.0, 0.5
    directions = torch.tensor([[0.0, 2.0, -2.0], [0.0, -1.0, -1.0], [0.0, 3.0, 0.0]], dtype=torch.float64)
    which, own = torch.tensor([0, 0, 1]), torch.tensor([30.0, 30.0, 80.0], dtype=torch.float64)
    seen = scene.apparent(own, points, which, directions, 100.0)
    for found, facing in zip(seen.tolist()[:2], (80.0, 22.0), strict=True):
        assert band_radiance(found) == pytest.approx(0.3 * band_radiance(30.0) + 0.7 * band_radiance(facing), rel=1e-8)
    assert seen[2] == 80.0  # a black body shows itself


@pytest.fixture(scope="module")
def metals():
    return film(Scene(PRESETS["metals"]), SMALL, noise_k=0.0)


def test_metals_show_a_radiator_that_no_view_shows(metals):
    names = [surface.name for surface in PRESETS["metals"].surfaces]
    black = film(Scene(replace(PRESETS["metals"], surfaces=tuple(
        replace(surface, emissivity=1.0) for surface in PRESETS["metals"].surfaces))), SMALL, noise_k=0.0)  # fmt: skip
    for frame in range(SMALL.frames):
        assert not metals.shows(frame, "radiator").any()
        points, which, sight = rays_of(metals, frame)
        tower = which == names.index("tower")
        normals = metals.scene.normals(points[tower], which[tower])
        mirrored = sight[tower] - 2 * (sight[tower] * normals).sum(1, keepdim=True) * normals
        _, met = metals.scene.first_hits(points[tower] + 1e-6 * normals, mirrored)
        shown = torch.from_numpy(metals.celsius[frame].reshape(-1))[tower]
        warm = met == names.index("radiator")
        if warm.any():
            assert shown[warm].median() > shown[~warm].median() + 5.0
        dull = metals.scene.emissivity[which].reshape(52, 64).numpy() == 1.0
        inside = dull[1:-1, 1:-1] & dull[:-2, 1:-1] & dull[2:, 1:-1] & dull[1:-1, :-2] & dull[1:-1, 2:]
        difference = np.abs(metals.celsius[frame] - black.celsius[frame])[1:-1, 1:-1]
        assert np.quantile(difference[inside], 0.99) < 0.01 and difference[~inside].mean() > 1.0


def test_the_scene_knows_what_its_surfaces_are(metals):
    scene = Synthetic(scene="metals", size="tiny", frames=4).scene
    told = scene.true_attributes(scene.points)
    assert set(told["emissivity"].tolist()) <= {1.0, 0.85, 0.6, 0.3, 0.1}
    assert torch.allclose(told["reflectance"], 1 - told["emissivity"])
    assert Synthetic(scene="static", size="tiny", frames=4).scene.true_attributes is None


# Fine texture -----------------------------------------------------------------------------------------


def test_tiles_are_finer_than_pixels_of_low_resolution_and_coarser_than_those_of_full():
    lens = film(Scene(PRESETS["fine_texture"]), Size(SIZES["demo"].width, SIZES["demo"].height, 2, 10)).lens
    pixel_m = 2.2 / lens.fx  # at the middle of the path
    tiles = [pattern.tile_m for pattern in PRESETS["fine_texture"].start_k.values() if pattern.step == 3.0]
    assert len(tiles) == 6
    # One to two pixels of a quarter of the resolution.
    assert 4 * pixel_m < min(tiles) and max(tiles) < 2.1 * 4 * pixel_m
