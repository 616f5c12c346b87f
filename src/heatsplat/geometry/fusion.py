"""Surfaces of depth maps: a truncated signed distance in a sparse grid of voxels, and the triangles where it is zero.

**Convention:** distances are positive before a surface, where cameras are, and negative behind it; so faces turn anticlockwise,
and normals point outward, as a camera sees them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import Sighting
from heatsplat.geometry.looks import surface_points
from heatsplat.geometry.projection import to_camera
from heatsplat.geometry.sight_lines import planes, rays

BLOCK = 8  # voxels of a block's edge
AROUND = 1  # pixels to either side of the one whose plane they tell
FLAT = 0.01  # of 1 / depth, root mean square from that plane: a step of 4 % across the window bends more
STEEPEST = 0.17  # cosine of the line of sight to the normal (80 degrees) below which a pixel shows an edge, or a surface's side
COARSEST = 4.0  # voxels that a pixel may be wide on the surface: what is farther away is seen by too few
# Of the truncation, the least distance of a voxel: a vertex on a corner of the grid would lie on several edges.
OFF_ZERO = 1e-3
# Shares of the way to the mean of their neighbours that vertices go, and back: the second a little more, so that what is large
# keeps its size while ripples vanish (Taubin, SIGGRAPH 1995, section 3.1; pass band 1 / 0.5 - 1 / 0.53 = 0.11).
THERE, BACK = 0.5, -0.53
AT_ONCE = 2**11  # blocks that are looked at together
BITS, ORIGIN = 21, 2**20  # of a block's place along an axis, in a number of 63 bits


class TooLarge(ValueError):
    """A grid would have more voxels than there may be. Args: how many it would have, at least."""

    def __init__(self, voxels: int) -> None:
        super().__init__(f"the grid would have {voxels} voxels or more")
        self.voxels = voxels


@dataclass(frozen=True)
class Surface:
    """Triangles.

    Args:
        vertices: [V, 3] float64.
        faces: [F, 3] int64, anticlockwise as seen from outside.
    """

    vertices: Tensor
    faces: Tensor

    def crosses(self) -> Tensor:
        """Outward normal [F, 3] of each face, twice its area long."""
        first, second, third = self.vertices[self.faces].unbind(1)
        return torch.linalg.cross(second - first, third - first)

    def normals(self) -> Tensor:
        """Outward unit normals [V, 3] of the vertices: means of their faces', by area; 0 of a vertex without any."""
        sums = torch.zeros_like(self.vertices)
        crosses = self.crosses()
        for corner in self.faces.unbind(1):
            sums.index_add_(0, corner, crosses)
        return torch.nn.functional.normalize(sums, dim=1)

    def of(self, kept: Tensor) -> Surface:
        """Those of the faces [F] bool, with their vertices only."""
        used, faces = torch.unique(self.faces[kept], return_inverse=True)
        return replace(self, vertices=self.vertices[used], faces=faces)

    def inside(self, box: Tensor) -> Surface:
        """The faces whose corners all lie in a box [2, 3]."""
        return self.of(((self.vertices >= box[0]) & (self.vertices <= box[1])).all(1)[self.faces].all(1))

    def smoothed(self, rounds: int) -> Surface:
        """Without ripples shorter than some edges, and no smaller: after so many rounds of Taubin's filter (SIGGRAPH 1995), each
        of two steps with the same weight for every neighbour; 0 rounds leave it as it is."""
        if not rounds or not len(self.faces):
            return self
        faces = self.faces.numpy()
        ends = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
        others = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
        joined = coo_array((np.ones(len(ends)), (ends, others)), shape=[len(self.vertices)] * 2).tocsr()
        # A border goes along itself: drawn towards the faces, holes would widen.
        border = joined.data == 1  # edges that one face has
        of = np.repeat(np.arange(len(self.vertices)), np.diff(joined.indptr))
        joined.data = (border | ~np.isin(of, of[border])).astype(np.float64)
        means = diags_array(1.0 / joined.sum(1)) @ joined
        vertices = self.vertices.numpy()
        for share in (THERE, BACK) * rounds:
            vertices = vertices + share * (means @ vertices - vertices)
        return replace(self, vertices=torch.from_numpy(vertices))

    def without_pieces(self, least: float) -> Surface:
        """Without connected pieces whose area is a smaller share than ``least`` of the whole; the largest stays."""
        if not len(self.faces):
            return self
        a, b, c = self.faces.numpy().T
        edges = np.concatenate([a, b]), np.concatenate([b, c])
        count = len(self.vertices)
        _, piece = connected_components(coo_array((np.ones(len(edges[0]), bool), edges), shape=(count, count)), False)
        piece = torch.from_numpy(piece[a]).long()
        areas = torch.zeros(int(piece.max()) + 1, dtype=torch.float64).index_add_(0, piece, self.crosses().norm(dim=1))
        enough = areas >= least * areas.sum()
        enough[areas.argmax()] = True
        return self.of(enough[piece])


@dataclass(frozen=True)
class Facing:
    """What the pixels of a depth map tell of space.

    Args:
        camera: of the map.
        planes: [H, W, 4] float32, outward unit normal in the camera's frame and d: n x + d is the distance of x before the plane
            that the pixel shows; NaN where the pixel tells nothing.
        weights: [H, W] float32, how large it sees the surface: the cosine to its normal over the squared distance.
        footprints: [H, W] float64, width of the pixel at the surface.
        depth: [H, W] float64 camera z, infinite where the pixel tells nothing.
    """

    camera: Camera
    planes: Tensor
    weights: Tensor
    footprints: Tensor
    depth: Tensor


def facing(sighting: Sighting, coarsest: float = torch.inf) -> Facing:
    """What a depth map tells of space: of pixels whose window is a plane, seen neither from its side nor too coarsely.

    A pixel across an edge mixes the depths of both sides, and would make a sheet between them; its window is steep or no plane.

    Args:
        sighting: its mask leaves pixels out.
        coarsest: width of a pixel on the surface above which it tells nothing.
    """
    camera, depth = sighting.camera, sighting.depth.double().cpu()
    normal = planes(camera, depth, AROUND, FLAT)
    sight = rays(camera)
    length = sight.norm(dim=-1)
    size = normal.norm(dim=-1)
    fitted = 1.0 / (normal * sight).sum(-1)  # camera z of the plane
    cosine = 1.0 / (fitted * size * length)
    footprint = fitted / (camera.K[0, 0] * camera.K[1, 1]).sqrt()
    known = (fitted > 0) & (cosine >= STEEPEST) & (footprint <= coarsest)
    if sighting.mask is not None:
        known &= sighting.mask.cpu()
    told = torch.cat([-normal, torch.ones_like(normal[..., :1])], dim=-1) / size[..., None]
    return Facing(
        camera,
        told.where(known[..., None], torch.nan).float(),
        (cosine / (fitted * length).square()).where(known, 0.0).float(),
        footprint.where(known, torch.nan),
        fitted.where(known, torch.inf),
    )


def fuse(sightings: Sequence[Sighting], blocks: Tensor, voxel: float, truncation: float) -> Surface:
    """The surface that depth maps show together.

    A voxel has the mean of its distances before the planes of the pixels that see it, weighted by how large they see theirs, and
    none beyond ``truncation``: before it the voxel is free, behind it hidden from that camera. There may be a surface where none
    of eight neighbouring voxels is hidden from all cameras; so what no camera saw stays open.

    Args:
        sightings: depth maps; masks leave pixels out, as do infinite depths.
        blocks: where the grid has voxels (``blocks_near``).
        voxel: edge of a voxel.
        truncation: distance that a surface's error stays below, a few voxels.
    """
    grid = _Grid(blocks, voxel, truncation)
    for sighting in sightings:
        grid.add(facing(sighting, COARSEST * voxel))
    return grid.surface()


def footprint(sightings: Sequence[Sighting]) -> float | None:
    """Median width on the surface of the pixels that tell where it is (``facing``); None where none does."""
    found = [one[one.isfinite()] for one in (facing(sighting).footprints for sighting in sightings)]
    widths = torch.cat(found)
    return float(widths.median()) if len(widths) else None


def blocks_near(
    sightings: Sequence[Sighting], voxel: float, truncation: float, most: int, box: Tensor | None = None
) -> Tensor:
    """Sorted numbers [B] of the blocks of 8 x 8 x 8 voxels within the truncation of what depth maps show, along each axis.

    Args:
        sightings, voxel, truncation: as of ``fuse``.
        most: voxels at most; each takes 8 bytes.
        box: [2, 3] lowest and highest corner outside of which surfaces are left out.

    Raises:
        TooLarge: there would be more voxels.
    """
    reach = truncation / voxel
    steps = torch.linspace(-reach, reach, int(np.ceil(2 * reach / BLOCK)) + 1, dtype=torch.float64)
    offsets = torch.cartesian_prod(steps, steps, steps)
    found = torch.empty(0, dtype=torch.int64)
    for sighting in sightings:
        one = facing(sighting, COARSEST * voxel)
        points = surface_points(one.camera, one.depth)[one.depth.isfinite()]
        if box is not None:
            points = points[((points >= box[0]) & (points <= box[1])).all(1)]
        cells = torch.unique((points / voxel).round(), dim=0) if len(points) else points
        blocks = [_packed(((cells + offset) / BLOCK).floor().long()) for offset in offsets]
        found = torch.unique(torch.cat([found, *blocks]))
        if len(found) * BLOCK**3 > most:
            raise TooLarge(len(found) * BLOCK**3)
    return found


def _packed(blocks: Tensor) -> Tensor:
    """Numbers [...] of blocks at places [..., 3]; those farther out than there are numbers lie at the outermost."""
    x, y, z = (blocks + ORIGIN).clamp(0, 2**BITS - 1).unbind(-1)
    return (x << 2 * BITS) | (y << BITS) | z


def _unpacked(numbers: Tensor) -> Tensor:
    """Places [..., 3] of blocks with these numbers."""
    low = 2**BITS - 1
    return torch.stack([numbers >> 2 * BITS, (numbers >> BITS) & low, numbers & low], dim=-1) - ORIGIN


class _Grid:
    """Distances of voxels, gathered map by map.

    **Convention:** the voxel (0, 0, 0) has its centre at the origin; vertices and points are in the unit of ``voxel``.

    Args:
        blocks: [B] sorted numbers.
        voxel, truncation: as of ``fuse``.
    """

    def __init__(self, blocks: Tensor, voxel: float, truncation: float) -> None:
        self.blocks, self.voxel, self.truncation = blocks, voxel, truncation
        self.places = _unpacked(blocks) * BLOCK  # of their first voxels
        self.sums, self.weights = torch.zeros(2, len(blocks), BLOCK**3)
        steps = torch.arange(BLOCK)
        self.within = torch.cartesian_prod(steps, steps, steps)  # of a block's voxels

    def add(self, one: Facing) -> None:
        """Takes in what one depth map tells of the voxels in its image."""
        if not one.depth.isfinite().any():
            return
        camera = one.camera
        starts = to_camera(self.places.double() * self.voxel, camera.viewmat)
        half = 0.5 * (BLOCK - 1) * self.voxel
        radius = 3**0.5 * half
        middles = starts + half * camera.viewmat[:3, :3].sum(1)
        deepest = float(one.depth[one.depth.isfinite()].max()) + self.truncation
        near = (middles[:, 2] > -radius) & (middles[:, 2] < deepest + radius)
        for axis, size in ((0, camera.width), (1, camera.height)):
            # Which side of the planes through the image's borders they lie on.
            focal, centre = float(camera.K[axis, axis]), float(camera.K[axis, 2])
            for slope, sign in ((-centre / focal, 1.0), ((size - centre) / focal, -1.0)):
                near &= sign * (middles[:, axis] - slope * middles[:, 2]) > -radius * (1 + slope**2) ** 0.5
        steps = (self.within.double() * self.voxel @ camera.viewmat[:3, :3].T).float()
        told = one.planes.reshape(-1, 4)
        weights, depth = one.weights.reshape(-1), one.depth.float().reshape(-1)
        (fx, cx), (fy, cy) = ((float(camera.K[i, i]), float(camera.K[i, 2])) for i in (0, 1))
        for ids in near.nonzero().squeeze(1).split(AT_ONCE):
            x, y, z = (starts[ids].float()[:, None] + steps).unbind(-1)
            column, row = (x / z * fx + cx).floor(), (y / z * fy + cy).floor()
            inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            pixel = torch.where(inside, row * camera.width + column, 0.0).long()
            a, b, c, d = told[pixel].unbind(-1)
            distance = a * x + b * y + c * z + d
            behind = (z - depth[pixel]) * (z * z + x * x + y * y).sqrt() / z
            weight = weights[pixel]
            seen = inside & (behind <= self.truncation) & (weight > 0)
            weight = weight.where(seen, 0.0)
            share = (distance / self.truncation).clamp(max=1.0).where(seen, 0.0)
            self.sums[ids] += weight * share
            self.weights[ids] += weight

    def surface(self) -> Surface:
        """The triangles where the distance is zero, between voxels that are all seen; the grid is used up."""
        vertices, keys, faces, count = [np.empty((0, 3))], [np.empty((0, 4), np.int64)], [np.empty((0, 3), np.int64)], 0
        for place, values in self._crossed():
            seen = np.isfinite(values)
            found, triangles, *_ = marching_cubes(np.where(seen, values, 1.0), 0.0, gradient_direction="descent")
            cells = found[triangles].mean(1).astype(np.int64).clip(0, BLOCK - 1)
            triangles = triangles[seen[tuple((cells[:, None] + _CORNERS).reshape(-1, 3).T)].reshape(-1, 8).all(1)]
            faces.append(triangles.astype(np.int64) + count)
            vertices.append(found.astype(np.float64) + place)
            keys.append(_edges(found, place, count))
            count += len(found)
        _, first, same = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
        places = torch.from_numpy(np.concatenate(vertices)[first] * self.voxel)
        merged = torch.from_numpy(same.reshape(-1)[np.concatenate(faces)])
        return Surface(places, merged).of(torch.ones(len(merged), dtype=torch.bool))

    def _crossed(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Blocks in which the distance changes its sign: the place [3] of the first voxel, and shares of the truncation of its
        voxels and of the first ones of the next blocks, [9, 9, 9] float32; NaN where no map tells one."""
        values = self.sums.div_(self.weights).reshape(-1, BLOCK, BLOCK, BLOCK).numpy()  # 0 / 0 is NaN
        del self.weights
        own = _unpacked(self.blocks)
        for ids in torch.arange(len(own)).split(AT_ONCE):
            whole = np.full((len(ids), *[BLOCK + 1] * 3), np.nan, np.float32)
            for step in _CORNERS:
                number = _packed(own[ids] + torch.from_numpy(step))
                place = torch.searchsorted(self.blocks, number).clamp(max=len(own) - 1)
                there = (self.blocks[place] == number).numpy()
                into = (there, *(slice(BLOCK, None) if s else slice(0, BLOCK) for s in step))
                of = (place.numpy()[there], *(slice(0, 1) if s else slice(None) for s in step))
                whole[into] = values[of]
            whole = np.copysign(np.maximum(np.abs(whole), OFF_ZERO), whole)  # NaN stays
            flat = whole.reshape(len(ids), (BLOCK + 1) ** 3)
            for i in np.flatnonzero((flat < 0).any(1) & (flat > 0).any(1)):
                yield self.places[ids[i]].numpy(), whole[i]


_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)  # of a cell


def _edges(found: np.ndarray, place: np.ndarray, count: int) -> np.ndarray:
    """Which edge of the grid each vertex [V, 3] of a block at ``place`` lies on, [V, 4] whole numbers: its end and its axis; of
    a vertex within a cell, numbers from ``count`` on that no other has. Blocks that meet have those on their border twice."""
    away = np.abs(found - found.round())
    axis = away.argmax(1)
    rows = np.arange(len(found))
    ends = found.round()
    ends[rows, axis] = np.floor(found[rows, axis])
    keys = np.concatenate([ends.astype(np.int64) + place, axis[:, None]], axis=1)
    within = np.sort(away, axis=1)[:, 1] > 0.1 * OFF_ZERO
    keys[within] = np.stack([count + rows, 0 * rows, 0 * rows, 0 * rows + 3], axis=1)[within]
    return keys
