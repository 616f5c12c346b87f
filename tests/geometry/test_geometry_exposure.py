"""Directions of sun and sky, and what is left of an even sky where some of them are hidden."""

import math

import pytest
import torch

from heatsplat.contracts import Weather
from heatsplat.datamodules.sun import Site
from heatsplat.datamodules.sun import sun_directions as sun_at
from heatsplat.geometry.exposure import felt_directions, lit_beside, open_share, sky_directions, sun_directions

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
DAY_S = 86400.0


def test_half_the_hemisphere_is_left_beside_a_wall_without_end():
    directions = sky_directions(4096, UP)
    beside = (directions[:, 0] > 0).double()[None]  # the wall takes all directions of one side
    level = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    assert open_share(level, directions, beside).item() == pytest.approx(0.5, abs=2e-3)
    assert open_share(level, directions, torch.ones(1, 4096)).item() == pytest.approx(1.0)
    weights = directions[:, 2]  # an even sky on level ground: the mean cosine is a half
    assert weights.mean().item() == pytest.approx(0.5, abs=1e-3)


def test_directions_of_the_sun_stand_for_all_of_its_way():
    angle = torch.linspace(-2.0, 8.0, 500, dtype=torch.float64)
    sun = torch.stack((angle.cos(), 0.6 * angle.sin(), 0.8 * angle.sin()), dim=1)
    ways = sun_directions(sun, UP)
    risen = sun[sun[:, 2] > 0]
    apart = (risen @ ways.T).amax(1).clamp(max=1).acos()
    assert apart.max() <= math.radians(1.2501)
    assert 70 < len(ways) < 160  # once for all days
    assert torch.equal(sun_directions(-UP.expand(3, 3), UP), UP[None])  # a polar night


def test_of_a_year_the_sun_is_looked_from_finely_where_images_feel_it_and_coarsely_elsewhere():
    times = torch.arange(0.0, 365 * DAY_S, 1800.0, dtype=torch.float64)
    sun = torch.from_numpy(sun_at(Site(47.0, 9.0), times.numpy() + 1704067200.0))
    year = Weather(times, sun=sun)

    def apart(ways, when):
        risen = sun[when & (sun[:, 2] > 0)]
        return math.degrees((risen @ ways.T).amax(1).clamp(max=1).acos().max())

    noon = 200.5 * DAY_S
    week = (times > noon - 7 * DAY_S) & (times <= noon)
    of_a_day = felt_directions(year, [noon - 3600.0, noon, None])
    assert apart(of_a_day, week) <= 1.2501 and apart(of_a_day, times >= 0) <= 4.0001
    assert len(of_a_day) < 0.25 * len(sun_directions(sun, UP))
    of_all = felt_directions(year, (torch.arange(365) * DAY_S).tolist())
    assert len(of_all) <= 1024 and apart(of_all, times >= 0) < 3.0
    short = Weather(times[:300], sun=sun[:300])  # six days, as they are felt by an image at their end
    assert torch.equal(felt_directions(short, [float(times[299])]), sun_directions(sun[:300], UP))
    assert torch.equal(felt_directions(short, [None]), sun_directions(sun[:300], UP))
    night = Weather(times[:1000], sun=torch.where(times[:1000, None] > 9 * DAY_S, -sun[:1000].abs(), sun[:1000]))
    assert apart(felt_directions(night, [20 * DAY_S]), times < 9 * DAY_S) <= 4.0001  # by images of a polar night


def test_a_roof_keeps_the_light_from_above_and_not_from_the_side():
    at = torch.arange(20, dtype=torch.float64) * 0.1
    level = torch.stack(torch.meshgrid(at, at, indexing="ij"), 2).flatten(0, 1)
    ground = torch.cat([level, torch.zeros(len(level), 1)], 1)
    roof = torch.cat([level[level[:, 0] < 1.0], torch.full((200, 1), 1.0)], 1)
    around = torch.cat([ground, roof])
    lit = lit_beside(ground, around, torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6]], dtype=torch.float64))
    covered = ground[:, 0] < 0.95
    assert (lit[covered, 0] == 0).all() and (lit[ground[:, 0] > 1.15, 0] == 1).all()
    # Light that comes in from the open side at 37 degrees reaches the floor beside the edge.
    assert (lit[(ground[:, 0] > 0.0) & (ground[:, 0] > 0.99), 1] == 1).all() and lit[:, 1].mean() > lit[:, 0].mean()
    assert lit_beside(ground, around, torch.zeros(0, 3, dtype=torch.float64)).shape == (400, 0)


def test_points_that_occur_twice_and_one_far_away_hide_nothing_more():
    """Cells as small as nothing, or all those between here and far away, would take more memory than there is."""
    points = torch.rand(600, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ways = sky_directions(16, UP)
    lit = lit_beside(points, points, ways)
    assert 0.3 < lit.mean() < 0.7
    assert torch.equal(lit_beside(points, points.repeat(2, 1), ways), lit)
    far = torch.tensor([[4.2e10, 0.0, 1.0]], dtype=torch.float64)
    assert (lit_beside(points, torch.cat([points, far]), ways).mean(0) - lit.mean(0)).abs().max() < 0.1
    assert (lit_beside(points[:1], points[:1].expand(5, 3), ways) == 1).all()  # nowhere else is anything
