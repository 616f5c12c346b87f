"""Shadows, sky and light on patches against marching along rays, closed forms and sums that must hold."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from heatsplat.datamodules.sun import sun_directions
from heatsplat.datamodules.synthetic_scene.outdoor import YARD
from heatsplat.datamodules.synthetic_scene.outdoor_sky import SITE, START_UTC_S
from heatsplat.datamodules.synthetic_scene.outdoor_true import true_weather
from heatsplat.datamodules.synthetic_scene.shapes import Box, Plane
from heatsplat.datamodules.synthetic_scene.yard_light import ALBEDO, SOLAR_CONSTANT, Lighting
from heatsplat.physics.units import DAY_S

SHAPES = [surface.shape for surface in YARD]


@cache
def light() -> Lighting:
    return Lighting(SHAPES, 1.0, 2.0)


def from_boxes(points: np.ndarray) -> np.ndarray:
    """By how much a box of the yard has to grow on all sides to hold points [n, 3]: three dot products with its edges."""
    found = np.full(len(points), np.inf)
    for shape in SHAPES[1:]:
        yaw, tilt = math.radians(shape.yaw_deg), math.radians(shape.tilt_deg)
        x = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        flat = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        y = math.cos(tilt) * flat + math.sin(tilt) * np.array([0.0, 0.0, 1.0])
        offset = points - np.array(shape.center)
        axes = (x, y, np.cross(x, y))
        off = [np.abs(offset @ axis) - 0.5 * side for axis, side in zip(axes, shape.size, strict=True)]
        found = np.minimum(found, np.max(off, axis=0))
    return found


@pytest.mark.parametrize("hour", [6.0, 9.5, 12.0, 16.0])
def test_shadows_are_those_of_marching_along_the_ray(hour):
    yard = light()
    sun = torch.from_numpy(sun_directions(SITE, np.array([START_UTC_S + 3600.0 * hour]))[0])
    lit = yard.sunlit(sun).numpy()
    near = yard.centres[:, :2].norm(dim=1) < 13.0
    candidates = ((yard.normals @ sun > 0) & ~yard.covered & near).nonzero()[:, 0].numpy()
    chosen = candidates[:: max(1, len(candidates) // 300)]
    steps = np.arange(0.01, 12.0 / float(sun[2]) ** 0.5, 0.02)  # beyond the height of the ridge
    starts, hidden, clear = yard.starts.numpy()[chosen], np.zeros(len(chosen), bool), np.zeros(len(chosen), bool)
    rises = (yard.normals @ sun).numpy()[chosen]
    for i, start in enumerate(starts):
        points = start + steps[:, None] * sun.numpy()
        away = steps > max(0.1, 0.03 / rises[i])  # out of what its own box is grown by
        off = from_boxes(points)
        hidden[i] = off.min() < -0.02
        clear[i] = off.min() >= 0.0 and (off[away] >= 0.02).all()
    grazed = ~hidden & ~clear  # by an edge that the march may just miss
    assert grazed.mean() < 0.05
    assert (lit[chosen] == ~hidden)[~grazed].all()
    assert hidden.sum() > 10 and (~hidden).sum() > 10
    assert not lit[((yard.normals @ sun <= 0) | yard.covered).numpy()].any()


def test_at_night_nothing_is_sunlit():
    assert not light().sunlit(torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)).any()


def test_the_share_of_sky_is_the_view_factor():
    ground = Plane((0, 0, 0), (0, 0, 1))
    alone = Lighting([ground, Box((0.0, 0.0, 5.0), (40.0, 0.2, 10.0))], 1.0, 2.0)
    far = (alone.surface == 0) & (alone.centres[:, 1].abs() > 30)
    assert alone.sky_share[far].min() > 0.9
    walls = (alone.surface == 1) & (alone.normals[:, 2].abs() < 0.1)
    assert alone.sky_share[walls].mean() == pytest.approx(0.5, abs=0.02)
    top = alone.sky_share[(alone.surface == 1) & (alone.normals[:, 2] > 0.9)]
    assert torch.allclose(top, torch.ones_like(top))
    # Ground at the distance d from a wall of height h without end sees the sky by (1 + cos of the wall's height) / 2.
    near = (alone.surface == 0) & (alone.centres[:, 0].abs() < 3) & (alone.centres[:, 1].abs() < 8) & ~alone.covered
    d = alone.centres[near, 1].abs() - 0.1
    expected = 0.5 * (1 + d / (d * d + 100.0).sqrt())
    assert (alone.sky_share[near] - expected).abs().max() < 0.06


def test_level_open_ground_has_the_irradiance_of_the_record_and_covered_ground_none():
    weather, yard = true_weather("fair", DAY_S), light()
    sunlight = yard.sunlight(weather)
    far = (yard.surface == 0) & (yard.centres[:, :2].norm(dim=1) > 40)
    expected = weather.irradiance_w_m2.numpy()
    high = weather.sun[:, 2].numpy() > 0.2  # lower, light about the sun counts as diffuse
    off = np.abs(sunlight[:, far.numpy()] - expected[:, None])[high]
    assert off.max() < 0.02 * expected.max()
    assert yard.covered.sum() > 20 and sunlight[:, yard.covered.numpy()].max() == 0.0
    assert (sunlight[weather.sun[:, 2].numpy() < -0.02] == 0).all()


def test_a_shaded_wall_has_what_the_sky_and_the_ground_send():
    weather, yard = true_weather("fair", DAY_S), light()
    k = int(torch.searchsorted(weather.times_s, 9.5 * 3600.0))
    north = ((yard.surface == 3) & (yard.normals @ weather.sun[k] < 0)).nonzero()[:, 0]
    assert len(north)
    direct, diffuse, total = (float(getattr(weather, n)[k]) for n in ("direct_w_m2", "diffuse_w_m2", "irradiance_w_m2"))
    share = yard.sky_share[north]
    expected = (1 - direct / SOLAR_CONSTANT) * diffuse * share + ALBEDO * total * (1 - share)
    found = torch.from_numpy(yard.sunlight(weather)[k])[north].double()
    visible = ~yard.covered[north]
    assert torch.allclose(found[visible], expected[visible].double(), rtol=1e-5)


def test_points_on_a_face_lie_between_their_four_patches():
    yard = light()
    for face in yard.faces:
        along = [
            torch.linspace(0.0, n * s, 5, dtype=torch.float64) for n, s in zip(face.counts, face.sizes, strict=True)
        ]
        points = face.corner + torch.cartesian_prod(*along) @ face.sides
        patches, weights = face.corners(points)
        assert torch.allclose(weights.sum(1), torch.ones(25, dtype=torch.float64)) and weights.min() >= 0
        within = torch.cartesian_prod(*[a[1:-1] for a in along])
        at, share = face.corners(face.corner + within @ face.sides)
        if min(face.counts) > 4:
            assert torch.allclose(
                (yard.centres[at] * share[..., None]).sum(1), face.corner + within @ face.sides, atol=1e-9
            )
        assert (yard.surface[patches] == face.surface).all()
