"""The ray tracer against brute force: walking along rays and asking whether a point is inside."""

from __future__ import annotations

import math

import pytest
import torch

from heatsplat.datamodules.synthetic_scene import shapes as synthetic_shapes
from heatsplat.datamodules.synthetic_scene.presets import TABLE_TOP
from heatsplat.datamodules.synthetic_scene.shapes import Box, Cylinder, Plane, Sphere, nearest_surface, trace

BOX = Box((0.3, -0.2, 0.5), (0.8, 0.5, 1.1), 33.0)
SPHERE = Sphere((-0.2, 0.4, 0.1), 0.6)
CYLINDER = Cylinder((0.1, 0.2, -0.4), 0.45, 0.9)
PLANE = Plane((0.0, 0.0, -0.7), (0.0, 0.6, 0.8))
SHAPES = [BOX, SPHERE, CYLINDER, PLANE]


def inside(shape, points: torch.Tensor) -> torch.Tensor:
    """Whether points lie inside, from the definition of each shape and not from its methods."""
    x, y, z = points.unbind(-1)
    if shape is BOX:
        angle = math.radians(33.0)
        x, y, z = x - 0.3, y + 0.2, z - 0.5
        along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        return (along.abs() < 0.4) & (across.abs() < 0.25) & (z.abs() < 0.55)
    if shape is SPHERE:
        return (x + 0.2) ** 2 + (y - 0.4) ** 2 + (z - 0.1) ** 2 < 0.36
    if shape is CYLINDER:
        return ((x - 0.1) ** 2 + (y - 0.2) ** 2 < 0.45**2) & (z > -0.4) & (z < 0.5)
    return 0.6 * y + 0.8 * (z + 0.7) < 0


def random_rays(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from a shell around the shapes to points among them; directions are not of unit length."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1) * 3
    origins[:, 2] = origins[:, 2].abs() + 2.0  # above the plane
    targets = 1.2 * (2.0 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1.0)
    return origins, (targets - origins) * (0.3 + torch.rand(count, 1, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_first_hit_agrees_with_walking_along_the_ray(shape):
    origins, directions = random_rays(400)
    reach, steps = 6.0, 6000
    t = torch.linspace(0.0, reach, steps, dtype=torch.float64)
    walked = inside(shape, origins[:, None] + t[:, None] * directions[:, None])
    first = torch.where(walked.any(1), walked.to(torch.int8).argmax(1), steps)
    distance = shape.intersect(origins, directions)
    step = reach / (steps - 1)
    hit = distance < reach
    assert int(hit.sum()) > 50 and (shape is PLANE or int((~hit).sum()) > 20)
    # Within a step before the first inside sample lies the surface.
    found = first < steps
    assert not (found & ~hit).any()
    gap = t[first[found]] - distance[found]
    assert gap.min() >= -1e-12 and gap.max() <= step + 1e-12
    # A hit that the walk stepped over is a corner cut by less than a step.
    for origin, ray, at in zip(origins[hit & ~found], directions[hit & ~found], distance[hit & ~found], strict=True):
        near = at + torch.linspace(0.0, step, 2000, dtype=torch.float64)[1:]
        assert inside(shape, origin + near[:, None] * ray).any()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_hits_lie_on_the_surface_and_normals_point_out(shape):
    origins, directions = random_rays(400, seed=1)
    distance = shape.intersect(origins, directions)
    hit = torch.isfinite(distance)
    points = origins[hit] + distance[hit, None] * directions[hit]
    normals = shape.normals(points)
    assert torch.allclose(normals.norm(dim=1), torch.ones(len(normals), dtype=torch.float64))
    assert not inside(shape, points + 1e-9 * normals).any()
    assert inside(shape, points - 1e-9 * normals).all()
    assert ((normals * directions[hit]).sum(1) < 0).all()
    assert (shape.nearest(points) - points).norm(dim=1).max() < 1e-12


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_nearest_point_is_on_the_surface_and_no_other_is_nearer(shape):
    generator = torch.Generator().manual_seed(2)
    points = 2.0 * (2.0 * torch.rand(200, 3, generator=generator, dtype=torch.float64) - 1.0)
    nearest = shape.nearest(points)
    # Towards a point deep inside, which is inwards at edges and corners too.
    inwards = torch.tensor(
        {BOX: (0.3, -0.2, 0.5), SPHERE: (-0.2, 0.4, 0.1), CYLINDER: (0.1, 0.2, 0.05)}.get(shape, (0, 0, -9))
    )
    step = 1e-9 * (inwards - nearest)
    assert inside(shape, nearest + step).all()
    assert not inside(shape, nearest - step).any()
    origins, directions = random_rays(20000, seed=3)
    distance = shape.intersect(origins, directions)
    surface = (origins + distance[:, None] * directions)[torch.isfinite(distance)]
    best = torch.cdist(points, surface).amin(1)
    assert ((nearest - points).norm(dim=1) <= best + 1e-9).all()


def test_rays_along_the_axes_of_a_box_divide_by_zero_and_are_right():
    box = Box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    origins = torch.tensor([[-3.0, 0.5, 0.5], [-3.0, 1.5, 0.0], [0.0, 0.0, 5.0], [3.0, 0.0, 0.0]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -2.0], [1.0, 0, 0]], dtype=torch.float64)
    assert box.intersect(origins, directions).tolist() == [2.0, math.inf, 2.0, math.inf]


def test_vertical_and_flat_rays_meet_a_cylinder():
    cylinder = Cylinder((0.0, 0.0, 0.0), 1.0, 2.0)
    origins = torch.tensor([[0.5, 0.0, 5.0], [1.5, 0.0, 5.0], [-4.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    directions = torch.tensor([[0, 0, -1.0], [0, 0, -1.0], [1.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64)
    assert cylinder.intersect(origins, directions).tolist() == [3.0, math.inf, 3.0, 1.0]


def test_nothing_behind_the_origin_is_hit():
    origins, directions = random_rays(300, seed=4)
    for shape in SHAPES:
        ahead = shape.intersect(origins, directions)
        assert (ahead > 0).all()
        met = ahead < 50.0
        past = origins[met] + 50.0 * directions[met]
        assert torch.isinf(shape.intersect(past, directions[met])).all()


@pytest.mark.parametrize("at_once", [1, 15_000, 2**16])
def test_trace_returns_the_nearest_shape_and_skips_none(monkeypatch, at_once):
    """The tracer asks a shape only about rays that come near it; asking about all must give the same."""
    monkeypatch.setattr(synthetic_shapes, "_AT_ONCE", at_once)
    shapes = [surface.shape for surface in TABLE_TOP]
    generator = torch.Generator().manual_seed(5)
    origins = torch.rand(5000, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [2.0, 1.0, 1.5]
    ) - torch.tensor([1.0, 2.2, 0.0])
    directions = torch.randn(5000, 3, generator=generator, dtype=torch.float64)
    directions[::2] = directions[::2] * torch.tensor([0.5, 0.3, 0.3]) - origins[::2]  # half of them towards the objects
    distance, which = trace(shapes, origins, directions)
    each = torch.stack([shape.intersect(origins, directions) for shape in shapes])
    best, expected = each.min(0)
    assert torch.equal(distance, best)
    hit = torch.isfinite(best)
    assert torch.equal(which[hit], expected[hit])
    assert set(which[hit].tolist()) == set(range(len(shapes)))
    alone, _ = trace(shapes[4:], origins, directions)  # without floor and walls, most rays meet nothing
    assert torch.equal(alone, each[4:].amin(0)) and 0.02 < torch.isfinite(alone).double().mean() < 0.5
    one, _ = trace(shapes, origins[:1], directions)
    assert torch.equal(one, trace(shapes, origins[:1].expand_as(directions), directions)[0])


def test_nearest_surface_picks_the_right_shape():
    points = torch.tensor([[0.0, 0.0, -0.01], [0.05, -0.15, 0.45], [0.5, -0.35, 0.43]], dtype=torch.float64)
    on_surface, which = nearest_surface([surface.shape for surface in TABLE_TOP], points)
    assert [TABLE_TOP[i].name for i in which] == ["floor", "vase", "can"]
    assert on_surface.tolist() == [
        pytest.approx([0.0, 0.0, 0.0]),
        pytest.approx([0.05, -0.15, 0.44]),
        pytest.approx([0.5, -0.35, 0.42]),
    ]
