"""Light on a yard: patches of its flat faces, the shadows that are cast on them, and how much sky each of them sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.datamodules.synthetic_scene.shapes import Box, Plane, trace

OFF_M = 1e-3  # rays start this far off their patch
RAYS = 64  # over the hemisphere of a patch
ALBEDO = 0.2  # of all that is not sky
SOLAR_CONSTANT = 1361.0  # W/m², outside of the atmosphere
LOWEST_SINE = (
    0.087  # of the sun's height, below which light about the sun counts as diffuse (Hay and Davies: 5 degrees)
)
REACH_M = 36.0  # of the ground about the middle; beyond, it is as at its edge


@dataclass(frozen=True)
class Face:
    """A rectangle of surface with its grid of patches.

    Args:
        surface: number of the surface.
        corner: [3] where rows and columns begin.
        sides: [2, 3] unit vectors along rows and columns.
        normal: [3] outwards.
        counts: patches along the sides.
        sizes: of a patch along the sides, in metres.
        first: number of the first patch.
    """

    surface: int
    corner: Tensor
    sides: Tensor
    normal: Tensor
    counts: tuple[int, int]
    sizes: tuple[float, float]
    first: int

    @property
    def centres(self) -> Tensor:
        """[rows * columns, 3]."""
        rows, columns = (
            (torch.arange(n, dtype=torch.float64) + 0.5) * s for n, s in zip(self.counts, self.sizes, strict=True)
        )
        along = rows[:, None, None] * self.sides[0] + columns[None, :, None] * self.sides[1]
        return (self.corner + along).reshape(-1, 3)

    def corners(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The four patches about each of points [n, 3] on it, [n, 4] int64, and their bilinear weights [n, 4]."""
        numbers, shares = [], []
        for side, count, size in zip(self.sides, self.counts, self.sizes, strict=True):
            place = (((points - self.corner) @ side) / size - 0.5).clamp(0.0, count - 1.0)
            before = place.long().clamp(max=max(count - 2, 0))
            numbers.append((before, (before + 1).clamp(max=count - 1)))
            shares.append((1.0 - (place - before), place - before))
        pairs = [(i, j) for i in range(2) for j in range(2)]
        found = torch.stack([self.first + numbers[0][i] * self.counts[1] + numbers[1][j] for i, j in pairs], dim=1)
        return found, torch.stack([shares[0][i] * shares[1][j] for i, j in pairs], dim=1)


def faces_of(shapes: Sequence[Box | Plane], patch_m: float, ground_m: float) -> list[Face]:
    """The faces that do not look down, in patches of about ``patch_m``, the ground in patches of ``ground_m``."""
    faces: list[Face] = []
    first = 0

    def add(surface: int, corner: Tensor, sides: Tensor, normal: Tensor, lengths: Tensor, patch: float) -> None:
        nonlocal first
        counts = tuple(max(1, math.ceil(float(length) / patch)) for length in lengths)
        sizes = tuple(float(length) / count for length, count in zip(lengths, counts, strict=True))
        faces.append(Face(surface, corner, sides, normal, counts, sizes, first))
        first += counts[0] * counts[1]

    for number, shape in enumerate(shapes):
        if isinstance(shape, Plane):
            sides = torch.eye(3, dtype=torch.float64)[:2]
            corner = torch.tensor([-REACH_M, -REACH_M, shape.point[2]], dtype=torch.float64)
            normal = torch.tensor(shape.normal, dtype=torch.float64)
            add(number, corner, sides, normal, torch.full((2,), 2 * REACH_M), ground_m)
            continue
        turn, size = shape.rotation(), torch.tensor(shape.size, dtype=torch.float64)
        centre = torch.tensor(shape.center, dtype=torch.float64)
        for axis in range(3):
            for sign in (1.0, -1.0):
                normal = sign * turn[:, axis]
                if normal[2] <= -0.5:
                    continue
                others = [k for k in range(3) if k != axis]
                sides = turn[:, others].T
                corner = centre + 0.5 * size[axis] * normal - 0.5 * (size[others] @ sides)
                add(number, corner, sides, normal, size[others], patch_m)
    return faces


class Lighting:
    """What all patches of a yard see of sun and sky.

    Attributes:
        faces: of the shapes.
        centres, normals: [P, 3] float64.
        surface: [P] number of the surface.
        covered: [P] bool, inside another shape, where no light comes.
        sky_share: [P] share of the sky in what a patch sees, by its cosine, from rays of which the nearest shape counts.
    """

    def __init__(self, shapes: Sequence[Box | Plane], patch_m: float = 0.5, ground_m: float = 1.0) -> None:
        self.shapes = list(shapes)
        self.faces = faces_of(shapes, patch_m, ground_m)
        self.centres = torch.cat([face.centres for face in self.faces])
        counts = torch.tensor([face.counts[0] * face.counts[1] for face in self.faces])
        self.normals = torch.stack([face.normal for face in self.faces]).repeat_interleave(counts, dim=0)
        self.surface = torch.tensor([face.surface for face in self.faces]).repeat_interleave(counts)
        self.starts = self.centres + OFF_M * self.normals
        self.covered = torch.zeros(len(self.centres), dtype=torch.bool)
        for number, shape in enumerate(self.shapes):
            if isinstance(shape, Box):
                inside = (shape.local(self.starts).abs() < 0.5 * torch.tensor(shape.size, dtype=torch.float64)).all(1)
                self.covered |= inside & (self.surface != number)
        self.sky_share = torch.cat([self._sky_share(face) for face in self.faces]).masked_fill(self.covered, 0.0)

    def _sky_share(self, face: Face) -> Tensor:
        """Of the patches of a face: cosine-weighted rays on a spiral, those that go up and meet nothing."""
        number = torch.arange(RAYS, dtype=torch.float64)
        radius, angle = ((number + 0.5) / RAYS).sqrt(), number * math.pi * (3.0 - 5.0**0.5)
        local = torch.stack([radius * angle.cos(), radius * angle.sin(), (1.0 - radius**2).sqrt()], dim=1)
        rays = local @ torch.cat([face.sides, face.normal[None]])
        up = rays[rays[:, 2] > 0]
        starts = face.centres + OFF_M * face.normal
        distance, _ = trace(self.shapes, starts.repeat_interleave(len(up), dim=0), up.repeat(len(starts), 1))
        return torch.isinf(distance).reshape(len(starts), len(up)).sum(1) / RAYS

    def sunlit(self, sun: Tensor) -> Tensor:
        """Which patches [P] the sun in a direction [3] reaches, bool."""
        lit = (self.normals @ sun > 0) & ~self.covered & (sun[2] > 0)
        ids = lit.nonzero()[:, 0]
        if len(ids):
            distance, _ = trace(self.shapes, self.starts[ids], sun.expand(len(ids), 3))
            lit[ids] = torch.isinf(distance)
        return lit

    def sunlight(self, weather: Weather) -> np.ndarray:
        """Irradiance [T, P] in W/m² at the samples of a weather.

        The sun's beam where nothing shades it; diffuse light of Hay and Davies (1980), of which the share direct /
        extraterrestrial comes from about the sun and is shaded with it, and the rest from the sky that a patch sees; and
        what the surroundings reflect.
        """
        total = np.zeros((len(weather.times_s), len(self.centres)), dtype=np.float32)
        for k in range(len(weather.times_s)):
            sun, direct, diffuse = weather.sun[k], float(weather.direct_w_m2[k]), float(weather.diffuse_w_m2[k])
            if not (direct > 0 or diffuse > 0):
                continue
            facing = (self.normals @ sun).clamp(min=0.0) * self.sunlit(sun)
            about_the_sun = min(direct / SOLAR_CONSTANT, 1.0)
            beam = direct + diffuse * about_the_sun / max(float(sun[2]), LOWEST_SINE)
            around = ALBEDO * float(weather.irradiance_w_m2[k])
            light = beam * facing + (1 - about_the_sun) * diffuse * self.sky_share + around * (1 - self.sky_share)
            total[k] = light.masked_fill(self.covered, 0.0).numpy()
        return total
