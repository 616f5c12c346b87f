"""Surfaces of exact depth maps, against the planes and spheres that these show."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import Sighting
from heatsplat.geometry.fusion import BLOCK, Surface, TooLarge, blocks_near, facing, footprint, fuse
from heatsplat.geometry.projection import look_at, to_camera
from heatsplat.geometry.sight_lines import rays

AROUND = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]


def camera(eye, target=(0.0, 0.0, 0.0), size: int = 48) -> Camera:
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]], dtype=torch.float64)
    eye, target = (torch.tensor(place, dtype=torch.float64) for place in (eye, target))
    return Camera(look_at(eye, target, torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)), K, size, size)


def plane_seen(one: Camera, height: float = 0.0) -> torch.Tensor:
    """Camera z of the plane z = height."""
    down = (rays(one) @ one.viewmat[:3, :3])[..., 2]
    depth = (height - one.center[2]) / down
    return torch.where(depth > 0, depth, torch.inf)


def sphere_seen(one: Camera, radius: float = 1.0, centre=(0.0, 0.0, 0.0)) -> torch.Tensor:
    sight, middle = rays(one), one.viewmat[:3, :3] @ torch.tensor(centre, dtype=torch.float64) + one.viewmat[:3, 3]
    a, b = sight.square().sum(-1), sight @ middle
    rest = b.square() - a * (middle @ middle - radius**2)
    return torch.where(rest > 0, (b - rest.clamp(min=0).sqrt()) / a, torch.inf)


def fused(sightings, voxel: float, truncation: float = 4.0, box=None) -> Surface:
    reach = truncation * voxel
    return fuse(sightings, blocks_near(sightings, voxel, reach, 2**24, box), voxel, reach)


def spheres() -> list[Sighting]:
    cameras = [camera([3.0 * x / np.linalg.norm(way) for x in way]) for way in AROUND for way in [np.array(way)]]
    return [Sighting(one, sphere_seen(one)) for one in cameras]


def open_edges(surface: Surface) -> int:
    """Edges that are not passed once in either direction."""
    faces = surface.faces.numpy()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, counts = np.unique(edges, axis=0, return_counts=True)
    back = {tuple(edge) for edge in there[:, ::-1]}
    return int((counts != 1).sum()) + sum(tuple(edge) not in back for edge in there)


def volume(surface: Surface) -> float:
    first, second, third = surface.vertices[surface.faces].unbind(1)
    return float((first * torch.linalg.cross(second, third)).sum() / 6)


def test_a_plane_is_found_where_it_is_and_faces_the_cameras():
    height = 0.013
    cameras = [camera(eye) for eye in ([1.0, 0.0, 2.0], [-1.0, 0.5, 2.2], [0.0, -1.2, 1.8])]
    found = fused([Sighting(one, plane_seen(one, height)) for one in cameras], 0.05)
    inner = found.vertices[:, :2].norm(dim=1) < 0.5
    assert inner.sum() > 200
    assert (found.vertices[:, 2] - height).abs().max() < 0.01 * 0.05
    assert (found.normals()[:, 2] > 0.99).all() and (found.crosses()[:, 2] > 0).all()
    # Complete where all see it: the area within the box is that of the box.
    part = found.inside(torch.tensor([[-0.5, -0.5, -1.0], [0.5, 0.5, 1.0]], dtype=torch.float64))
    assert abs(part.crosses().norm(dim=1).sum() / 2 - 1.0) < 0.15


@pytest.mark.parametrize("voxel", [0.11, 0.06])
def test_a_sphere_is_closed_and_its_normals_point_outward(voxel):
    found = fused(spheres(), voxel)
    away = found.vertices.norm(dim=1)
    assert (away - 1).abs().max() < 0.1 * voxel
    assert open_edges(found) == 0
    assert (found.normals() * found.vertices).sum(1).div(away).min() > 0.98
    assert volume(found) == pytest.approx(4 / 3 * np.pi, rel=0.03)
    assert BLOCK * voxel < 1  # of several blocks: their borders are closed, too


def test_what_others_see_through_is_carved_away():
    """One view has a sheet before the ground, where the others see the ground."""
    eyes = ([0.0, 0.3, 2.0], [1.0, 0.0, 2.0], [-1.0, 0.5, 2.2], [0.0, -1.2, 1.8], [0.5, 1.0, 2.0])
    sightings = [Sighting(one, plane_seen(one, 0.013)) for one in map(camera, eyes)]
    sheet = sightings[0].depth.clone()
    sheet[16:32, 16:32] = 1.4
    wrong = Sighting(sightings[0].camera, sheet)
    assert (fused([wrong], 0.05).vertices[:, 2] > 0.4).any()  # that is what it shows
    found = fused([wrong, *sightings[1:]], 0.05)
    assert len(found.faces) > 1000 and (found.vertices[:, 2] - 0.013).abs().max() < 0.01 * 0.05


def test_an_edge_makes_no_sheet_and_what_nobody_saw_stays_open():
    """A plate before a ground, whose pixels across its edge lie in between."""
    one = camera([0.0, 0.0, 3.0])
    depth = torch.full((48, 48), 3.0, dtype=torch.float64)
    depth[12:36, 12:36] = 2.0
    depth[12:36, [11, 36]] = 2.5
    found = fused([Sighting(one, depth)], 0.06)
    apart = torch.minimum(found.vertices[:, 2].abs(), (found.vertices[:, 2] - 1).abs())
    assert len(found.faces) > 500 and apart.max() < 0.01 * 0.06
    # The shadow of the plate on the ground: of 24 pixels at depth 2, so 24 / 48 * 3 wide there.
    x, y, z = to_camera(found.vertices, one.viewmat).abs().unbind(1)
    assert not ((x < 0.7) & (y < 0.7) & (z > 2.5)).any() and ((x < 0.4) & (y < 0.4) & (z < 2.5)).any()
    assert (found.crosses()[:, 2] > 0).all()


def test_surfaces_seen_from_the_side_tell_nothing():
    one = camera([0.0, -3.0, 0.3], (0.0, 0.0, 0.3))
    told = facing(Sighting(one, plane_seen(one)))
    angle = torch.rad2deg(torch.atan2(torch.tensor(0.3), told.depth[told.depth.isfinite()]))
    assert len(angle) and angle.min() > 8  # from the surface; 10 degrees, along the line of sight
    assert (plane_seen(one).isfinite() & told.depth.isinf()).any()


def test_masks_and_pixels_too_wide_are_left_out():
    one = camera([0.0, 0.0, 3.0])
    half = torch.arange(48).expand(48, 48) < 24
    found = fused([Sighting(one, plane_seen(one), half)], 0.08)
    assert len(found.faces) and to_camera(found.vertices, one.viewmat)[:, 0].max() < 0.08
    whole = fused([Sighting(one, plane_seen(one))], 0.08)
    assert 0.4 < found.crosses().norm(dim=1).sum() / whole.crosses().norm(dim=1).sum() < 0.6
    assert footprint([Sighting(one, plane_seen(one))]) == pytest.approx(3 / 48, rel=1e-3)
    assert not len(fused([Sighting(one, plane_seen(one))], 0.015).faces)  # a pixel is wider than 4 voxels


def test_nothing_seen_is_an_empty_surface():
    one = camera([0.0, 0.0, 3.0])
    nothing = Sighting(one, torch.full((48, 48), torch.inf))
    for sightings in ([], [nothing]):
        found = fused(sightings, 0.05)
        assert found.vertices.shape == (0, 3) and found.faces.shape == (0, 3)
        assert not len(found.without_pieces(0.1).faces)
    assert footprint([nothing]) is None


def test_too_many_voxels_are_refused():
    with pytest.raises(TooLarge) as refused:
        blocks_near(spheres(), 0.06, 0.24, 10_000)
    assert refused.value.voxels > 10_000


def test_a_box_leaves_out_what_lies_outside():
    box = torch.tensor([[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]], dtype=torch.float64)
    sightings = spheres()
    assert len(blocks_near(sightings, 0.06, 0.24, 2**24, box)) < 0.8 * len(blocks_near(sightings, 0.06, 0.24, 2**24))
    found = fused(sightings, 0.06, box=box).inside(box)
    assert (found.vertices[:, 2] >= 0).all() and (found.vertices.norm(dim=1) - 1).abs().max() < 0.006
    assert found.crosses().norm(dim=1).sum() / 2 == pytest.approx(2 * np.pi, rel=0.08)


def test_small_pieces_are_left_out_by_their_area():
    centre = (1.6, 0.0, 0.0)
    both = []
    for one in spheres():
        depth = torch.minimum(sphere_seen(one.camera), sphere_seen(one.camera, 0.25, centre))
        both.append(Sighting(one.camera, depth))
    found = fused(both, 0.06)
    assert (found.vertices[:, 0] > 1.2).any()
    share = 1 / 17
    kept = found.without_pieces(2 * share)
    assert (kept.vertices.norm(dim=1) < 1.1).all() and len(kept.faces) > 1000
    assert (found.without_pieces(0.02 * share).vertices[:, 0] > 1.2).any()
    assert len(found.without_pieces(1.0).faces) == len(kept.faces)  # the largest stays


def test_far_from_the_origin_nothing_is_lost():
    """float32 holds no voxels of 0.06 at 1e5; places are taken from the camera."""
    far = torch.tensor([1e5, -2e5, 0.0], dtype=torch.float64)
    moved = []
    for one in spheres():
        viewmat = one.camera.viewmat.clone()
        viewmat[:3, 3] -= viewmat[:3, :3] @ far
        moved.append(Sighting(Camera(viewmat, one.camera.K, 48, 48), one.depth))
    found = fused(moved, 0.06)
    assert open_edges(found) == 0 and ((found.vertices - far).norm(dim=1) - 1).abs().max() < 0.006


def test_smoothing_takes_ripples_off_and_keeps_the_size():
    sphere = fused(spheres(), 0.06)
    out = torch.nn.functional.normalize(sphere.vertices, dim=1)
    noise = 0.02 * torch.randn(len(out), 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rough = replace(sphere, vertices=sphere.vertices + noise * out)
    smooth = rough.smoothed(50)
    radii = (smooth.vertices).norm(dim=1)
    assert abs(float(radii.mean()) - 1) < 0.003  # the mean of neighbours alone (BACK = 0) makes it 0.97
    assert radii.std() < 0.35 * noise.std()

    def turned(surface):
        towards = torch.nn.functional.normalize(surface.crosses(), dim=1)
        corners = surface.vertices[surface.faces].mean(1)
        return (towards * torch.nn.functional.normalize(corners, dim=1)).sum(1).clamp(-1, 1).arccos().median()

    assert turned(smooth) < 0.2 * turned(rough)
    assert rough.smoothed(0) is rough


def test_smoothing_leaves_a_plane_with_its_border_where_it_is():
    flat = Surface(
        torch.tensor([[x, y, 0.3] for x in range(4) for y in range(4)], dtype=torch.float64),
        torch.tensor([[k, k + 4 + side, k + 5 - 4 * side] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10) for side in (0, 1)]),
    )
    smooth = flat.smoothed(20)
    assert torch.equal(smooth.faces, flat.faces)
    torch.testing.assert_close(smooth.vertices[:, 2], flat.vertices[:, 2])
