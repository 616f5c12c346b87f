"""The embedded synthetic scene: known geometry, materials, temperatures and times, in memory or on disk."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.contracts import SceneData, SceneError, View, ViewSet, as_written, check_option
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.formats.colmap import find_model
from heatsplat.datamodules.nerfstudio import find_transforms
from heatsplat.datamodules.raw_scene import RawFrame
from heatsplat.datamodules.synthetic_scene.drawn import DRAWN, Drawn, drawn
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, film, misplaced, own_threads
from heatsplat.datamodules.synthetic_scene.outdoor import OutdoorPreset, OutdoorScene, in_weather, training_frames
from heatsplat.datamodules.synthetic_scene.outdoor_sky import SKIES
from heatsplat.datamodules.synthetic_scene.outdoor_true import MOST_DAYS, OF_ANY_LENGTH, YARDS
from heatsplat.datamodules.synthetic_scene.parts import TRAIN, parts_of, rules
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.rooms import ROOM, number_of, room
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.geometry.resampling import resampled
from heatsplat.physics.units import DAY_S

LAYOUTS: dict[str, Callable[[Path], Path | None]] = {  # what in a folder marks scenes of another data set, if anything
    "rhd": lambda folder: find_model(folder / "thermal"),
    "colmap": find_model,
    "thermoscenes": lambda folder: next(folder.glob("transforms_thermal.json"), None),
    "nerfstudio": lambda folder: next(iter(find_transforms(folder)), None),
    "benchmark": lambda folder: next(folder.glob("scenes/*/meta.json"), None),
}
STORED = {8: np.uint8, 16: np.uint16}  # integer type of images by their bits


class Synthetic(SceneDataModule):
    """A scene that is solved, ray-traced and filmed when it is loaded; nothing is read from disk.

    Args:
        scene: outdoor, outdoor_true, facade, the name of a preset (``heatsplat.datamodules.synthetic_scene.presets``): static,
            cooling, ..., room_0, room_1 and so on, rooms furnished at random, or drawn_0 and so on, which draw everything.
        size: tiny, demo, benchmark or large.
        frames: number of frames; None for that of the size, or as drawn.
        noise_k: standard deviation of the camera's noise per pixel in kelvin (NETD); 0 for clean images; None for 0.05, or as
            drawn.
        bits: of the stored images, 8 or 16; None for 16, or as drawn.
        pose_error_px: by which cameras are turned from where they looked, standard deviation along each side of the image, in
            pixels; None for 0, or as drawn.
        scene_seed: of the hand's motion, the noise and the sparse points; another recording of the same scene.
        only: name of a surface; only its pixels count. None: all do.
        weather: outdoors: fair (None), calm, windy or overcast; all start from the same midnight.
        days: of outdoor and outdoor_true: 2 to 7, of which the last is held out; None takes 2.
        hours: of outdoor and outdoor_true: first and last hour of the day, in UTC, between which images are taken, such as
            (20, 4) for nights; None takes images at all hours. The weather of all hours is known.
        split: a rule, or None for the preset's own: the last day is held out outdoors, every 8th frame elsewhere. "parts" holds
            out several parts, whose names begin those of their frames, and gives every view its exact image.
        parts: what "parts" leaves out (``synthetic_scene.parts.parts_of``).
        root: None; the name is there so that every data set takes the same keys.
        **options: of ``SceneDataModule``: downscale, seed, ...
    """

    def __init__(
        self,
        *,
        scene: str = "cooling",
        size: str = "demo",
        frames: int | None = None,
        noise_k: float | None = None,
        bits: int | None = None,
        pose_error_px: float | None = None,
        scene_seed: int = 0,
        only: str | None = None,
        weather: str | None = None,
        days: int | None = None,
        hours: Sequence[float] | None = None,
        split: str | None = None,
        parts: Mapping[str, Any] | None = None,
        root: str | None = None,
        **options,
    ) -> None:
        if root is not None:
            raise SceneError(
                f"data.root={root} is given, but data=synthetic (the default) reads no folder: {_meant(Path(root).expanduser())}"
            )
        number = number_of(scene, DRAWN)
        self.drawn = None if number is None else drawn(number)
        in_parts = split == "parts"
        # The subsets of the frames ("json") are the parts, too.
        own_split = "json" if in_parts else YARDS[scene][1].split if scene in YARDS else "every_8th"
        super().__init__(root=root, scene=scene, split=own_split if in_parts else split or own_split, **options)
        _check_name(scene)
        _check_times(scene, days, hours)
        if weather is not None:
            _check_weather(scene, weather, self.drawn is not None)
        check_option("data.size", size, SIZES, SceneError)
        if frames is not None and frames < 2:
            raise SceneError(f"data.frames={frames}: a scene needs at least 2 frames, one to train and one to test")
        usual = self.drawn or Drawn(None, SIZES[size].frames, noise_k=0.05, bits=16, pose_error_px=0.0)
        self.size = replace(SIZES[size], frames=usual.frames if frames is None else frames)
        self.noise_k = usual.noise_k if noise_k is None else noise_k
        self.bits = usual.bits if bits is None else bits
        self.pose_error_px = usual.pose_error_px if pose_error_px is None else pose_error_px
        self._check_camera()
        self.scene_seed = scene_seed
        self.only = only
        self.weather, self.days = weather, days
        self.hours = None if hours is None else (float(hours[0]), float(hours[1]))
        self.parts = rules(parts) if in_parts else None

    def _check_camera(self) -> None:
        if not 0 <= self.noise_k < math.inf:
            raise SceneError(f"data.noise_k={self.noise_k}: the noise is a standard deviation in kelvin, 0 or more")
        if self.bits not in STORED:
            raise SceneError(f"data.bits={self.bits}: images are stored in 8 or 16 bits")
        if not 0 <= self.pose_error_px < math.inf:
            raise SceneError(
                f"data.pose_error_px={self.pose_error_px}: the error is a standard deviation in pixels, 0 or more"
            )

    def load(self) -> SceneData:
        """The recording as a scene; its truth and probes come from the solver."""
        world = self._yard()
        outdoors, number = world is not None, number_of(self.scene_name, ROOM)
        if self.drawn is not None:
            inside = self.drawn.preset
        else:
            inside = PRESETS.get(self.scene_name) if number is None else room(number)
        indoors = None if outdoors else Scene(inside)
        recording = film(world or indoors, self.size, self.scene_seed, self.noise_k)
        preset, count = recording.scene.preset, len(recording.times_s)
        parts = ["frame"] * count
        if self.parts is not None:
            parts = parts_of(recording.times_s, recording.viewmats, **self.parts)
        names = [surface.name for surface in preset.surfaces]
        if self.only is not None and self.only not in names:
            raise SceneError(f"data.only={self.only}: scene '{self.scene_name}' has {', '.join(names)}")
        with own_threads():
            probes, probe_names = probe_points(recording)
        viewmats = misplaced(recording, self.pose_error_px, self.scene_seed)
        scene = self.finish(
            self.scene_name,
            [
                RawFrame(
                    name=f"{parts[frame]}_{frame:05d}.png",
                    viewmat=viewmats[frame],
                    lens=recording.lens,
                    read=partial(recording.grey, frame, STORED[self.bits]),
                    read_rgb=partial(recording.rgb.__getitem__, frame),
                    read_mask=None if self.only is None else partial(recording.shows, frame, self.only),
                    time_s=float(time_s),
                    subset=self._subset(parts[frame], frame, count),
                )
                for frame, time_s in enumerate(recording.times_s)
            ],
            recording.points,
            point_colors=recording.point_colors,
            thermal_range=recording.thermal_range,
            ambient_c=preset.ambient_c,
            metres_per_unit=1.0,
            notes={
                "source": f"synthetic preset {self.scene_name}, scene_seed {self.scene_seed}",
                "noise_k": self.noise_k,
                "bits": self.bits,
                "pose_error_px": self.pose_error_px,
                "effects": sorted(preset.effects),
                "heat": recording.scene.how_solved(),
                "probes": probe_names,
            },
            probes=probes,
            truth=recording.scene.truth,
            **(_of_the_yard(world, recording) if outdoors else {}),
            **self._of_the_room(indoors),
        )
        return scene if recording.clean is None and self.parts is None else _with_clean(scene, recording)

    def _of_the_room(self, room: Scene | None) -> dict[str, Any]:
        """True properties of an indoor scene: of mirroring surfaces, and with ``parts`` of all."""
        if room is None or not (room.mirrors or self.parts is not None):
            return {}
        return {"true_attributes": room.grey_bodies if self.parts is None else room.attributes}

    def _subset(self, part: str, frame: int, count: int) -> str:
        trains = frame < training_frames(count) if self.parts is None else part == TRAIN
        return "train" if trains else "test"

    def _yard(self) -> OutdoorScene | None:
        """The solved scene under the sky; None where this one lies in a room."""
        if self.scene_name in YARDS:
            solved, known = YARDS[self.scene_name]
            known = in_weather(known, self.weather)
            if self.days is not None:
                known = replace(known, duration_s=self.days * DAY_S)
            return solved(known if self.hours is None else replace(known, hours=self.hours))
        preset = None if self.drawn is None else self.drawn.preset
        return OutdoorScene(preset) if isinstance(preset, OutdoorPreset) else None


def _check_name(scene: str) -> None:
    if scene not in PRESETS and scene not in YARDS and all(number_of(scene, name) is None for name in (ROOM, DRAWN)):
        known = ", ".join((*PRESETS, *YARDS, *(f"{name}0, {name}1 and so on" for name in (ROOM, DRAWN))))
        raise SceneError(f"data.scene={scene}: there is no such synthetic preset; choose one of {known}")


def _check_times(scene: str, days: int | None, hours: Sequence[float] | None) -> None:
    """Raises SceneError where a scene has no such length, or no such hours at which images are taken."""
    yards = " and ".join(OF_ANY_LENGTH)
    if days is not None and (scene not in OF_ANY_LENGTH or not 2 <= days <= MOST_DAYS):
        raise SceneError(f"data.days={days}: {yards} last 2 to {MOST_DAYS} days; leave it null elsewhere")
    if hours is None:
        return
    if scene not in OF_ANY_LENGTH:
        raise SceneError(f"data.hours={as_written(hours)}: {yards} know the hour of the day; leave it null elsewhere")
    pair = isinstance(hours, Sequence) and len(hours) == 2 and hours[0] != hours[1] and list(hours) != [24, 0]
    if not pair or not all(isinstance(hour, int | float) and 0 <= hour <= 24 for hour in hours):
        raise SceneError(
            f"data.hours={as_written(hours)}: give the first and the last hour in UTC, 0 to 24, such as [20,4] for nights"
        )


def _check_weather(scene: str, weather: str, drawn: bool) -> None:
    """Raises SceneError where a scene has no weather that could be chosen, or there is no such weather."""
    if scene not in YARDS:
        why = "has the weather that was drawn" if drawn else "lies in a room without weather"
        raise SceneError(f"data.weather={weather}: scene '{scene}' {why}; leave it null")
    if weather not in SKIES:
        raise SceneError(f"data.weather={weather}: choose one of {', '.join(SKIES)}, or null")


def _meant(folder: Path) -> str:
    """Which data set was meant by a folder, as its files tell, in words."""
    if not folder.is_dir():
        return "there is no such folder; leave data.root out for a made-up scene"
    places = (folder, *(place for place in sorted(folder.iterdir()) if place.is_dir()))
    for name, mark_in in LAYOUTS.items():
        if mark := next(filter(None, map(mark_in, places)), None):
            return f"did you mean data={name}? The folder has {mark.relative_to(folder)}"
    return (
        f"say with data=... what the folder holds ({', '.join(LAYOUTS)}, ...), make a scene of a camera's files by "
        "prepare.py, or leave data.root out for a made-up scene"
    )


def _of_the_yard(world: OutdoorScene, recording: Recording) -> dict[str, Any]:
    """What is known of an outdoor scene besides: its weather, the classes of its points, their true properties."""
    on_surface, which = world.nearest(torch.from_numpy(recording.points))
    return {
        "weather": world.weather,
        "labels": world.labels(on_surface).numpy(),
        "true_attributes": world.attributes,
    }


def _with_clean(scene: SceneData, recording: Recording) -> SceneData:
    """The scene whose views know what a flawless camera would have recorded."""

    def known(views: ViewSet) -> ViewSet:
        def decode(position: int) -> View:
            view = views[position]
            image = torch.from_numpy(recording.exact[view.frame.frame_id])[..., None]
            unit = scene.thermal_range.to_unit(image).clamp(0.0, 1.0)
            return replace(view, clean=resampled(unit, view.camera.height, view.camera.width, "area"))

        return ViewSet(views.frames, decode)

    flaws = "has noise" if recording.clean is None else "has flaws (effects)"
    notes = {**scene.notes, "camera": f"{flaws}; clean_* scores are against its clean record"}
    return replace(scene, train=known(scene.train), val=known(scene.val), test=known(scene.test), notes=notes)


def probe_points(recording: Recording) -> tuple[np.ndarray, list[str]]:
    """One point [n, 3] on each surface that the frames show, and the name of the surface.

    A probe stands where its neighbourhood is as warm as itself, so that a model is not judged by which side of a border
    its nearest Gaussian lies on: of the sparse points of a surface, moved onto it, the fifth with the least change of
    warmth within 4 cm (outdoors 25 cm) are taken, and of these the one nearest to the middle of the surface.
    """
    scene = recording.scene
    on_surface, which = scene.nearest(torch.from_numpy(recording.points))
    around = scene.probe_reach_m * torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * 3)
    probes, names = [], []
    for number, surface in enumerate(scene.preset.surfaces):
        own = on_surface[which == number]
        if not len(own):
            continue
        near, near_which = scene.nearest((own[:, None] + around).reshape(-1, 3))
        warmth = scene.warmth(near, near_which, surface)
        change = warmth.reshape(len(own), -1).std(dim=1)
        elsewhere = (near_which.reshape(len(own), -1) != number).any(1)
        order = (change + elsewhere * change.max().clamp_min(1.0)).argsort()
        even = own[order[: max(1, len(own) // 5)]]
        probes.append(even[(even - own.mean(0)).norm(dim=1).argmin()].numpy())
        names.append(surface.name)
    return np.stack(probes), names
