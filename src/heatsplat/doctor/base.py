"""What a check is, what it looks at, and what it finds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Camera, Frame, SceneData, View
from heatsplat.effects.observations import Tracks, difference_told, frames_to_follow, read, tracks_of
from heatsplat.effects.weather_record import QUICK_PER_S, SLOW_PER_S, drivers
from heatsplat.physics.noise import noise_of, usual_quantum

# Frames that are looked at: enough to find what is common, and cheap beside a training.
MAX_FRAMES = 32
NAMED = 3  # frames that a finding names
# Correlation from which two images are one: 0.998 from a tripod; where cameras move no recording has 0.9 in all frames.
SAME = 0.95
MAX_PIXELS = 1500  # of a camera that stands still
BLANK = 0.1  # of the contrast of the others, below which a frame shows nothing
CLEAR = 8.0  # contrast in noise from which frames are compared so
COARSE = 64  # pixels of the shorter side of images whose edges are compared
# Points and frames from which it can be told what all points do from frame to frame.
MIN_POINTS, MIN_FRAMES = 40, 5
LATER_S = 1800.0  # what sun and shade do in longer makes the same surface look like another
FRAMES_PER_LENS = 4  # fewer frames for each lens come of tools that fit one to every image


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Args:
        check: name of the check.
        cost: what it costs, as a share of the scene's contrast (standard deviation of image values) that training will get
            wrong where it is; findings are ordered by it.
        what: in a sentence, with figures in their units.
        remedy: what helps, in a sentence.
        frames: names of the frames that it concerns; empty where it concerns all.
    """

    check: str
    cost: float
    what: str
    remedy: str
    frames: tuple[str, ...] = ()


@dataclass(frozen=True)
class Material:
    """What a doctor looks at: a recording with or without cameras.

    Args:
        names, times_s: of all frames, in the order of the recording; times in seconds, None where there are none.
        chosen: positions in them of the frames whose images are here.
        images: [F, H, W] of those frames, as they were read: image values, or °C where there is no range yet; NaN does not
            count. ``image`` and ``known`` give one of them in float64.
        unit_k: kelvin per image value, None where they are no temperatures.
        masks: [F, H, W] bool, or None where all pixels count.
        photos: brightness [h, w] of visible images of the same frames and cameras, no finer than ``coarse``, or None.
        rgb_times_s: when the photos of all frames were taken, on their own camera's clock, or None.
        cameras: of the same frames, or None.
        all_cameras: of all training frames, or None.
        points: [P, 3] of the scene, or None where there are none but random ones.
        bounds_c: temperatures of image values 0 and 1, or None.
        bounds_chosen: whether heatsplat took these bounds from the training images, as nobody gave any.
        bounds_in: what gave them, such as a file; "" where that is not known.
        stored: what the image files hold: "celsius" (floating point), "radiometric", "counts", "grey8" or "grey16"; "" where
            unknown.
        clipped: share of pixels that lay outside the bounds, or None where unknown.
        answers: [F, k] how surfaces answer recorded weather in the frames of ``images``; None without a record.
        lenses: for every frame, the number of the camera that took it; empty where one took all.
        without_camera: how many images of a model's folder have no camera in it, and how many images there are.
        poses_in: where poses come from, in words.
        poses_are: what the matrices there are read as, in the words of ``checks.conventions``.
        origin: what was subtracted from the world of these files.
    """

    names: Sequence[str]
    times_s: Sequence[float] | None
    chosen: Sequence[int]
    images: Tensor
    unit_k: float | None = None
    masks: Tensor | None = None
    photos: Sequence[Tensor] | None = None
    rgb_times_s: Sequence[float] | None = None
    cameras: Sequence[Camera] | None = None
    all_cameras: Sequence[Camera] | None = None
    points: Tensor | None = None
    bounds_c: tuple[float, float] | None = None
    bounds_chosen: bool = False
    bounds_in: str = ""
    stored: str = ""
    clipped: float | None = None
    answers: Tensor | None = None
    lenses: Sequence[int] = ()
    without_camera: tuple[int, int] = (0, 0)
    poses_in: str = "the sparse model"
    poses_are: str = "world-to-camera in OpenCV axes"
    origin: Sequence[float] = (0.0, 0.0, 0.0)

    @cached_property
    def chosen_times_s(self) -> Tensor | None:
        """Times [F] float64 of the frames of ``images``, None where there are none."""
        return None if self.times_s is None else torch.tensor(self.times_s, dtype=torch.float64)[list(self.chosen)]

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a pixel's noise, in units of ``images``."""
        return noise_of(self.images, usual_quantum(self.images, self.masks), self.masks)

    @cached_property
    def contrast(self) -> float:
        """Standard deviation of what the images show."""
        spread = [own for own in self._spread if own is not None]
        return max(statistics.median_low(spread) if spread else 0.0, self.noise, 1e-9)

    @cached_property
    def blank(self) -> list[int]:
        """Frames of ``images`` that have one level all over, but for noise where the others show the scene."""
        least = BLANK * self.contrast if self.contrast >= CLEAR * self.noise else 0.0
        return [f for f, own in enumerate(self._spread) if own is not None and (own == 0 or own < least)]

    @cached_property
    def _spread(self) -> list[float | None]:
        """Standard deviation of the pixels of each frame that count, exactly 0 of equal ones; None where fewer than two do."""
        known = (self.known(f) for f in range(len(self.images)))
        return [
            None if len(values) < 2 else 0.0 if values.min() == values.max() else float(values.std())
            for values in known
        ]

    @cached_property
    def tracks(self) -> Tracks | None:
        """Scene points through the images, or None where there are no cameras and points, or too few."""
        if self.cameras is None or self.points is None or not len(self.points):
            return None
        return tracks_of(self.points.double(), self.cameras, self.images, self.masks, self.noise)

    @cached_property
    def followed(self) -> tuple[Tensor, Tensor] | None:
        """What points of the scene show in every frame, [P, F], and the weight of each: along tracks, or, of a camera without
        poses that stands still, at pixels of a grid. None where neither is known."""
        if self.tracks is not None:
            return self.tracks.values, self.tracks.weights
        if self.cameras is not None or not self.still:
            return None
        every = max(1, math.ceil(math.sqrt(self.images[0].numel() / MAX_PIXELS)))
        grid = (slice(None), slice(every // 2, None, every), slice(every // 2, None, every))
        values = self.images[grid].flatten(1).T.double()
        counts = values.isfinite() if self.masks is None else values.isfinite() & self.masks[grid].flatten(1).T
        return values.nan_to_num(), counts.double()

    @cached_property
    def still(self) -> bool:
        """Whether every frame shows what the middle one shows, but for its level, noise and gain."""
        middle = len(self.images) // 2
        return all(self._alike(f, middle) > SAME for f in range(len(self.images)) if f != middle)

    def near_in_time(self, frame: int) -> Tensor:
        """Frames [F] bool of ``images`` that were taken so close to one that heat has not changed what they show."""
        if self.chosen_times_s is None:
            return torch.ones(len(self.images), dtype=torch.bool)
        return (self.chosen_times_s - self.chosen_times_s[frame]).abs() <= LATER_S

    def _alike(self, frame: int, other: int) -> float:
        """Correlation of two images, without what noise takes of it; 0 where one shows nothing beside noise."""
        counts = self.counts(frame) & self.counts(other)
        values = torch.stack([self.image(frame)[counts], self.image(other)[counts]])
        if values.shape[1] < 2:
            return 0.0
        shown = values - values.mean(1, keepdim=True)
        size = shown.square().mean(1) - self.noise**2
        if not bool((size > self.noise**2).all()):
            return 0.0
        return float((shown[0] * shown[1]).mean() / size.prod().sqrt())

    def image(self, frame: int) -> Tensor:
        """The image [H, W] float64 of a frame."""
        return self.images[frame].double()

    def counts(self, frame: int) -> Tensor:
        """Which pixels [H, W] bool of a frame count."""
        finite = self.images[frame].isfinite()
        return finite if self.masks is None else finite & self.masks[frame]

    def known(self, frame: int) -> Tensor:
        """Values [n] float64 of the pixels of a frame that count."""
        return self.image(frame)[self.counts(frame)]

    def name(self, frame: int) -> str:
        """Name of a frame of ``images``."""
        return self.names[self.chosen[frame]]

    @property
    def grid(self) -> str:
        """Width and height of the images, which need not be those of the files (data.downscale)."""
        return "x".join(map(str, self.images.shape[:0:-1]))

    def size(self, value: float) -> str:
        """A difference of values in words."""
        return difference_told(value, self.unit_k)


@dataclass(frozen=True)
class Check:
    """Something that can be wrong.

    Args:
        name: in findings and docs.
        summary: what is looked at, in a sentence.
        find: what is wrong with a recording; empty where nothing is or where it cannot be told.
        discredits: what of a ``Material`` the other checks do not look at where this one finds something, as what it says then
            is no finding of its own.
    """

    name: str
    summary: str
    find: Callable[[Material], list[Finding]]
    discredits: tuple[str, ...] = ()


def material_of(scene: SceneData) -> Material:
    """What a doctor looks at of a scene: its training views."""
    frames = scene.train.frames
    points = None if "points_random" in scene.notes else scene.points
    chosen = frames_to_follow(frames, scene.points[:0] if points is None else points, MAX_FRAMES)
    looked, images, masks = read(scene.train, chosen, _looked)
    kept, cameras, photos = map(list, zip(*looked, strict=True)) if looked else ([], [], [])
    times = [frame.time_s for frame in frames]
    timed = all(time is not None for time in times)
    seen_s = torch.tensor([times[i] for i in kept], dtype=torch.float64) if timed else None
    bounds = scene.thermal_range
    return Material(
        names=[frame.name for frame in frames],
        times_s=times if timed else None,
        chosen=kept,
        images=images,
        unit_k=None if bounds is None else bounds.span_k,
        masks=masks,
        photos=None if any(photo is None for photo in photos) else photos,
        cameras=cameras,
        all_cameras=[frame.camera for frame in frames],
        points=points,
        bounds_c=None if bounds is None else (bounds.min_c, bounds.max_c),
        bounds_chosen="training_images_c" in scene.notes,
        bounds_in=str(scene.notes.get("bounds_source", "")).partition(":")[0].partition(" (")[0],
        stored=_stored(scene),
        clipped=scene.notes.get("clipped_fraction"),
        answers=drivers(scene.weather, seen_s, air=(QUICK_PER_S, SLOW_PER_S)),
        lenses=_lenses(frames),
        without_camera=_without_camera(scene),
        **_poses(scene),
        origin=scene.notes.get("origin", (0.0, 0.0, 0.0)),
    )


def _looked(position: int, view: View) -> tuple[int, Camera, Tensor | None]:
    """What is kept of a view beside its thermal image: its position, its camera and its photo."""
    return position, view.camera, None if view.rgb is None else coarse(view.rgb.mean(2))


def _stored(scene: SceneData) -> str:
    """What the image files of a scene hold, as its loader noted it."""
    if "radiometric" in scene.notes.get("encoding", ""):
        return "radiometric"
    kinds = {
        "float32": "celsius",
        "uint8": "grey8",
        "uint16": "counts" if "clipped_fraction" in scene.notes else "grey16",
    }
    return kinds.get(scene.notes.get("pixel_type", ""), "")


def _without_camera(scene: SceneData) -> tuple[int, int]:
    """How many images have no camera, and how many images there are; as far as the loader noted them."""
    lost = int(str(scene.notes.get("images_unregistered", "0")).split()[0])
    return lost, lost + len(scene.train) + len(scene.test)


def _poses(scene: SceneData) -> dict[str, str]:
    """Where the poses of a scene come from, and what its matrices are read as, where they do not come from a sparse model."""
    files, _, axes = str(scene.notes.get("cameras", "")).rpartition(", ")
    return {"poses_in": files, "poses_are": f"camera-to-world in {axes}"} if axes.endswith(" axes") else {}


def coarse(image: Tensor, side: int = COARSE) -> Tensor:
    """An image [h, w] float64 with so many pixels along its shorter side, by means over areas of [H, W]; as it is where it has
    no more, and 0 where nothing is known."""
    scale = max(1.0, min(image.shape) / side)
    return shrunk(image, (round(image.shape[0] / scale), round(image.shape[1] / scale)))


def shrunk(image: Tensor, size: tuple[int, int]) -> Tensor:
    """An image [H, W] on a grid (height, width), float64, by means over areas; 0 where nothing is known."""
    return functional.interpolate(image[None, None].double().nan_to_num(), size, mode="area")[0, 0]


def _lenses(frames: Sequence[Frame]) -> list[int]:
    """Which camera took each frame, by its intrinsics; where these are nearly as many as frames they tell none apart."""
    numbers: dict[object, int] = {}
    found = [
        numbers.setdefault((c.width, c.height, *c.K.flatten().tolist()), len(numbers))
        for c in (frame.camera for frame in frames)
    ]
    return found if 1 < len(numbers) <= len(frames) / FRAMES_PER_LENS else []


def some(names: Sequence[str]) -> str:
    """The first few of many names."""
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
