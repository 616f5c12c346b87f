"""Shots: which cameras at which times, and the files that a trained scene writes of them."""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import (
    Camera,
    Frame,
    SceneData,
    SceneError,
    View,
    as_written,
    check_count,
    check_numbers,
    check_option,
    counted,
    evenly_spread,
    quantile,
)
from heatsplat.geometry import trajectories
from heatsplat.geometry.coverage import Sighting
from heatsplat.io.files import LONGEST_STEM, short_name
from heatsplat.io.pictures import THERMAL, Bar, Panel, bar_unit, compose, fitted, image_panel, write_figure, write_png
from heatsplat.io.quantities import clock_of, moment
from heatsplat.io.tiff import write_temperature
from heatsplat.io.video import video as film

log = logging.getLogger("heatsplat")

DEVIATION = "viridis"  # colours of what are no temperatures
# Points, and shares of them, by whose depths these colours end; and by which share of a depth they go beyond.
DEPTH_POINTS, DEPTH_ENDS, DEPTH_MARGIN = 1000, (0.02, 0.98), 0.1

TRAJECTORIES = ("orbit", "path", "test", "train", "view", "cameras")
Times = float | str | Sequence[float | str]  # seconds since the first training frame, or date-times; one or several
UNSEEN = ("nan", "keep")  # what becomes of pixels that no training view has seen


def shot_frames(
    scene: SceneData,
    trajectory: str = "orbit",
    time: Times | None = None,
    view: int | str = 0,
    count: int = 60,
    finer: int = 1,
    cameras: Sequence[Frame] = (),
) -> list[Frame]:
    """The frames of a shot, in order.

    Args:
        scene: whose cameras and record of time are meant.
        trajectory: "orbit" around the scene, "path" smoothly through given cameras or else those of training, "test" or "train"
            as taken, "view", one camera that stands still, or "cameras", those that are given.
        time: seconds since the first training frame, or a date-time; [start, end] lets time pass over the shot; None takes the
            time of each view (test, train), the whole record (view; for a single frame when the view was taken) or its middle
            (orbit, path, and cameras without one); along a path through given cameras that have times it passes as theirs do.
        view: for "view": position among the training frames, or file name.
        count: frames of "orbit", "path" and "view".
        finer: how many of their pixels lie beside one of a training image (super-resolution); "test", "train" and "cameras" are
            as they are.
        cameras: those of "cameras" and "path", in the world and on the clock of the scene; a time of None is not known.

    Raises:
        SceneError: a setting that ``check_shot`` refuses, an unknown view, views of which the scene has none, or no orbit where
            all cameras look along one line.
    """
    check_shot(trajectory, time, view, count)
    time = None if time is None else seconds_in(scene, time)
    if trajectory in ("test", "train"):
        frames = getattr(scene, trajectory).frames
        if not frames:
            raise SceneError(
                f"trajectory={trajectory}: scene '{scene.name}' has no such views; give another trajectory"
            )
        own = [frame.time_s for frame in frames]
    elif trajectory == "cameras":
        frames = _numbered(scene, [(frame.name, frame.camera) for frame in cameras])
        own = [scene.middle_s if frame.time_s is None else frame.time_s for frame in cameras]
    else:
        name, shown, own = _filmed(scene, trajectory, view, count, cameras)
        finer_cameras = [camera.resized(finer * camera.width, finer * camera.height) for camera in shown]
        names = (str(name.with_stem(f"{name.stem}_{i:04d}")) for i in range(count))
        frames = _numbered(scene, zip(names, finer_cameras, strict=True))
    moments = own if time is None else _moments(time, len(frames))
    return [at_time(scene, frame, moment) for frame, moment in zip(frames, moments, strict=True)]


def _numbered(scene: SceneData, shown: Iterable[tuple[str, Camera]]) -> list[Frame]:
    """Frames of these names and cameras, of which the scene has none."""
    return [Frame(name, number, camera) for number, (name, camera) in enumerate(shown, first_free_id(scene))]


def _filmed(
    scene: SceneData, trajectory: str, view: int | str, count: int, cameras: Sequence[Frame]
) -> tuple[PurePosixPath, list[Camera], list[float | None]]:
    """What images of "orbit", "path" or "view" are called after, their cameras, and their times where none are asked for."""
    if trajectory == "view":
        still = viewed(scene, view)
        record = [time_s for time_s in scene.train.times_s if time_s is not None]
        times = _moments([min(record), max(record)], count) if count > 1 and record else [still.time_s] * count
        return PurePosixPath(still.name), trajectories.fixed_view(still.camera, count), times
    times = [scene.middle_s] * count
    own = [frame.time_s for frame in cameras] if trajectory == "path" else []
    if own and None not in own:
        # Equal shares of the frames between neighbours, as their places have.
        times = np.interp(np.linspace(0, len(own) - 1, count), range(len(own)), own).tolist()
    return PurePosixPath(trajectory), _moving(scene, trajectory, count, cameras), times


def check_shot(trajectory: str, time: Times | None, view: int | str, count: int) -> None:
    """Raises SceneError where a setting of ``shot_frames`` is none, whatever the scene."""
    check_option("trajectory", trajectory, TRAJECTORIES, SceneError)
    if time is not None and len(checked_times(time)) > 2:
        raise SceneError(f"time must be one moment or [start, end], got {list(time)}")
    if not isinstance(view, int | str):
        raise SceneError(f"view must be the whole number or the file name of a training frame, got {as_written(view)}")
    check_count("frames", count)


def checked_times(time: Times) -> list[float | datetime]:
    """Moments that were given as one or as a list: seconds since the first training frame, or date-times (ISO 8601). Raises
    SceneError where they are neither, or there is none."""
    listed = [*time] if isinstance(time, Sequence) and not isinstance(time, str) else [time]
    if not listed:
        raise SceneError("time must be a number of seconds or a list of them, got []")
    return [_date_time(one) if isinstance(one, str) else _number(one) for one in listed]


def _number(time: float) -> float:
    check_numbers("time", time, error=SceneError)
    return time


def _date_time(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        raise SceneError(
            f"time must be a number of seconds or a date-time such as 2024-08-07T09:12, got {text}"
        ) from None


def seconds_in(scene: SceneData, time: Times) -> list[float]:
    """Moments in seconds since the first training frame of a scene.

    **Convention:** date-times are those of the scene's clock (``SceneData.clock_at_zero_s``), which reports and pictures show:
    UTC where there is a weather record, unless they say another zone; else as the camera's clock showed them.

    Raises:
        SceneError: as ``checked_times``; or a date-time where nothing tells the clock, or with a zone where nothing tells its.
    """
    return [_second(scene, one) if isinstance(one, datetime) else one for one in checked_times(time)]


def _second(scene: SceneData, moment: datetime) -> float:
    zero_s = scene.clock_at_zero_s
    if zero_s is None:
        raise SceneError(
            f"time={moment.isoformat()}: nothing tells which date the images of scene '{scene.name}' have; give seconds since "
            "the first training frame"
        )
    if moment.tzinfo is not None and scene.weather is None:
        raise SceneError(
            f"time={moment.isoformat()}: nothing tells the time zone of the camera's clock of scene '{scene.name}'; give the "
            "time as it showed it, without a zone"
        )
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() - zero_s


def checked_unseen(name: str, value: str | float) -> str:
    """One of UNSEEN; a NaN is the word, which Hydra reads as a number. Raises SceneError with the option's ``name``."""
    word = "nan" if value != value else value
    check_option(name, word, UNSEEN, SceneError)
    return word


def first_free_id(scene: SceneData) -> int:
    """The first ``frame_id`` that no frame of the scene has."""
    return 1 + max(frame.frame_id for frame in scene.frames)


def at_time(scene: SceneData, frame: Frame, moment: float | None) -> Frame:
    """The frame at a moment, with the weather of that moment where the scene has a record."""
    if moment == frame.time_s or scene.weather is None:
        return replace(frame, time_s=moment)
    return replace(frame, time_s=moment, environment=None if moment is None else scene.weather.at(moment))


def _moving(scene: SceneData, trajectory: str, count: int, given: Sequence[Frame]) -> list[Camera]:
    if trajectory == "path":
        return trajectories.interpolate([frame.camera for frame in given or scene.train.frames], count)
    try:
        return trajectories.orbit([frame.camera for frame in scene.train.frames], count)
    except ValueError as error:
        raise SceneError(str(error)) from error


def viewed(scene: SceneData, view: int | str) -> Frame:
    """A training frame by its position or file name. Raises SceneError where there is none, or several have the name."""
    taken = scene.train.frames
    if isinstance(view, str) and not re.fullmatch(r"-?[0-9]+", view):
        names = [frame.name for frame in taken]
        alike = [i for i, name in enumerate(names) if Path(name).name == Path(view).name]
        found = [names.index(view)] if view in names else alike
        if not found:
            raise SceneError(f"view '{view}' is no training frame; there are {', '.join(names[:8])} ...")
        if len(found) > 1:
            raise SceneError(f"view '{view}' may be {', '.join(names[i] for i in found)}: name it with its folder")
        return taken[found[0]]
    if not -len(taken) <= int(view) < len(taken):
        raise SceneError(f"view {view} does not exist: scene '{scene.name}' has training frames 0 to {len(taken) - 1}")
    return taken[int(view)]


def _moments(bounds: Sequence[float], count: int) -> list[float]:
    return np.linspace(bounds[0], bounds[-1], count).tolist()


SIGHTING_SIZE = 192  # pixels of the longer side of the depth maps of training views: coarse enough to keep all of them


def sightings(scene: SceneData, depth_of: Callable[[Frame], Tensor]) -> list[Sighting]:
    """What each training view has seen, for ``geometry.coverage.covered``.

    Args:
        scene: with its training views.
        depth_of: gives the depth [H, W] of the surface in a frame, infinite where there is none.
    """
    found = []
    for view in scene.train:
        coarse = view.camera.within(SIGHTING_SIZE)
        found.append(Sighting(coarse, depth_of(replace(view.frame, camera=coarse)).cpu(), mask_on(coarse, view)))
    return found


def mask_on(coarse: Camera, view: View) -> Tensor | None:
    """The mask of a view on the coarser grid of a camera, [H, W] bool, True where a pixel counts; None where all do."""
    if view.mask is None:
        return None
    rows = np.arange(coarse.height) * view.camera.height // coarse.height
    columns = np.arange(coarse.width) * view.camera.width // coarse.width
    return view.mask[rows][:, columns]


def deviations_told(scene: SceneData) -> str:
    """What a standard deviation is of: the error of the scene, beside that of the camera where preparation knows it."""
    known = scene.notes.get("prepared_uncertainty_c")
    return "1σ" if known is None else f"1σ, without the camera's own error (±{known:.1f} °C, prepare)"


def warn_beyond_record(scene: SceneData, frames: Sequence[Frame], assumption: str) -> bool:
    """Whether some frames lie beyond the training record; if so, one warning names them, the record and ``assumption``.

    Args:
        scene: with the record.
        frames: of a shot.
        assumption: of the thermal model beyond the record (``thermal.base.Heat.beyond_record``).
    """
    beyond = sorted(frame.time_s for frame in frames if scene.beyond_record(frame.time_s))
    if beyond:
        times = scene.train.times_s
        log.warning(
            "%d of %d frames, at %s s, beyond the training record (%.6g to %.6g s): predictions, not measurements. "
            "The model's assumption there: %s", len(beyond), len(frames),
            " to ".join(f"{moment:.6g}" for moment in sorted({beyond[0], beyond[-1]})), min(times), max(times), assumption,
        )  # fmt: skip
    return bool(beyond)


@dataclass
class ShotFiles:
    """The files of a shot: those of the kinds that are wanted are written, and their paths kept.

    What belongs to an image has a ``suffix``: "" for the first of a frame, "_clean" for one of that name.

    Args:
        folder: where they lie.
        tiff, png, video: which of them to write.
        fps: images per second of a video.
        codec: of videos (``io.video.video``).
        figures: "pdf" or "svg" writes a figure for print of each frame, all its images in a row; None none.
    """

    folder: Path
    tiff: bool = True
    png: bool = True
    video: bool = True
    fps: float = 15.0
    codec: str = "auto"
    figures: str | None = None
    written: list[Path] = field(default_factory=list, init=False)
    videos: ExitStack = field(default_factory=ExitStack, init=False, repr=False)  # closes those that are open
    _films: dict[str, tuple[Callable[[np.ndarray], None], tuple[int, int]]] = field(
        default_factory=dict, init=False, repr=False
    )  # what adds a picture to each, and height and width of its pictures

    def add(self, name: str) -> Path:
        """The path of a file that is written now."""
        self.written.append(self.folder / name)
        return self.written[-1]

    def of_others(self) -> list[Path]:
        """Files of the same kinds in the folder that this shot did not write."""
        kinds = ("tiff*/*.tiff", "png*/*.png", "video*.mp4", "figures/*")
        return sorted({path for kind in kinds for path in self.folder.glob(kind)} - {*self.written})

    def add_values(self, suffix: str, stem: str, values: Tensor) -> None:
        """Writes values [H, W] of a frame."""
        if self.tiff:
            write_temperature(self.add(f"tiff{suffix}/{stem}.tiff"), values)

    def add_picture(self, suffix: str, stem: str, panel: Panel, title: str, moving: bool = True) -> None:
        """Writes a picture of a frame under a title, and adds it to its video where it is ``moving``: at the size of its first
        picture, for cameras may have images of several."""
        filmed = self.video and moving
        if not (self.png or filmed):
            return
        picture = compose([panel], title)
        if self.png:
            write_png(self.add(f"png{suffix}/{stem}.png"), picture)
        if filmed:
            if suffix not in self._films:
                path = self.add(f"video{suffix}.mp4")
                self._films[suffix] = self.videos.enter_context(film(path, self.fps, self.codec)), picture.shape[:2]
            add, size = self._films[suffix]
            add(picture if picture.shape[:2] == size else fitted(picture, *size))

    def add_figure(self, stem: str, panels: Sequence[Panel], title: str) -> None:
        """Writes a figure of a frame."""
        if self.figures is not None:
            write_figure(self.add(f"figures/{stem}.{self.figures}"), panels, title)


@dataclass(frozen=True)
class Beside:
    """What is written of each frame beside its images, also of pixels that no training view has seen.

    Args:
        name: of its folders, tiff_<name> and png_<name>.
        title: in pictures.
        values: of a frame, [H, W].
        bar: what its colours mean.
    """

    name: str
    title: str
    values: Callable[[Frame], Tensor]
    bar: Bar


def uncertainty_beside(scene: SceneData, deviation: Callable[[Frame], Tensor], widest: float) -> Beside:
    """The standard deviation of each pixel, in the unit of the TIFFs; ``widest`` is at the end of the colours."""
    bar = Bar(0.0, widest, bar_unit(scene.thermal_range), DEVIATION)
    return Beside("uncertainty", f"uncertainty, {deviations_told(scene)}", deviation, bar)


def depth_beside(
    scene: SceneData, depth_of: Callable[[Frame], Tensor], frames: Sequence[Frame], metres_per_unit: float | None
) -> Beside:
    """Camera z of the surface in each pixel, NaN where there is none: in metres where the scale is known, else in world units.

    Args:
        scene: whose points in the frames say what is at the ends of the colours.
        depth_of: camera z [H, W] of a frame in world units, infinite where there is no surface.
        frames: that are shown.
        metres_per_unit: of the world; None where nobody knows.
    """
    scale, unit = (1.0, "units") if metres_per_unit is None else (metres_per_unit, "m")
    points, found = scene.points[evenly_spread(len(scene.points), DEPTH_POINTS)], []
    for frame in frames:
        pixels, depths = frame.camera.project(points)
        found.append(depths[frame.camera.inside(pixels, depths)])
    seen = torch.cat(found)
    seen = seen if len(seen) else seen.new_tensor([scene.distance])  # no point is in sight
    low, high = (scale * quantile(seen, seen.new_tensor(DEPTH_ENDS))).tolist()
    # Rendered surfaces of flat ground lie a little beside its points.
    low, high = (1.0 - DEPTH_MARGIN) * low, (1.0 + DEPTH_MARGIN) * high

    def values(frame: Frame) -> Tensor:
        depth = scale * depth_of(frame)
        return torch.where(depth.isfinite(), depth, torch.nan)

    return Beside("depth", "depth", values, Bar(low, high, unit, DEVIATION))


def write_shot(
    images: Iterable[tuple[Mapping[str, Tensor], Tensor | None]],
    frames: Sequence[Frame],
    scene: SceneData,
    files: ShotFiles,
    range_c: Sequence[float] | None = None,
    titles: Mapping[str, str] | None = None,
    beside: Sequence[Beside] = (),
    colormap: str = THERMAL,
    isotherm: tuple[float, float] | None = None,
    contours: float | Sequence[float] | None = None,
) -> list[Path]:
    """Paths of the files written for a shot: TIFF in °C, PNG with a bar, a video of each image, and ``frames.csv``.

    Files of the first image of a frame lie in tiff, png and video.mp4, those of others, such as "clean", in tiff_clean,
    png_clean and video_clean.mp4; images in colour have no TIFF. All frames share the ends of their colours.

    The table says of each frame its time, which share of its pixels some training view has seen, and how many seconds it
    lies beyond the training record. What no training view has seen is NaN in TIFF and hatched in pictures: it is no
    measurement. A frame beyond the record is a prediction, and its picture says so.

    Images are taken one by one, so that a long shot needs the memory of one. Without a thermal range they are no
    temperatures: TIFFs then hold image values in [0, 1], and the log says so.

    Args:
        images: of each frame its images [H, W, 1] or [H, W, 3] by name, the same names in all, and which pixels were seen,
            [H, W] bool (None: all).
        frames: of the shot.
        scene: that is shown.
        files: which of them are wanted, and where.
        range_c: °C at the ends of the colours; None takes the scene's range.
        titles: of images in pictures, by name; others have their name.
        beside: what else is written of each frame.
        colormap: name of the matplotlib map that colours temperatures (``io.pictures.checked_colormap``).
        isotherm, contours: in pictures of temperatures (``io.pictures.Bar``), in °C.

    Raises:
        SceneError: more contour lines than a picture shows, before an image is taken.
    """
    bounds = scene.thermal_range
    if bounds is None:
        log.warning("scene '%s' has no temperature bounds: files hold image values in [0, 1], not °C", scene.name)
    low, high = range_c or ((bounds.min_c, bounds.max_c) if bounds else (0.0, 1.0))
    bar = Bar(low, high, bar_unit(bounds), colormap, isotherm=isotherm, contours=contours)
    bar.levels()  # too many are refused before anything is rendered
    stems = file_stems([frame.name for frame in frames])
    clock = clock_of(scene)
    rows: list[tuple[str, float | None, float, float]] = []
    with files.videos:
        for frame, (shown, seen) in zip(frames, images, strict=True):
            stem, share = stems[frame.name], 1.0 if seen is None else seen.float().mean().item()
            beyond = scene.beyond_record(frame.time_s)
            rows.append((stem, frame.time_s, round(share, 4), round(beyond, 3)))
            # The time first: a narrow picture cuts off the end of its title.
            title = stem if frame.time_s is None else f"{moment(frame.time_s, clock)}   {stem}"
            limits = [f"prediction, {moment(beyond)} beyond the record"] if beyond else []
            limits += [f"{100 * share:.0f} % seen"] if share < 0.995 else []
            panels = []
            for number, (name, image) in enumerate(shown.items()):
                suffix = f"_{name}" if number else ""
                values = image if seen is None else image.where(seen[..., None], torch.nan)
                panels.append(image_panel(values, (titles or {}).get(name, name), bar, bounds))
                if image.shape[-1] == 1:
                    files.add_values(suffix, stem, (bounds.to_celsius(values) if bounds else values)[..., 0])
                files.add_picture(suffix, stem, _with(panels[-1], limits), title)
            for one in beside:
                values = one.values(frame)
                panels.append(image_panel(values[..., None], one.title, one.bar))
                files.add_values(f"_{one.name}", stem, values)
                files.add_picture(f"_{one.name}", stem, _with(panels[-1], limits), title, moving=False)
            files.add_figure(stem, panels, "   ".join([title, *limits]))
    _write_table(files.add("frames.csv"), rows)
    if left := files.of_others():
        log.warning(
            "%s in %s is left of an earlier command, such as %s: not of this checkpoint, these settings or these frames; delete "
            "what is not wanted, or give another folder with hydra.run.dir",
            *(counted(len(left), "file"), files.folder, left[0].relative_to(files.folder)),
        )
    return files.written


def _with(panel: Panel, limits: Sequence[str]) -> Panel:
    """A panel whose title says what limits what it shows, before its own words: narrow panels cut the end of titles."""
    return replace(panel, title=" · ".join([*limits, panel.title]))


def _write_table(path: Path, rows: Sequence[tuple[str, float | None, float, float]]) -> None:
    """Writes what is known of each frame, and warns of what no training view has seen."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(("frame", "time_s", "seen_share", "beyond_record_s"))
        table.writerows(rows)
    unseen = 1.0 - float(np.mean([share for _, _, share, _ in rows])) if rows else 0.0
    if unseen >= 0.0005:
        log.warning(
            "%.1f %% of the pixels show what no training view has seen: NaN in TIFF, hatched in pictures, by frame in %s "
            "(unseen=keep writes what the model makes of them)", 100 * unseen, path,
        )  # fmt: skip


def file_stems(names: Sequence[str]) -> dict[str, str]:
    """What the files of frames are called, by name of the frame, each another: with their folders, endings and numbers only where
    they would be alike without."""
    found: dict[str, str] = {}
    for stem_of in (_stem, _with_folders, _whole):
        found = {name: stem_of(Path(name)) for name in names}
        if len(set(found.values())) == len(found):
            return found
    return {name: f"{stem}_{number}" for number, (name, stem) in enumerate(found.items())}


def _stem(path: Path) -> str:
    return short_name(path.stem, LONGEST_STEM)


def _with_folders(path: Path) -> str:
    return _whole(path.with_suffix(""))


def _whole(path: Path) -> str:
    return short_name(path.as_posix().replace("/", "_"), LONGEST_STEM)
