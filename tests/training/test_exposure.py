"""Shadows and hidden sky by splatted depth, against what is known of a wall, a street and the yard's own rays."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet, Weather
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
from heatsplat.datamodules.synthetic_scene.shapes import trace
from heatsplat.geometry.exposure import sun_directions
from heatsplat.renderers.settings import Renderer
from heatsplat.thermal.base import SUN_SEEN
from heatsplat.training.exposure import Exposure
from heatsplat.training.normals import Discs, Normals

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
SPACING = 0.25


def sheet(corner, along, up, lengths, normal, spacing=SPACING):
    """Centres and normals of flat Gaussians on a rectangle."""
    counts = [round(length / spacing) for length in lengths]
    rows, columns = torch.meshgrid(*((torch.arange(n) + 0.5) * spacing for n in counts), indexing="ij")
    spots = torch.tensor(corner) + rows.reshape(-1, 1) * torch.tensor(along) + columns.reshape(-1, 1) * torch.tensor(up)
    return spots, torch.tensor(normal).expand(len(spots), 3)


def looked_at(*sheets, spacing=SPACING):
    """A scene of such Gaussians, and they themselves."""
    means, normals = (torch.cat(parts) for parts in zip(*sheets, strict=True))
    scales = torch.full_like(means, 0.6 * spacing)
    scales = torch.where(normals.abs() > 0.5, 0.02, scales)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    views = ViewSet([Frame("0.png", 0, Camera(torch.eye(4), torch.eye(3), 4, 4), 0.0)], lambda i: None)
    times = torch.tensor([0.0, 60.0], dtype=torch.float64)
    scene = SceneData("sheets", views, views, views, means, weather=Weather(times, sun=UP.expand(2, 3), up=UP))

    return scene, Discs((means, quats, scales, torch.full((1, len(means)), 0.99)), normals)


def test_a_wall_shades_the_ground_as_far_as_its_height_says():
    ground = sheet((-8.0, -4.0, 0.0), (1.0, 0, 0), (0, 1.0, 0), (16.0, 8.0), (0.0, 0, 1))
    wall = sheet((0.0, -4.0, 0.0), (0, 1.0, 0), (0, 0, 1.0), (8.0, 3.0), (1.0, 0, 0))
    scene, discs = looked_at(ground, wall)
    means, normals = discs.shapes[0], discs.normals
    for height in (30.0, 45.0, 60.0):  # of the sun, in the east (x)
        radians = math.radians(height)
        sun = torch.tensor([[math.cos(radians), 0.0, math.sin(radians)]], dtype=torch.float64)
        lit = Exposure(allowance=1.5).open(scene, Renderer("cpu"), discs, sun)[:, 0]
        level = (normals[:, 2] > 0) & (means[:, 1].abs() < 3)
        reach = 3.0 / math.tan(radians)  # of the shadow, to the west of the wall
        margin = 0.6
        dark = level & (means[:, 0] < -margin) & (means[:, 0] > -reach + margin)
        bright = level & ((means[:, 0] > margin) | (means[:, 0] < -reach - margin))
        assert dark.sum() > 50
        assert lit[dark].max() < 0.05 and lit[bright].min() > 0.95, height
        assert lit[(normals[:, 0] > 0) & (means[:, 1].abs() < 3)].min() > 0.95  # the wall does not shade itself
        soft = lit[level & (means[:, 0] < -margin)].sum() * SPACING**2 / 6.0 - (8.0 - reach)
        assert abs(float(soft) + margin) < 0.4, height  # of metres of lit ground, in the mean


def test_shadows_are_those_of_any_other_world_in_a_small_one():
    ground = sheet((-8.0, -4.0, 0.0), (1.0, 0, 0), (0, 1.0, 0), (16.0, 8.0), (0.0, 0, 1))
    wall = sheet((0.0, -4.0, 0.0), (0, 1.0, 0), (0, 0, 1.0), (8.0, 3.0), (1.0, 0, 0))
    scene, discs = looked_at(ground, wall)
    (means, quats, scales, opacities), unit = discs.shapes, 1e-5
    names, renderer = (SUN_SEEN,), Renderer("cpu", near=1e-7)

    def lit(scene, discs):
        exposure = Exposure()
        exposure.prepare(scene, renderer, discs, names)
        return exposure.look(discs.shapes[0])[SUN_SEEN]

    slanted = replace(scene.weather, sun=torch.nn.functional.normalize(torch.tensor([[1.0, 0, 1], [1, 0, 2]])).double())
    scene = replace(scene, weather=slanted)
    small = Discs((unit * means, quats, unit * scales, opacities), discs.normals)
    known = lit(scene, discs)
    assert known.min() < 0.05  # in the shadow of the wall
    assert torch.allclose(lit(replace(scene, points=unit * means), small), known, atol=0.02)


@pytest.mark.parametrize(("width", "height"), [(12.0, 12.0), (12.0, 6.0)])
def test_the_floor_of_a_street_sees_the_sky_that_geometry_leaves_it(width, height):
    """Closed form for a canyon without end (Oke 1987): from its middle cos(atan(2 H / W)).

    Splats are wider than what they stand for by most of a pixel of 0.4 m and half a Gaussian, which costs some sky.
    """
    half, length = 0.5 * width, 60.0
    floor = sheet((-half, -0.5 * length, 0.0), (1.0, 0, 0), (0, 1.0, 0), (width, length), (0.0, 0, 1), 0.5)
    left = sheet((-half, -0.5 * length, 0.0), (0, 1.0, 0), (0, 0, 1.0), (length, height), (1.0, 0, 0), 0.5)
    right = sheet((half, -0.5 * length, 0.0), (0, 1.0, 0), (0, 0, 1.0), (length, height), (-1.0, 0, 0), 0.5)
    scene, discs = looked_at(floor, left, right, spacing=0.5)
    means, normals = discs.shapes[0], discs.normals
    seen = Exposure(directions=100, allowance=1.5).sky(scene, Renderer("cpu"), discs)
    middle = (normals[:, 2] > 0) & (means[:, 0].abs() < 1) & (means[:, 1].abs() < 4)
    truth = math.cos(math.atan(2 * height / width))
    assert truth - 0.06 < seen[middle].mean().item() < truth + 0.02


def test_the_yard_is_lit_as_rays_say(monkeypatch):
    """Of a yard's points, against its boxes by ray tracing: shadows that are found outweigh those that are not there."""
    scene, world = Synthetic(scene="outdoor", size="demo", frames=8).scene, OutdoorScene(OUTDOOR["outdoor"])
    normals, exposure = Normals(views=12), Exposure(side=192)
    normals.prepare(scene, Renderer("cpu"), scene.points)
    exposure.prepare(scene, Renderer("cpu"), normals.discs, ["sun_seen"])
    found = exposure.look(scene.points)
    assert set(found) == {"sun_seen"}
    monkeypatch.setattr("heatsplat.training.exposure.TOGETHER", len(scene.points))
    assert torch.equal(exposure.look(scene.points)["sun_seen"], found["sun_seen"])  # however many are looked up at once
    exposure.prepare(scene, Renderer("cpu", near=1.0, far=30.0), normals.discs, ["sun_seen"])  # of the run's views
    assert torch.equal(exposure.look(scene.points)["sun_seen"], found["sun_seen"])
    directions = sun_directions(scene.weather.sun, scene.weather.up)
    some = range(2, len(directions), 9)
    on, which = world.nearest(scene.points.double())
    facing = world.normals(on, which)
    rays = [trace(world.shapes, on + 1e-3 * facing, directions[k].expand(len(on), 3))[0].isinf() for k in some]
    truth = torch.stack(rays, dim=1).float()
    weights = (facing @ directions[some].T).clamp(min=0.0)
    error, without = (((shares - truth).abs() * weights).sum() for shares in (found["sun_seen"][:, some], 1.0))
    assert found["sun_seen"].shape == (len(scene.points), len(directions))
    assert error < 0.6 * without
    with pytest.raises(ValueError, match="exposure.directions and side must be at least 1"):
        Exposure(side=0)
