"""What all evidence shares: training images as tracks of scene points over time, and the noise of the sensor.

A track is what the training views show at the projections of one scene point. Everything is read once, one view after the
other, and subsampled to a size at which all evidence takes a few seconds. Images are held as they were decoded, in float32;
what is worked out from them is float64.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet, evenly_spread
from heatsplat.geometry.projection import to_camera, to_pixels
from heatsplat.physics.noise import noise_of, noise_of_repeats, usual_quantum

MAX_FRAMES = 64
ENOUGH = 0.5  # share of the points that a choice of frames shows at all which have to be followed through some of them
LENGTHS = (1, 16, 64)  # frames of a run
# Points whose tracks are fitted, and their observations, by which time goes; all points, up to MAX_IN_FRONT, hide each other.
MAX_POINTS, MAX_OBSERVATIONS = 500, 24_000
MAX_CANDIDATES = 1500
MAX_IN_FRONT = 20000
MIN_PX = 8  # along the shorter side of an image
MIN_FRAMES = 4  # a track of fewer observations says nothing about time
# A point is hidden where another one is nearer to the camera by this share within a cell of about two points.
NEARER = 0.08
STILL_PX = 0.25  # in the median over points; less is no parallax to learn from

Made = TypeVar("Made")


@dataclass(frozen=True)
class Tracks:
    """P points seen in F frames. Where ``weights`` is 0 the point is not seen and the other values mean nothing.

    Args:
        points: [P, 3] in the world.
        values: [P, F] image values, bilinear between pixels.
        slopes: [P, F] steepest change of the image about there, per pixel: what a misplaced point brings in.
        weights: [P, F] 0 or 1.
        distances: [P, F] from the camera, in the world's units.
        directions: [P, F, 3] unit vectors from the point to the camera.
        positions: [P, F, 2] in the image: from -1 (left, top) to 1 (right, bottom).
        radii: [P, F] squared distance from the middle of the image, 1 in its corners.
    """

    points: Tensor
    values: Tensor
    slopes: Tensor
    weights: Tensor
    distances: Tensor
    directions: Tensor
    positions: Tensor
    radii: Tensor

    def of(self, keep: Tensor) -> Tracks:
        """The tracks of the points that ``keep`` [P] (bool or positions) selects."""
        return Tracks(**{name: value[keep] for name, value in self.__dict__.items()})


@dataclass(frozen=True)
class Observations:
    """What a scene's training views show, for the evidence of all effects.

    Args:
        scene: where it comes from.
        frames: [F] of the images.
        images: [F, H, W] float32 thermal training images (mean over channels), at most MAX_FRAMES (``frames_to_follow``).
        masks: [F, H, W] bool, where a pixel of them counts, or None where all do.
        times_s: [F] float64, or None where a frame has no time.
        noise: standard deviation of the noise of a pixel, in image units.
        still: whether all frames were taken from one place; tracks are then pixels.
        tracks: of scene points, or None where there are none (``why``).
        why: why there are no tracks.
    """

    scene: SceneData
    frames: tuple[Frame, ...]
    images: Tensor
    masks: Tensor | None
    times_s: Tensor | None
    noise: float
    still: bool
    tracks: Tracks | None
    why: str = ""

    @property
    def unit_k(self) -> float | None:
        """Kelvin per image unit, or None where image values are no temperatures."""
        return None if self.scene.thermal_range is None else self.scene.thermal_range.span_k

    def size(self, value: float) -> str:
        """A difference of image values in words: in kelvin where they are temperatures."""
        return difference_told(value, self.unit_k)

    @property
    def ambient(self) -> float | None:
        """Temperature of the surroundings as an image value, or None."""
        if self.scene.ambient_c is None or self.scene.thermal_range is None:
            return None
        return self.scene.thermal_range.to_unit(self.scene.ambient_c)


def observe(scene: SceneData) -> Observations:
    """The observations of a scene; never fails for lack of data: what cannot be had is None, with the reason."""
    chosen = frames_to_follow(scene.train.frames, scene.points, MAX_FRAMES)
    frames, images, masks = read(scene.train, chosen, lambda _, view: view.frame)
    if not frames:
        return Observations(
            scene, (), images, None, None, math.nan, False, None, "no training view has a thermal image"
        )
    cameras = [frame.camera for frame in frames]
    times = [frame.time_s for frame in frames]
    times_s = None if any(t is None for t in times) else torch.tensor(times, dtype=torch.float64)
    still = len(frames) > 1 and _stands_still(cameras, scene.points.double())
    step = usual_quantum(images, masks)
    noise = noise_of(images, step, masks)
    if still:
        noise = max(noise_of_repeats(images, masks), step / math.sqrt(12.0), 1e-6)
    tracks, why = None, _too_little(scene, len(frames), images.shape[1:], still)
    if not why and still:
        tracks = _pixels(cameras[0], images, masks)
    elif not why:
        tracks = tracks_of(scene.points.double(), cameras, images, masks, noise)
        if tracks is None:
            why = f"no scene point is seen in {MIN_FRAMES} or more of {len(frames)} training views"
    return Observations(scene, tuple(frames), images, masks, times_s, noise, still, tracks, why)


def difference_told(value: float, unit_k: float | None) -> str:
    """A difference of image values in words, of so many kelvin to 1; None where they are no temperatures."""
    return f"{100 * value:.2g} % of the range" if unit_k is None else f"{value * unit_k:.2g} K"


def standardised(patterns: Tensor) -> Tensor:
    """Patterns [..., n] without their means and of length 1, whose products are correlations."""
    return functional.normalize(patterns - patterns.mean(-1, keepdim=True), dim=-1)


def _too_little(scene: SceneData, frames: int, shape: Sequence[int], still: bool) -> str:
    """Why nothing can be followed through so many images of that shape; empty where something may be."""
    height, width = shape
    if frames < MIN_FRAMES:
        return f"{frames} training view(s) are too few to follow anything over"
    if min(height, width) < MIN_PX:
        return f"images of {width} x {height} pixels are too small to follow a point through"
    if still or len(scene.points):
        return ""
    if "points_random" in scene.notes:
        return "cannot be told: the scene has no points of its own, and its images too little texture to find some"
    return "the scene has no points to follow through the images"


def read(
    views: ViewSet, chosen: Sequence[int], make: Callable[[int, View], Made]
) -> tuple[list[Made], Tensor, Tensor | None]:
    """What ``make`` returns for the position and view of each chosen view with a thermal image, of the first one's size; these
    images [F, H, W] float32, mean over channels; and their masks [F, H, W] bool, None where all pixels count.

    One view is decoded after the other and let go: with photos they take several times the memory of what is kept.
    """
    made: list[Made] = []
    images, masks = torch.zeros(0, 1, 1), None
    for i in chosen:
        view = views[i]
        if view.thermal is None or (made and view.thermal.shape[:2] != images.shape[1:]):
            continue
        if not made:
            images = torch.empty(len(chosen), *view.thermal.shape[:2])
        images[len(made)] = view.thermal.mean(2)
        if (known := view.known) is not None:
            masks = torch.ones(images.shape, dtype=torch.bool) if masks is None else masks
            masks[len(made)] = known
        made.append(make(i, view))
    return made, images[: len(made)], None if masks is None else masks[: len(made)]


def frames_to_follow(frames: Sequence[Frame], points: Tensor, limit: int) -> list[int]:
    """At most ``limit`` positions of frames through which points can be followed, in order: of those of the size that most have.

    They are evenly spread. Where too few points are then seen often enough, as on a long flight, runs of frames that follow each
    other are, of the shortest of ``LENGTHS`` that will do, or else of that which comes nearest.
    """
    sizes = [(frame.camera.height, frame.camera.width) for frame in frames]
    if len(set(sizes)) > 1:
        usual = Counter(sizes).most_common(1)[0][0]
        alike = [i for i, size in enumerate(sizes) if size == usual]
        return [alike[i] for i in frames_to_follow([frames[i] for i in alike], points, limit)]
    even = evenly_spread(len(frames), limit)
    if len(frames) <= limit or len(points) == 0:
        return even
    some = points[torch.tensor(evenly_spread(len(points), MAX_POINTS))].double()
    found, most = even, -1.0
    for length in (length for length in LENGTHS if length <= limit):
        starts = evenly_spread(len(frames) - length + 1, limit // length)
        chosen = sorted({start + k for start in starts for k in range(length)})
        seen = torch.stack([in_view(some, frames[i].camera) for i in chosen]).sum(0)
        often = float((seen[seen > 0] >= MIN_FRAMES).double().mean()) if bool(seen.any()) else 0.0
        if often > most:
            found, most = chosen, often
        if often >= ENOUGH:
            break
    return found


def in_view(points: Tensor, camera: Camera) -> Tensor:
    """Which points [P, 3] lie in a camera's field of view, [P] bool."""
    return camera.inside(*camera.project(points))


def _stands_still(cameras: Sequence[Camera], points: Tensor) -> bool:
    """Whether views were taken from one place: seen from all of them, points move by less than STILL_PX.

    A reconstruction gives a tripod a little motion. Where no point is in front of all cameras, their matrices are equal.
    """
    points = points[torch.tensor(evenly_spread(len(points), MAX_CANDIDATES), dtype=torch.long)]
    seen = torch.stack([to_camera(points, camera.viewmat)[:, 2] > 1e-9 for camera in cameras]).all(0)
    if not seen.any():
        viewmats = torch.stack([camera.viewmat for camera in cameras])
        return bool(torch.allclose(viewmats, viewmats[:1], rtol=0.0, atol=1e-6))
    pixels = torch.stack([to_pixels(to_camera(points[seen], camera.viewmat), camera.K) for camera in cameras])
    return bool((pixels - pixels[:1]).norm(dim=2).median(dim=1).values.max() < STILL_PX)


def _pixels(camera: Camera, images: Tensor, masks: Tensor | None) -> Tracks:
    """Tracks of a grid of pixels of a camera that stands still, one unit away."""
    count, height, width = images.shape
    every = max(1, math.ceil(math.sqrt(height * width / MAX_POINTS)))
    y, x = torch.meshgrid(
        torch.arange(every // 2, height, every), torch.arange(every // 2, width, every), indexing="ij"
    )
    x, y = x.flatten(), y.flatten()
    values = images[:, y, x].T.double()
    rays = torch.stack([(x + 0.5 - camera.K[0, 2]) / camera.K[0, 0], (y + 0.5 - camera.K[1, 2]) / camera.K[1, 1]], 1)
    local = functional.normalize(torch.cat([rays, torch.ones(len(rays), 1, dtype=torch.float64)], 1), dim=1)
    world = local @ camera.viewmat[:3, :3]
    positions = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], 1)
    ones = torch.ones_like(values)
    return Tracks(
        points=camera.center + world,
        values=values,
        slopes=torch.zeros_like(values),
        weights=ones.clone() if masks is None else masks[:, y, x].T.double(),
        distances=ones,
        directions=-world[:, None].expand(-1, count, -1),
        positions=positions[:, None].expand(-1, count, -1),
        radii=_radii(positions, width, height)[:, None].expand(-1, count),
    )


class Placed(NamedTuple):
    """Where points lie in an image.

    Args:
        pixels: [n, 2] (x, y); of points behind the camera they mean nothing.
        depths: [n] camera z.
        inside: [n] bool, before the camera and within the middles of the outermost pixels.
        positions: [n, 2] the pixels in [-1, 1], as ``between`` takes them.
    """

    pixels: Tensor
    depths: Tensor
    inside: Tensor
    positions: Tensor


def placed(points: Tensor, camera: Camera) -> Placed:
    """Where points [n, 3] lie in the image of a camera."""
    local = to_camera(points, camera.viewmat)
    ahead = local[:, 2] > 1e-9
    pixels = to_pixels(torch.where(ahead[:, None], local, local.new_ones(3)), camera.K)
    extent = pixels.new_tensor([camera.width, camera.height])
    inside = ahead & (pixels >= 0.5).all(1) & (pixels <= extent - 0.5).all(1)
    return Placed(pixels, local[:, 2], inside, 2.0 * pixels / extent - 1.0)


def tracks_of(
    points: Tensor, cameras: Sequence[Camera], images: Tensor, masks: Tensor | None, noise: float
) -> Tracks | None:
    """Tracks of scene points through images [F, H, W] with their masks; None where too few are seen often enough."""
    points = points[torch.tensor(evenly_spread(len(points), MAX_IN_FRONT))]
    count, height, width = images.shape
    followed = torch.tensor(evenly_spread(len(points), MAX_CANDIDATES))
    cell = max(2.0, math.sqrt(2.0 * width * height / len(points)))
    columns: dict[str, list[Tensor]] = {name: [] for name in Tracks.__dataclass_fields__ if name != "points"}
    for f, camera in enumerate(cameras):
        image, seen = images[f].double(), placed(points, camera)
        inside = seen.inside & ~_hidden(seen.pixels, seen.depths, seen.inside, cell, width)
        pixels, inside, position = seen.pixels[followed], inside[followed], seen.positions[followed]
        line, column = pixels[:, 1].clamp(0, height - 1).long(), pixels[:, 0].clamp(0, width - 1).long()
        towards = camera.center - points[followed]
        distance = towards.norm(dim=1)
        if masks is not None:
            inside = inside & counted_between(masks[f], position)
        columns["values"].append(between(image[..., None], position)[:, 0])
        columns["slopes"].append(_steepest(image, line, column, noise))
        columns["weights"].append(inside.double())
        columns["distances"].append(distance)
        columns["directions"].append(towards / distance[:, None].clamp_min(1e-12))
        columns["positions"].append(position)
        columns["radii"].append(_radii(position, width, height))
    tracks = Tracks(points[followed], **{name: torch.stack(values, 1) for name, values in columns.items()})
    seen = tracks.weights.sum(1)
    often = seen >= max(MIN_FRAMES, min(0.4 * count, 0.6 * float(seen.quantile(0.9))))
    if not often.any():
        return None
    tracks = tracks.of(often.nonzero()[:, 0])
    most = min(MAX_POINTS, MAX_OBSERVATIONS // count)
    if len(tracks.points) <= most:
        return tracks
    # The points of even surroundings: a point at an edge shows how well it is placed and little else.
    mean = (tracks.slopes * tracks.weights).sum(1) / tracks.weights.sum(1)
    return tracks.of(mean.argsort()[:most].sort().values)


def _steepest(image: Tensor, line: Tensor, column: Tensor, noise: float) -> Tensor:
    """Largest slope [n] of an image [H, W] within a pixel of each of these, per pixel; what noise alone makes is taken away."""
    height, width = image.shape
    around = torch.tensor([-1, 0, 1])
    line = (line[:, None, None] + around[:, None]).clamp(0, height - 1)
    column = (column[:, None, None] + around).clamp(0, width - 1)
    right, left = (column + 1).clamp_max(width - 1), (column - 1).clamp_min(0)
    below, above = (line + 1).clamp_max(height - 1), (line - 1).clamp_min(0)
    horizontal = 0.5 * (image[line, right] - image[line, left])
    vertical = 0.5 * (image[below, column] - image[above, column])
    squared = (horizontal**2 + vertical**2 - noise**2).clamp_min(0.0)  # of white noise it is noise² on average
    return squared.sqrt().amax((1, 2))


def _hidden(pixels: Tensor, depths: Tensor, inside: Tensor, cell: float, width: int) -> Tensor:
    """Which points [n] have a much nearer one beside them in the image."""
    across = int(width / cell) + 2
    cells = (pixels[:, 1] / cell).long() * across + (pixels[:, 0] / cell).long()
    cells = torch.where(inside, cells, 0)
    nearest = torch.full((int(cells.max()) + 1,), math.inf, dtype=depths.dtype)
    nearest.scatter_reduce_(0, cells[inside], depths[inside], "amin")
    return depths > (1.0 + NEARER) * nearest[cells]


def between(image: Tensor, positions: Tensor) -> Tensor:
    """Values [n, C] of an image [H, W, C] at positions [n, 2] in [-1, 1], bilinear between pixel centres."""
    found = functional.grid_sample(
        image.permute(2, 0, 1)[None], positions[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def counted_between(mask: Tensor, positions: Tensor) -> Tensor:
    """Whether all pixels count of which ``between`` has a share at positions [n, 2], [n] bool, by a mask [H, W] bool."""
    return between((~mask)[..., None].to(positions), positions)[:, 0] == 0


def slopes(image: Tensor, positions: Tensor) -> Tensor:
    """Slopes [n, 2] along x and y of an image [H, W] at positions [n, 2] in [-1, 1], per pixel: half of what it changes by from
    a pixel before to one behind, the image going on beyond its border as it ends there."""
    size = positions.new_tensor([image.shape[1], image.shape[0]])
    inside = 1.0 - 1.0 / size  # centres of the outermost pixels
    positions = positions.clamp(-inside, inside)
    found = []
    for step in (2.0 / size).diag():
        ahead, behind = (between(image[..., None], positions + way * step)[:, 0] for way in (1, -1))
        found.append(0.5 * (ahead - behind))
    return torch.stack(found, 1)


def _radii(positions: Tensor, width: int, height: int) -> Tensor:
    return ((positions * positions.new_tensor([width, height])) ** 2).sum(-1) / (width**2 + height**2)
