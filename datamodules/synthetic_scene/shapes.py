"""Solid shapes that rays hit exactly: planes, boxes, spheres and upright cylinders.

Every shape has these methods, all float64 and vectorised:

* ``intersect(origins [n or 1, 3], directions [n, 3]) -> [n]``: distance along the direction (in units of its length) to
  the first hit in front of the origin, infinite where there is none. Shapes are seen from outside.
* ``normals(points [n, 3]) -> [n, 3]``: outward unit normals at points of the surface.
* ``nearest(points [n, 3]) -> [n, 3]``: the point of the surface nearest to each point.
* ``local(points [n, 3]) -> [n, 3]``: the points in the shape's own axes, about its own origin.
* ``bounds() -> (centre, radius)`` of a sphere around the shape, or None for an infinite one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

Point = tuple[float, float, float]

# Rays times shapes that are asked at once whether they are near each other: what stays in a core's own memory.
_AT_ONCE = 2**16


class Shape(Protocol):
    """What the tracer needs of a shape; the module's first lines say what each method returns."""

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor: ...

    def normals(self, points: Tensor) -> Tensor: ...

    def nearest(self, points: Tensor) -> Tensor: ...

    def local(self, points: Tensor) -> Tensor: ...

    def bounds(self) -> tuple[Point, float] | None: ...


@cache  # small tensors take as long to make as to compute with
def _row(point: Point) -> Tensor:
    return torch.tensor(point, dtype=torch.float64)


@cache
def _turn(yaw_deg: float, tilt_deg: float) -> Tensor:
    """Rotation [3, 3]: a tilt about x, then a turn about z."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    yaw = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    if not tilt_deg:
        return yaw
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    return yaw @ torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]], dtype=torch.float64)


@cache
def _spheres(bounds: tuple[tuple[Point, float], ...]) -> tuple[Tensor, Tensor]:
    """Centres [n, 3] and radii [n, 1]."""
    centers, radii = zip(*bounds, strict=True)
    return torch.tensor(centers, dtype=torch.float64), torch.tensor(radii, dtype=torch.float64)[:, None]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products [n] of rows of two components or more; several times faster than a sum over a short axis."""
    total, *others = (x * y for x, y in zip(a.unbind(1), b.unbind(1), strict=True))
    for product in others:
        total += product
    return total


def _first_positive(*distances: Tensor) -> Tensor:
    """The smallest positive distance of several, infinite where none is positive (or all are NaN)."""
    best = torch.full_like(distances[0], math.inf)
    for distance in distances:
        best = torch.where((distance > 0) & (distance < best), distance, best)
    return best


def _sphere_like(a: Tensor, half_b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Both roots of a t² + 2 half_b t + c = 0, infinite where there is none or the equation is void."""
    inside = half_b * half_b - a * c
    root = inside.clamp_min(0.0).sqrt()
    # The root that adds two numbers of one sign is exact to rounding; the other follows from the roots' product.
    sum_of = -(half_b + torch.where(half_b < 0, -root, root))
    hit = (inside >= 0) & (a > 0)
    infinite = torch.full_like(c, math.inf)
    return torch.where(hit, sum_of / a, infinite), torch.where(hit & (sum_of != 0), c / sum_of, infinite)


@dataclass(frozen=True)
class Plane:
    """The plane through ``point`` whose outside is where ``normal`` (unit length) points."""

    point: Point
    normal: Point

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        normal = _row(self.normal)
        along = directions @ normal
        distance = (_row(self.point) - origins) @ normal / along
        return torch.where((along < 0) & (distance > 0), distance, torch.full_like(distance, math.inf))

    def normals(self, points: Tensor) -> Tensor:
        return _row(self.normal).expand_as(points)

    def nearest(self, points: Tensor) -> Tensor:
        normal = _row(self.normal)
        return points - ((points - _row(self.point)) @ normal)[:, None] * normal

    def local(self, points: Tensor) -> Tensor:
        return points - _row(self.point)

    def bounds(self) -> None:
        return None


@dataclass(frozen=True)
class Sphere:
    center: Point
    radius: float

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        offset = origins - _row(self.center)
        a = dot(directions, directions)
        half_b = dot(directions, offset)
        c = dot(offset, offset) - self.radius**2
        near, far = _sphere_like(a, half_b, c)
        nearest = torch.minimum(near, far)
        return torch.where(nearest > 0, nearest, torch.full_like(nearest, math.inf))

    def normals(self, points: Tensor) -> Tensor:
        return torch.nn.functional.normalize(points - _row(self.center), dim=1)

    def nearest(self, points: Tensor) -> Tensor:
        return _row(self.center) + self.radius * self.normals(points)

    def local(self, points: Tensor) -> Tensor:
        return points - _row(self.center)

    def bounds(self) -> tuple[Point, float]:
        return self.center, self.radius


@dataclass(frozen=True)
class Box:
    """A box of full ``size`` about ``center``, tilted about its own x axis, then turned about the vertical (z) axis."""

    center: Point
    size: Point
    yaw_deg: float = 0.0
    tilt_deg: float = 0.0

    def rotation(self) -> Tensor:
        """Rotation [3, 3] from the box's axes to the world's."""
        return _turn(self.yaw_deg, self.tilt_deg)

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        turn = self.rotation()
        offset, rays = (origins - _row(self.center)) @ turn, directions @ turn
        first = torch.full_like(offset[:, 0], -math.inf)
        last = torch.full_like(offset[:, 0], math.inf)
        for axis, size in enumerate(self.size):
            inverse = 1.0 / rays[:, axis]
            one, other = (-0.5 * size - offset[:, axis]) * inverse, (0.5 * size - offset[:, axis]) * inverse
            # A ray in the very plane of a face multiplies 0 by infinity; fmax and fmin leave that face out.
            first = torch.fmax(first, torch.fmin(one, other))
            last = torch.fmin(last, torch.fmax(one, other))
        return torch.where((first <= last) & (first > 0), first, torch.full_like(first, math.inf))

    def normals(self, points: Tensor) -> Tensor:
        turn = self.rotation()
        local = (points - _row(self.center)) @ turn / (0.5 * _row(self.size))
        face = local.abs().argmax(1, keepdim=True)
        normal = torch.zeros_like(local).scatter(1, face, local.gather(1, face).sign())
        return normal @ turn.T

    def nearest(self, points: Tensor) -> Tensor:
        turn, half = self.rotation(), 0.5 * _row(self.size)
        local = (points - _row(self.center)) @ turn
        clamped = torch.minimum(torch.maximum(local, -half), half)
        inside = (local.abs() < half).all(1)
        face = (half - local.abs()).argmin(1, keepdim=True)
        side = torch.where(local >= 0, half, -half)
        pushed = local.scatter(1, face, side.gather(1, face))
        return torch.where(inside[:, None], pushed, clamped) @ turn.T + _row(self.center)

    def local(self, points: Tensor) -> Tensor:
        return (points - _row(self.center)) @ self.rotation()

    def bounds(self) -> tuple[Point, float]:
        return self.center, 0.5 * math.hypot(*self.size)


@dataclass(frozen=True)
class Cylinder:
    """A closed upright cylinder: ``base`` is the centre of its lower cap, its axis points along +z."""

    base: Point
    radius: float
    height: float

    def intersect(self, origins: Tensor, directions: Tensor) -> Tensor:
        offset = origins - _row(self.base)
        flat, ray = offset[:, :2], directions[:, :2]
        roots = _sphere_like(dot(ray, ray), dot(ray, flat), dot(flat, flat) - self.radius**2)
        infinite = torch.full_like(roots[0], math.inf)
        sides = []
        for root in roots:
            z = offset[:, 2] + root * directions[:, 2]
            sides.append(torch.where((z >= 0) & (z <= self.height), root, infinite))
        caps = []
        for z in (0.0, self.height):
            distance = (z - offset[:, 2]) / directions[:, 2]
            at = flat + distance[:, None] * ray
            caps.append(torch.where(dot(at, at) <= self.radius**2, distance, infinite))
        return _first_positive(*sides, *caps)

    def normals(self, points: Tensor) -> Tensor:
        offset = points - _row(self.base)
        out = torch.nn.functional.normalize(offset[:, :2], dim=1)
        to_side = (offset[:, :2].norm(dim=1) - self.radius).abs()
        to_cap = torch.minimum(offset[:, 2].abs(), (self.height - offset[:, 2]).abs())
        up = torch.where(offset[:, 2] > 0.5 * self.height, 1.0, -1.0).to(points.dtype)
        side = torch.cat([out, torch.zeros_like(up)[:, None]], dim=1)
        cap = torch.cat([torch.zeros_like(out), up[:, None]], dim=1)
        return torch.where((to_side <= to_cap)[:, None], side, cap)

    def nearest(self, points: Tensor) -> Tensor:
        offset = points - _row(self.base)
        distance = offset[:, :2].norm(dim=1, keepdim=True)
        out = torch.where(distance > 0, offset[:, :2] / distance, torch.tensor([1.0, 0.0], dtype=points.dtype))
        z = offset[:, 2:]
        to_cap = torch.minimum(z, self.height - z)
        inside = (distance < self.radius) & (to_cap > 0)
        to_wall = inside & (self.radius - distance <= to_cap)
        cap = torch.where(z > 0.5 * self.height, torch.full_like(z, self.height), torch.zeros_like(z))
        radial = torch.where(to_wall, torch.full_like(distance, self.radius), distance.clamp_max(self.radius))
        height = torch.where(inside & ~to_wall, cap, z.clamp(0.0, self.height))
        return torch.cat([out * radial, height], dim=1) + _row(self.base)

    def local(self, points: Tensor) -> Tensor:
        return points - _row(self.base)

    def bounds(self) -> tuple[Point, float]:
        x, y, z = self.base
        return (x, y, z + 0.5 * self.height), math.hypot(self.radius, 0.5 * self.height)


def trace(shapes: Sequence[Shape], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The first hit of every ray: distance [n], infinite for a miss, and which of ``shapes`` was hit [n].

    Args:
        origins: [n, 3], or [1, 3] when all rays start at one point.
        directions: [n, 3].
    """
    nearest = torch.full_like(directions[:, 0], math.inf)
    which = torch.zeros_like(nearest, dtype=torch.int64)
    near = _near(shapes, origins, directions)
    for position, shape in enumerate(shapes):
        if position not in near:
            distance = shape.intersect(origins, directions)
            closer = distance < nearest
            nearest = torch.where(closer, distance, nearest)
            which.masked_fill_(closer, position)
            continue
        rays = near[position]
        if not len(rays):
            continue
        distance = shape.intersect(origins if len(origins) == 1 else origins[rays], directions[rays])
        closer = (distance < nearest[rays]).nonzero()[:, 0]
        rays = rays[closer]
        nearest[rays] = distance[closer]
        which[rays] = position
    return nearest, which


def _near(shapes: Sequence[Shape], origins: Tensor, directions: Tensor) -> dict[int, Tensor]:
    """Which rays come near each of the shapes that have bounds, by their positions; the others need not ask it.

    Of small images so many shapes at once that fewer and longer operations pay.
    """
    bounded = [(position, bounds) for position, shape in enumerate(shapes) if (bounds := shape.bounds()) is not None]
    lengths, rays = dot(directions, directions), directions.unbind(1)
    near: dict[int, Tensor] = {}
    at_once = max(1, _AT_ONCE // max(1, len(directions)))
    for first in range(0, len(bounded), at_once):
        some, bounds = zip(*bounded[first : first + at_once], strict=True)
        centers, radii = _spheres(bounds)
        x, y, z = (origins[:, axis] - centers[:, axis, None] for axis in range(3))
        outside = x * x + y * y + z * z - (1.0 + 1e-9) * radii**2
        along = rays[0] * x + rays[1] * y + rays[2] * z
        found = (along * along >= lengths * outside) & ((along < 0) | (outside < 0))
        number, ray = found.nonzero().unbind(1)
        counts = torch.bincount(number, minlength=len(some)).tolist()
        near |= zip(some, ray.contiguous().split(counts), strict=True)
    return near


def nearest_surface(shapes: Sequence[Shape], points: Tensor) -> tuple[Tensor, Tensor]:
    """The surface nearest to each point: the point on it [n, 3] and its position in ``shapes`` [n]."""
    best = torch.full(points.shape[:1], math.inf, dtype=points.dtype)
    which = torch.zeros(points.shape[:1], dtype=torch.int64)
    on_surface = points.clone()
    for position, shape in enumerate(shapes):
        candidate = shape.nearest(points)
        distance = (candidate - points).norm(dim=1)
        closer = distance < best
        best = torch.where(closer, distance, best)
        which = torch.where(closer, position, which)
        on_surface = torch.where(closer[:, None], candidate, on_surface)
    return on_surface, which
