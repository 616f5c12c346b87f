"""Splats before the first step: how many, where, and how large."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from running import TINY

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError, ViewSet
from heatsplat.geometry.neighbours import neighbour_distances
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.ply import read_splats, write_splats
from heatsplat.thermal.base import PerGaussian
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.static import Static
from heatsplat.training.init import Initialisation, Pretrained, Voxels, looks_at


class Faint(Static):
    start_opacity = 0.25


@pytest.fixture(scope="module")
def parts():
    """(scene, thermal model) of the tiny synthetic scene."""
    plain = compose([*TINY, "method=3dgs"])
    return build(plain["data"]).scene, build(plain["module"]["thermal"])


def test_a_gaussian_is_as_large_as_the_distance_to_its_neighbours(parts):
    scene, thermal = parts
    splats, _ = Initialisation(scale=0.5)(scene, thermal, seed=0)
    size = neighbour_distances(scene.points.float()).square().mean(1).sqrt()
    assert torch.allclose(splats.scales.detach(), 0.5 * size[:, None].expand(-1, 3), rtol=1e-5)


def test_what_is_known_of_a_point_counts_and_not_what_only_bounds_it(parts):
    """Images that are cut off at 0.5 where they are warmer, as of a camera that chooses its span: every second one, or all."""
    scene, _ = parts

    def looks(every):
        def decode(i):
            view = scene.train[i]
            if i % every:
                return view
            warm = view.thermal[..., 0] > 0.5
            return replace(view, thermal=view.thermal.clamp(max=0.5), ends=warm.to(torch.int8))

        return looks_at(replace(scene, train=ViewSet(scene.train.frames, decode)), scene.points, "thermal", 1)[..., 0]

    whole = looks_at(scene, scene.points, "thermal", 1)[..., 0]
    half, none = looks(2), looks(1)
    always_warm = ((whole > 0.5) | whole.isnan()).all(1) & ~whole.isnan().all(1)
    assert always_warm.sum() > 20
    assert (none[always_warm].nanmedian(1).values == 0.5).all()
    seen_by_both = always_warm & ~whole[:, 1::2].isnan().all(1) & ~whole[:, ::2].isnan().all(1)
    left = half[seen_by_both]
    assert seen_by_both.any() and (left[~left.isnan()] > 0.5).all()
    assert left.isnan().sum() > whole[seen_by_both].isnan().sum()


def test_gaussians_of_a_small_world_are_as_large_in_it_as_in_any_other(parts):
    scene, thermal = parts
    dense = scene.points.repeat(4, 1) + 1e-3 * torch.rand(4 * len(scene.points), 3, generator=torch.manual_seed(0))

    def sizes(scale: float) -> torch.Tensor:
        small = replace(scene, points=scale * dense)
        vars(small)["extent"] = scale * scene.extent  # of cameras that stand as much nearer
        return Initialisation()(small, thermal, seed=0)[0].scales.detach() / scale

    assert torch.allclose(sizes(0.01), sizes(1.0), rtol=1e-3)


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize(("asked", "opacity"), [(None, 0.25), (0.5, 0.5)])
def test_gaussians_are_as_opaque_as_their_model_has_it_unless_asked(parts, wrapped, asked, opacity):
    thermal = Faint(modality="thermal")
    splats, _ = Initialisation(opacity=asked)(parts[0], Composed(thermal) if wrapped else thermal, seed=0)
    assert torch.allclose(splats.opacities.detach(), torch.tensor(opacity))


def test_a_gaussian_lies_in_the_plane_of_its_neighbours_and_is_as_thick_as_they_are(parts):
    scene, thermal = parts
    generator = torch.Generator().manual_seed(0)
    wall, cloud = (torch.rand(2000, 3, generator=generator) for _ in range(2))
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    wall = wall[:, :1] * across + wall[:, 1:2] * torch.linalg.cross(normal, across) + 1e-4 * wall[:, 2:] * normal
    balls, planes = (
        Initialisation(thinnest=thinnest)(replace(scene, points=torch.cat([wall, cloud + 5.0])), thermal, seed=0)[0]
        for thinnest in (1.0, 0.1)
    )
    assert torch.equal(planes.scales[:, :2], balls.scales[:, :2])  # as wide
    shares = (planes.scales / balls.scales)[:, 2].detach()
    assert (
        torch.allclose(shares[:2000], torch.tensor(0.1)) and 0.5 < shares[2000:].median() < 0.8 and shares.max() <= 1.0
    )
    thin = quats_to_matrices(planes.quats)[:2000, :, 2].detach()
    assert (thin @ normal).abs().min() > 0.99
    assert torch.equal(balls.quats, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4000, 4))


def test_points_on_a_line_start_as_balls(parts):
    scene, thermal = parts
    line = torch.linspace(0, 1, 40)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    splats, _ = Initialisation(thinnest=0.1)(replace(scene, points=line), thermal, seed=0)
    assert torch.equal(splats.scales, splats.scales[:, :1].expand(-1, 3)) and splats.quats.isfinite().all()


@pytest.mark.parametrize(
    ("asked", "start"),
    [
        (["method=etgs"], (0.1, 0.6)),
        (["method=etgs", "recipe=published"], (1.0, 0.1)),
        (["method=etgs", "init=random"], (1.0, 0.1)),
        (["method=energy_balance"], (0.1, 0.1)),
        (["method=energy_balance", "init.opacity=0.5"], (0.1, 0.5)),
    ],
)
def test_published_and_drawn_gaussians_start_as_faint_balls_and_those_of_a_balance_as_faint_discs(asked, start):
    plain = compose(asked)
    init, thermal = plain["init"], build(plain["module"]["thermal"])
    assert (init["thinnest"], init["opacity"] or thermal.start_opacity) == start


@pytest.mark.parametrize(
    ("name", "item", "told"),
    [
        ("means", lambda n: PerGaussian(torch.zeros(n), 0.1), "'means' .* is the name of a tensor of the geometry"),
        ("level", lambda n: torch.zeros(n), "'level' in per_gaussian of Declares is of type Tensor: give PerGaussian"),
        (
            "level",
            lambda n: PerGaussian(torch.zeros(n).int(), 0.1),
            r"must start from floats .*, got torch.int32 \[\d+\]",
        ),
        ("level", lambda n: PerGaussian(torch.zeros(3), 0.1), r"one row for each Gaussian, got torch.float32 \[3\]"),
        ("level", lambda n: PerGaussian(torch.full((n,), math.nan), 0.1), r"'level' .* from \d+ values that are NaN"),
        ("level", lambda n: PerGaussian(torch.zeros(n), -1e-3), "'level' .* has a learning rate of -0.001"),
        ("level", lambda n: PerGaussian(torch.zeros(n), "fast"), "'level' .* has a learning rate of fast"),
    ],
)
def test_declared_tensors_of_another_kind_are_named(parts, name, item, told):
    class Declares(Static):
        def per_gaussian(self, seeds):
            return super().per_gaussian(seeds) | {name: item(len(seeds.means))}

    with pytest.raises(ValueError, match=told):
        Initialisation()(parts[0], Declares(), seed=0)


@pytest.mark.parametrize("source", ["sfm", "random"])
def test_no_more_start_than_density_control_allows(parts, source, caplog):
    scene, thermal = parts
    start = Initialisation(source, count=None if source == "sfm" else 300)
    whole, _ = start(scene, thermal, seed=0)
    with caplog.at_level(logging.INFO):
        same, _ = start(scene, thermal, seed=0, cap_max=len(whole))
        assert len(start(scene, thermal, seed=0, cap_max=math.inf)[0]) == len(whole)
        assert not caplog.records
        first, second = (start(scene, thermal, seed=0, cap_max=100)[0] for _ in range(2))
    assert f"init: 100 of {len(whole)} Gaussians, as many as density.cap_max allows" in caplog.text
    assert all(torch.equal(whole[name], same[name]) for name in whole.names)
    assert len(first) == 100 and torch.equal(first["means"], second["means"])
    if source == "sfm":
        assert (first["means"].detach()[:, None] == scene.points.float()).all(-1).any(1).all()


@pytest.mark.parametrize("source", ["sfm", "random"])
@pytest.mark.parametrize(("options", "told"), [({"count": -5}, "got 1.0 and -5"), ({"count": 0}, "init.count at least 1"),
                                               ({"scale": 0.0}, "init.scale must be above 0"),
                                               ({"thinnest": 0.0}, "init.thinnest must lie in .0, 1., got 0.0")])  # fmt: skip
def test_no_gaussians_and_no_size_are_refused(source, options, told):
    with pytest.raises(ValueError, match=told):
        Initialisation(source, **options)


def test_cubes_without_an_edge_are_refused():
    with pytest.raises(ValueError, match="init.voxel must be above 0, or null, got 0"):
        Voxels(0)


def test_clouds_of_their_own_share_the_cap(parts):
    scene, _ = parts
    plain = compose([*TINY, "method=msmg"])
    splats, _ = Initialisation(separate=True)(scene, build(plain["module"]["thermal"]), seed=0, cap_max=101)
    assert len(splats) == 100


def cloud_file(path, scene, **more):
    count = min(50, len(scene.points))
    shape = scene.points[:count], torch.full((count, 3), -2.0), torch.ones(count, 4), torch.zeros(count)
    write_splats(path, *shape, torch.rand(count, 3, generator=torch.Generator().manual_seed(0)), **more)
    return Pretrained(str(path)), read_splats(path)


def test_a_file_of_colours_starts_a_model_of_colours_with_its_harmonics(tmp_path, caplog):
    plain = compose([*TINY, "method=3dgs", "data.scene=glass"])
    scene = build(plain["data"]).scene
    start, file = cloud_file(tmp_path / "a.ply", scene, sh_rest=np.full((50, 8, 3), 0.1))
    splats, _ = start(scene, Static(sh_degree=1, channels=3, modality="rgb"), seed=0)
    colours = 0.5 + C0 * splats["sh0"][:, 0].detach().numpy()
    np.testing.assert_allclose(colours, file["values"], atol=1e-6)
    assert torch.equal(splats["sh_rest"].detach(), torch.full((50, 3, 3), 0.1))
    with caplog.at_level(logging.INFO):
        start(scene, Static(), seed=0)
    assert "colours, spherical harmonics of the file are not taken" in caplog.text


def test_a_file_of_temperatures_starts_a_thermal_model_in_the_bounds_of_the_scene(parts, tmp_path):
    scene, thermal = parts
    bounds = scene.thermal_range
    celsius = np.linspace(bounds.min_c, bounds.max_c, 50)
    start, _ = cloud_file(tmp_path / "a.ply", scene, temperature_k=celsius + 273.15)
    splats, _ = start(scene, thermal, seed=0)
    values = 0.5 + C0 * splats["sh0"][:, 0, 0].detach().numpy()
    np.testing.assert_allclose(values, np.linspace(0, 1, 50), atol=1e-5)


@pytest.mark.parametrize(
    ("move", "told"),
    [
        (
            lambda means, scene: torch.cat([means[:5], -50.0 * torch.ones(45, 3)]),
            "training views see 10 % of its Gauss",
        ),
        (lambda means, scene: means.mean(0) + 1e-3 * (means - means.mean(0)), "its Gaussians extend over 0.00"),
        (lambda means, scene: means, ""),
    ],
)
def test_gaussians_of_another_world_are_warned_of(parts, tmp_path, caplog, move, told):
    scene, thermal = parts
    means = move(scene.points[:50], scene)
    write_splats(
        tmp_path / "a.ply", means, torch.full((50, 3), -2.0), torch.ones(50, 4), torch.zeros(50), torch.rand(50, 3)
    )
    with caplog.at_level(logging.WARNING):
        Pretrained(str(tmp_path / "a.ply"))(scene, thermal, seed=0)
    assert told in caplog.text and ("another world: give a .ply" in caplog.text) == bool(told)


def test_gaussians_that_no_view_sees_are_refused(parts, tmp_path):
    scene, thermal = parts
    behind = scene.train.frames[0].camera.center.float() + 1e4 * torch.tensor([0.0, -1.0, 0.0])
    write_splats(
        tmp_path / "a.ply", behind.expand(9, 3), torch.zeros(9, 3), torch.ones(9, 4), torch.zeros(9), torch.rand(9, 3)
    )
    with pytest.raises(SceneError, match=r"a.ply: no training view of scene '.*' sees any of its Gaussians: give a"):
        Pretrained(str(tmp_path / "a.ply"))(scene, thermal, seed=0)
