"""Meshes made of Gaussians: a scene of Gaussians on known surfaces, and a run."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from exported import at
from plyfile import PlyData
from running import BARE

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.export import made_surface
from heatsplat.export.formats.mesh import Mesh
from heatsplat.export.made_surface import closest
from heatsplat.export.moment import inside
from heatsplat.geometry.projection import to_camera
from heatsplat.geometry.sight_lines import rays
from heatsplat.runs.run import begin
from heatsplat.training.session import fit


def on_a_ball(moment, radius_share: float = 0.2, count: int = 4000):
    """A moment whose Gaussians are opaque and cover a ball, whose value grows with x, and its centre and radius."""
    scene = moment.module.scene
    centre, size = scene.bulk
    radius = radius_share * float(size)
    k = torch.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, torch.pi * (1 + 5**0.5) * k
    away = torch.stack([(1 - z**2).sqrt() * turn.cos(), (1 - z**2).sqrt() * turn.sin(), z], dim=1).float()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    scales = torch.full((count, 3), 1.5 * radius / count**0.5)
    seen = replace(moment.seen.of(torch.arange(count) % len(moment.seen.means)), attributes={})
    seen = replace(
        seen, means=centre.float() + radius * away, quats=quats, scales=scales, opacities=torch.full((count,), 0.95)
    )
    values = 0.5 + 0.3 * away[:, 0]
    return replace(moment, seen=seen, blended=values, values=moment.of_blended(values)), centre.double(), radius


def read(path):
    file = PlyData.read(path)
    vertices = file["vertex"]
    places = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    return places, np.stack(file["face"]["vertex_indices"]), vertices


def test_a_ball_of_gaussians_becomes_a_mesh_of_it_with_temperatures_and_a_picture(cooling, tmp_path):
    ball, centre, radius = on_a_ball(cooling)
    Mesh(voxel=0.1 * radius).write(ball, tmp_path / "ball.ply")
    places, faces, vertices = read(tmp_path / "ball.ply")
    away = places - (centre + ball.module.scene.origin).numpy()
    distance = np.linalg.norm(away, axis=1)
    assert abs(np.median(distance) - radius) < 0.03 * radius
    assert (np.abs(distance - radius) < 0.1 * radius).mean() > 0.95
    a, b, c = away[faces].transpose(1, 0, 2)
    assert ((np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).mean() > 0.98  # outward
    known = np.isfinite(vertices["temperature_c"])
    assert known.mean() > 0.8
    truth = ball.of_blended(torch.from_numpy(0.5 + 0.3 * away[:, 0] / distance)).numpy()
    assert np.abs(vertices["temperature_c"] - truth)[known].mean() < 0.05 * np.ptp(truth)
    assert (tmp_path / "ball.png").stat().st_size > 1000


def in_fog(ball, centre, radius, opacity=0.02):
    """Faint Gaussians between the first camera and a ball."""
    seen, view = ball.seen, ball.module.scene.train[0]
    towards = torch.nn.functional.normalize(view.camera.center - centre, dim=0).float()
    fog = replace(
        seen,
        means=torch.cat([seen.means, seen.means + 1.5 * radius * towards]),
        quats=torch.cat([seen.quats] * 2),
        scales=torch.cat([seen.scales] * 2),
        opacities=torch.cat([seen.opacities, torch.full((len(seen.means),), opacity)]),
    )
    return replace(ball, seen=fog, blended=torch.cat([ball.blended] * 2), values=torch.cat([ball.values] * 2))


def test_the_depth_is_that_of_the_surface_through_fog(cooling):
    """Faint Gaussians between the cameras and a ball move the mean depth, and not that of its surface."""
    ball, centre, radius = on_a_ball(cooling)
    foggy, view = in_fog(ball, centre, radius), ball.module.scene.train[0]
    sight = rays(view.camera)
    middle = to_camera(centre, view.camera.viewmat)
    a, b = sight.square().sum(-1), sight @ middle
    hit = b.square() - a * (middle @ middle - (0.8 * radius) ** 2) > 0  # the inner part of its disc
    truth = ((b - (b.square() - a * (middle @ middle - radius**2)).clamp(min=0).sqrt()) / a)[hit]
    depth, spread = closest(foggy, view)
    mean = foggy.look(view).depth[hit]
    error, of_mean = ((one - truth).abs().median() for one in (depth[hit], mean))
    assert error < 0.05 * radius < of_mean and spread[hit].median() < 0.2 * radius


def test_a_box_makes_a_mesh_of_a_part(cooling, tmp_path):
    ball, centre, radius = on_a_ball(cooling)
    low = centre + ball.module.scene.origin - 2 * radius
    high = low + torch.tensor([4 * radius, 4 * radius, 2 * radius], dtype=torch.float64)
    high[2] = low[2] + 4 * radius
    low[0] += 2 * radius  # the half with x above the centre
    Mesh(voxel=0.1 * radius).write(inside(ball, torch.stack([low, high])), tmp_path / "half.ply")
    places, *_ = read(tmp_path / "half.ply")
    assert len(places) > 100 and places[:, 0].min() >= float(low[0])
    distance = np.linalg.norm(places - (centre + ball.module.scene.origin).numpy(), axis=1)
    assert (np.abs(distance - radius) < 0.1 * radius).mean() > 0.95


@pytest.mark.parametrize(("truncation", "found"), [(None, True), (4.0, False), (7.0, True)])
def test_the_truncation_reaches_as_far_as_opacity_is_spread(cooling, monkeypatch, truncation, found):
    ball, _, radius = on_a_ball(cooling)
    depths = {view.frame.name: closest(ball, view)[0] for view in ball.module.scene.train}
    voxel = 0.1 * radius

    def spread(moment, view):
        depth = depths[view.frame.name]
        return depth, torch.full_like(depth, 6 * voxel).where(depth.isfinite(), torch.inf)

    monkeypatch.setattr(made_surface, "closest", spread)
    make = partial(made_surface.made_surface, ball, ball.module.scene.train, voxel, truncation, 0, 0.001)
    if found:
        assert len(make()[0].faces) > 500
    else:
        with pytest.raises(SceneError, match="spread over more than"):
            make()


def test_what_makes_no_mesh_is_said(cooling, tmp_path, monkeypatch, caplog):
    ball, _, radius = on_a_ball(cooling)
    clear = replace(ball, seen=replace(ball.seen, opacities=torch.full_like(ball.seen.opacities, 0.005)))
    with pytest.raises(
        SceneError, match=r"no training view shows a surface to make a mesh of: train longer, or give what.mesh"
    ):
        Mesh(views=3).write(clear, tmp_path / "a.ply")
    with pytest.raises(
        SceneError, match=r"no surface is found with voxels of .* Give a coarser what.voxel or a larger what.truncation"
    ):
        Mesh(views=3, voxel=0.001 * radius, truncation=4).write(ball, tmp_path / "a.ply")
    monkeypatch.setattr(made_surface, "MOST", 40_000)
    with pytest.raises(SceneError, match=r"what.voxel=.* fits, or a part of the scene \(box\)"):
        Mesh(views=3, voxel=0.03 * radius).write(ball, tmp_path / "a.ply")
    Mesh(views=3).write(ball, tmp_path / "a.ply")
    monkeypatch.setattr(made_surface, "MOST", 8_000)
    Mesh(views=3).write(ball, tmp_path / "a.ply")
    assert "box makes a finer mesh of a part" in caplog.text


def test_one_view_makes_the_side_that_it_sees(cooling, tmp_path):
    ball, centre, radius = on_a_ball(cooling)
    Mesh(views=1, voxel=0.1 * radius).write(ball, tmp_path / "a.ply")
    places, *_ = read(tmp_path / "a.ply")
    away = torch.from_numpy(places) - ball.module.scene.origin - centre
    towards = ball.module.scene.train[0].camera.center - centre
    assert len(places) > 50 and (away @ towards > 0).double().mean() > 0.95


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel": 0}, "what.voxel must be above 0"),
        ({"voxel": "fine"}, "what.voxel must be a number, got fine"),
        ({"smoothing": -1}, "what.smoothing must be a whole number, 0 or more, got -1"),
        ({"truncation": 1}, "what.truncation must be 2 voxels or more, got 1"),
        ({"least_piece": 2}, "what.least_piece must be a share of the area, from 0 to 1, got 2"),
        ({"two_sided": True}, "what.two_sided=true is for a mesh that you give"),
        ({"mesh": "a.ply", "voxel": 0.1}, "what.voxel is for a mesh that is made"),
    ],
)
def test_options_that_are_none_are_refused(options, message):
    with pytest.raises(SceneError, match=message):
        Mesh(**options)


def test_the_mesh_of_a_run_lies_on_the_true_surfaces(tmp_path):
    """As they do after 150 steps, to 0.011 of its size, a little before them; depths 3 % too small or 6 % too large fail."""
    from datamodules.synthetic_scene.presets import PRESETS
    from datamodules.synthetic_scene.shapes import nearest_surface

    run = begin(compose([*BARE, "method=3dgs", "data.scene=static", "max_steps=150"]), tmp_path)
    fit(run.module, run.data, run.trainer, test=False)
    Mesh().write(at(run.module), tmp_path / "a.ply")
    places, faces, vertices = read(tmp_path / "a.ply")
    points = torch.from_numpy(places)
    on, _ = nearest_surface([surface.shape for surface in PRESETS["static"].surfaces], points)
    errors = (on - points).norm(dim=1)
    size = float(run.module.scene.bulk[1])
    assert len(faces) > 500 and errors.median() < 0.015 * size and errors.quantile(0.9) < 0.04 * size
    assert np.isfinite(vertices["temperature_c"]).mean() > 0.8
