"""Several scenes as one: beside one another in space and after one another in time, for models that they share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from heatsplat.contracts import (
    RAIN,
    WEATHER_COLUMNS,
    WEATHER_DERIVED,
    Camera,
    SceneData,
    SceneError,
    ThermalRange,
    View,
    ViewSet,
    Weather,
    as_written,
)
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.physics.units import DAY_S


@dataclass(frozen=True)
class JoinedScenes(SceneData):
    """Scenes as one, in metres. Distances between them are no size of anything.

    Args:
        largest_extent: the largest extent of a scene among them.
    """

    largest_extent: float = 1.0

    @property
    def extent(self) -> float:
        return self.largest_extent


class Scenes(SceneDataModule):
    """Scenes of one data set, joined: the network of a model is trained on all of them, each Gaussian belongs to one.

    Every scene keeps its cameras, its split, its weather and its clock; only the zero of its clock moves, by whole days,
    so that no two records overlap, and its place, so that no camera sees what is not its own within ``far``. Images are
    brought to one thermal range.

    Args:
        each: makes the data module of a scene from its name, ``each(scene=name)``.
        scenes: names of the scenes, two or more.
        far: metres that a camera sees; scenes lie this far from one another. The renderer must cut there, too.
        downscale: factor by which images shrink, 1 or larger, given to ``each``.
        root: folder of the scenes, given to ``each``; None leaves ``each`` its own.
        scene: not used.
        seed: of the order of views.

    Raises:
        SceneError: fewer than two scenes, or what they have does not fit together.
    """

    def __init__(
        self,
        *,
        each: Callable[..., SceneDataModule],
        scenes: Sequence[str] | None,
        far: float = 1000.0,
        downscale: float = 1.0,
        root: str | None = None,
        scene: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(root=root, scene=scene, seed=seed)
        if scenes is None or isinstance(scenes, str) or len(scenes) < 2:
            raise SceneError(
                f"data.scenes must list two or more scenes, such as [S1, S2, S3]; got {as_written(scenes)}"
            )
        if not far > 0:
            raise SceneError(f"data.far must be a positive number of metres, got {far}")
        place = {} if root is None else {"root": root}
        self.parts = [each(scene=name, downscale=downscale, **place) for name in scenes]
        self.far = far

    def load(self) -> SceneData:
        return joined([part.scene for part in self.parts], self.far)


def joined(scenes: Sequence[SceneData], far: float) -> JoinedScenes:
    """Scenes as one; see ``Scenes``. Points keep their order, scene after scene, and so do views.

    Raises:
        SceneError: a scene has no metric scale, no times or no thermal range, is larger than ``far``, or has another
            vertical than the first.
    """
    for scene in scenes:
        missing = {"metres", "time", "thermal_range"} - scene.metadata
        if missing:
            raise SceneError(
                f"scene '{scene.name}' cannot be joined with others: it lacks {', '.join(sorted(missing))}"
            )
    bounds = ThermalRange(
        min(scene.thermal_range.min_c for scene in scenes), max(scene.thermal_range.max_c for scene in scenes)
    )
    shifts, radii = _places(scenes, far)
    delays = _delays(scenes)
    parts = list(zip(scenes, shifts, delays, strict=True))
    counts = [1 + max(f.frame_id for part in (s.train, s.test) for f in part.frames) for s in scenes]
    firsts = [sum(counts[:number]) for number in range(len(scenes))]

    def views(name: str) -> ViewSet:
        moved = [
            _moved(getattr(scene, name), scene, shift, delay, first, bounds)
            for (scene, shift, delay), first in zip(parts, firsts, strict=True)
        ]
        owners = [(part, position) for part in moved for position in range(len(part))]
        return ViewSet([f for part in moved for f in part.frames], lambda i: owners[i][0][owners[i][1]])

    def all_of(name: str) -> Tensor | None:
        values = [getattr(scene, name) for scene in scenes]
        return None if any(value is None for value in values) else torch.cat(values)

    features = {scene.point_features.shape[1] for scene in scenes if scene.point_features is not None}
    ambients = {scene.ambient_c for scene in scenes}
    return JoinedScenes(
        name="+".join(scene.name for scene in scenes),
        train=views("train"),
        val=views("val"),
        test=views("test"),
        points=torch.cat([s.points * s.metres_per_unit + shift.float() for s, shift, _ in parts]),
        point_colors=all_of("point_colors"),
        thermal_range=bounds,
        ambient_c=ambients.pop() if len(ambients) == 1 else None,
        metres_per_unit=1.0,
        weather=_weather([scene.weather for scene in scenes], delays),
        labels=all_of("labels"),
        point_features=all_of("point_features") if len(features) == 1 else None,
        notes={
            "scenes": [scene.name for scene in scenes],
            "places_m": [shift.tolist() for shift in shifts],
            "radii_m": radii,
            "delays_s": delays,
            "far_m": far,
        },
        largest_extent=max(scene.extent * scene.metres_per_unit for scene in scenes),
    )


def _places(scenes: Sequence[SceneData], far: float) -> tuple[list[Tensor], list[float]]:
    """Shifts [3] float64 in metres that set the scenes along x, ``far`` apart, and their radii."""
    shifts, radii, right = [], [], 0.0
    for scene in scenes:
        cameras = torch.stack([f.camera.center for part in (scene.train, scene.test) for f in part.frames])
        what = torch.cat([cameras, scene.points.double()]) * scene.metres_per_unit
        center = (what.amin(0) + what.amax(0)) / 2
        radius = float((what - center).norm(dim=1).max())
        if 2 * radius > far:
            raise SceneError(
                f"scene '{scene.name}' is {2 * radius:.4g} m across, more than data.far={far:g} m; give a larger data.far"
            )
        place = torch.tensor([0.0 if not radii else right + far + radius, 0.0, 0.0], dtype=torch.float64)
        shifts.append(place - center)
        radii.append(radius)
        right = float(place[0]) + radius
    return shifts, radii


def _delays(scenes: Sequence[SceneData]) -> list[float]:
    """Seconds, whole days, by which each clock is put forward so that records follow one another."""
    delays, ends = [], -math.inf
    for scene in scenes:
        times = [f.time_s for part in (scene.train, scene.test) for f in part.frames]
        record = [] if scene.weather is None else scene.weather.times_s[[0, -1]].tolist()
        first, last = min([*times, *record]), max([*times, *record])
        delay = 0.0 if not delays else DAY_S * math.floor((ends - first) / DAY_S + 1)
        delays.append(delay)
        ends = delay + last
    return delays


def _moved(views: ViewSet, scene: SceneData, shift: Tensor, delay: float, first: int, bounds: ThermalRange) -> ViewSet:
    """Views of a scene in the place, on the clock and in the thermal range of the whole."""
    gain = scene.thermal_range.span_k / bounds.span_k
    offset = bounds.to_unit(scene.thermal_range.min_c)

    def camera_of(camera: Camera) -> Camera:
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] = scene.metres_per_unit * viewmat[:3, 3] - viewmat[:3, :3] @ shift
        return Camera(viewmat, camera.K, camera.width, camera.height)

    frames = [
        replace(
            frame,
            name=f"{scene.name}/{frame.name}",
            frame_id=first + frame.frame_id,
            camera=camera_of(frame.camera),
            time_s=frame.time_s + delay,
        )
        for frame in views.frames
    ]

    def decode(position: int) -> View:
        view = views[position]
        warm = {n: getattr(view, n) * gain + offset for n in ("thermal", "clean") if getattr(view, n) is not None}
        return replace(view, frame=frames[position], **warm)

    return ViewSet(frames, decode)


def _weather(records: Sequence[Weather | None], delays: Sequence[float]) -> Weather | None:
    """The records one after another, with the series that all of them have; None where a scene has none."""
    if any(record is None for record in records):
        return None
    up = records[0].up
    if any(float(record.up @ up) < 0.999 for record in records):
        raise SceneError("scenes to be joined must agree on what is up (weather.up); turn their worlds first")
    series = (*WEATHER_COLUMNS, *WEATHER_DERIVED, RAIN)
    known = [name for name in series if all(getattr(record, name) is not None for record in records)]
    return Weather(
        torch.cat([record.times_s + delay for record, delay in zip(records, delays, strict=True)]),
        up=up,
        notes={"source": "joined: " + ", ".join(str(record.notes.get("source", "?")) for record in records)},
        **{name: torch.cat([getattr(record, name) for record in records]) for name in known},
    )
