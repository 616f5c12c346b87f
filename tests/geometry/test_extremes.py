"""Hot and cold rectangles on a wall and a box before it: found where they are, as large as they are."""

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.extremes import extremes
from heatsplat.geometry.looks import Look, surface_points
from heatsplat.geometry.projection import look_at


def look(x: float, tilt: float = 0.0) -> Look:
    """A camera before the wall z = 4, seen from the side: a hot patch of 1 x 0.5 on it, two cold ones."""
    eye = torch.tensor([x, 0.3, 0.0], dtype=torch.float64)
    viewmat = look_at(eye, torch.tensor([tilt, 0.0, 4.0], dtype=torch.float64), torch.tensor([0.0, -1.0, 0.0]).double())
    K = torch.tensor([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(viewmat, K, 160, 120)
    rows, columns = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    rays = torch.stack([(columns + 0.5 - 80) / 150, (rows + 0.5 - 60) / 150, torch.ones(120, 160)], -1).double()
    world = rays @ viewmat[:3, :3]
    depth = (4.0 - eye[2]) / world[..., 2]  # along the ray of camera z = 1
    points = eye + world * depth[..., None]
    values = torch.full((120, 160), 20.0).double() + 0.01 * points[..., 0]

    def inside(cx, cy, w, h):
        return ((points[..., 0] - cx).abs() < w / 2) & ((points[..., 1] - cy).abs() < h / 2)

    values[inside(-0.5, 0.2, 1.0, 0.5)] = 40.0
    values[inside(0.8, 0.5, 0.6, 0.6)] = 5.0
    values[inside(0.8, -0.7, 0.3, 0.3)] = 2.0
    return Look(camera, depth, values)


@pytest.mark.parametrize("shown", [[0.0], [-1.5, -0.5, 0.0, 0.7, 2.0]])
def test_surfaces_are_found_where_they_are_and_as_large_as_they_are(shown):
    looks = [look(x, 0.1 * x) for x in shown]
    hot, cold = extremes(looks, share=0.03)
    cold = [one for one in cold if one.mean < 10]  # the share is more than the patches where more is seen
    assert len(cold) == 2
    assert (hot[0].mean, hot[0].most) == pytest.approx((40.0, 40.0))
    assert hot[0].area == pytest.approx(0.5, rel=0.03)
    assert hot[0].centre.tolist() == pytest.approx([-0.5, 0.2, 4.0], abs=0.03)
    assert [one.mean for one in cold] == pytest.approx([2.0, 5.0])
    assert cold[0].area == pytest.approx(0.09, rel=0.2)
    assert cold[0].centre.tolist() == pytest.approx([0.8, -0.7, 4.0], abs=0.03)


def test_what_lies_far_beside_the_reconstruction_is_no_surface():
    """A cold spot three metres behind the wall at the border of one look, which no other denies."""
    seen = look(0.0)
    border = torch.zeros_like(seen.values, dtype=torch.bool)
    border[:20, :20] = True
    wrong = Look(seen.camera, seen.depth + 3.0 * border, torch.where(border, -20.0, seen.values))
    box = tuple(torch.tensor([-5.0, -5.0, z], dtype=torch.float64) for z in (3.8, 4.2))
    box[1][:2] = 5.0
    assert extremes([wrong], share=0.03)[1][0].mean == pytest.approx(-20.0)
    assert extremes([wrong], share=0.03, box=box)[1][0].mean == pytest.approx(2.0)


def test_nothing_is_seen_where_there_is_no_surface():
    seen = look(0.0)
    assert extremes([Look(seen.camera, torch.full_like(seen.depth, torch.inf), seen.values)]) == ([], [])


def test_the_centre_lies_on_the_surface():
    """Of a hot ring about a cool middle, which holds its centre of mass."""
    seen = look(0.0)
    points = surface_points(seen.camera, seen.depth)
    away = (points[..., :2] - torch.tensor([0.1, 0.2], dtype=torch.float64)).norm(dim=-1)
    ring = torch.where((away > 0.5) & (away < 0.7), 30.0, 20.0).double()
    (hot, *_), _ = extremes([Look(seen.camera, seen.depth, ring)], share=0.03)
    assert hot.mean == pytest.approx(30.0)
    assert 0.45 < (hot.centre[:2] - torch.tensor([0.1, 0.2], dtype=torch.float64)).norm() < 0.75


def test_what_one_look_alone_puts_behind_a_wall_is_no_surface():
    """A look whose hot patch lies a metre behind the wall that two others see; where those do not look, it counts."""
    right, wrong = [look(-0.5), look(0.5)], look(0.0)
    behind = wrong.values == 40.0
    depth = torch.where(behind, wrong.depth + 1.0, wrong.depth)
    cool = [Look(one.camera, one.depth, one.values.clamp(max=25.0)) for one in right]
    (hot, *_), _ = extremes([*cool, Look(wrong.camera, depth, wrong.values)], share=0.03)
    assert hot.mean < 26.0
    blind = [Look(one.camera, torch.full_like(one.depth, torch.inf), one.values) for one in cool]
    (hot, *_), _ = extremes([*blind, Look(wrong.camera, depth, wrong.values)], share=0.03)
    assert hot.mean == pytest.approx(40.0) and hot.centre[2].item() == pytest.approx(5.0, abs=0.03)


@pytest.mark.parametrize("seed", range(12))
def test_all_of_a_scene_may_count_as_hot_and_as_cold(seed):
    seen, generator = look(0.0), torch.Generator().manual_seed(seed)
    rough = Look(seen.camera, seen.depth * (1 + 0.01 * torch.rand(120, 160, generator=generator)), seen.values)
    hot, cold = extremes([rough, rough], share=1.0)
    assert hot[0].mean == pytest.approx(cold[0].mean) and hot[0].area > 10
