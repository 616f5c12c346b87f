"""Where the cameras stood: structure from motion on the thermal frames, or on the photos of a camera beside them."""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich import get_console
from rich.progress import Progress, track
from scipy.spatial import cKDTree

from heatsplat.contracts import SceneError, check_numbers, check_option, counted, evenly_spread
from heatsplat.datamodules.formats.colmap import pose_matrix
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.formats.geodesy import east_north_up
from heatsplat.datamodules.formats.images import ImageIndex, read_grey, read_image, to_grey
from heatsplat.datamodules.formats.lens import MODELS
from heatsplat.io.files import write_atomically
from heatsplat.physics.radiometry import Conditions
from heatsplat.preparation.cameras_picture import draw_cameras
from heatsplat.preparation.devices import Device, devices_of, listed
from heatsplat.preparation.features import Features
from heatsplat.preparation.fingerprint import fingerprint
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.report import Section
from heatsplat.preparation.rig import settle_rig, thermal_only
from heatsplat.preparation.stretch import Stretch
from heatsplat.preparation.target import WORK
from heatsplat.preparation.writer import EAST_NORTH_UP, image_name, write_world

log = logging.getLogger(__name__)

MADE_OF = "made_of"  # file in the work folder
PICTURE = "report/cameras.png"
SOURCES = ("thermal", "rgb")
FEW_FEATURES = 60
STILL_PX = 0.5  # median motion of the image between frames below which the camera stands still
PAIRS_AT_ONCE = 20
HEIGHTS = ("above_takeoff_m", "altitude_m")  # of positions


@dataclass(frozen=True)
class FindPoses:
    """Cameras by COLMAP's incremental mapping; called with the frames and the prepared folder, it writes sparse/0.

    The model keeps the lens that was found; whoever loads the scene takes its distortion out of the temperatures
    (interpolated once, as floating point). With GPS the world is east, north and up in metres of the first fix; without it
    scale and orientation are the reconstruction's own. One thread and one seed: the same frames give the same bits.

    Args:
        by: "thermal" frames, or "rgb": the photos that belong to them. How the thermal camera is turned against the visible
            one is then found on the way, from the thermal features; where it stands is taken for the same in the mean.
        features: what finds and matches features.
        camera_model: of COLMAP, for each camera: SIMPLE_RADIAL, RADIAL, OPENCV, ...
        focal_px: focal length of the thermal camera in pixels; None for what the files say, or a guess that is refined.
            Where a recording has several thermal cameras each has a lens of its own.
        pixel_um: pitch of the detector's pixels in µm, for files that say a focal length in mm.
        refine_focal: "auto" where the files of a camera say nothing, True or False. Flat ground from straight above does not
            tell it.
        video: frames follow each other: only neighbours in time (and in space, by GPS) are matched. None: where there are
            more than ``all_pairs``.
        all_pairs: number of frames up to which all pairs are matched.
        overlap: neighbours in time on each side; beyond them those at 2, 4, 8, ... times that distance.
        gps: whether positions count.
        gps_sd_m: standard deviation of positions of files that state none: horizontal, vertical.
        clip: limit of local equalisation.
        seed: of COLMAP's random draws.
    """

    features: Features
    by: str = "thermal"
    camera_model: str = "SIMPLE_RADIAL"
    focal_px: float | None = None
    pixel_um: float = 12.0
    refine_focal: str | bool = "auto"
    video: bool | None = None
    all_pairs: int = 120
    overlap: int = 10
    gps: bool = True
    gps_sd_m: tuple[float, float] = (2.0, 4.0)
    clip: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_option("poses.by", self.by, SOURCES, SceneError)
        check_option("poses.refine_focal", self.refine_focal, ("auto", True, False), SceneError)
        check_option("poses.video", self.video, (None, True, False), SceneError)
        check_option("poses.camera_model", self.camera_model, MODELS, SceneError)
        for name in ("focal_px", "pixel_um", "overlap", "clip"):
            if name != "focal_px" or self.focal_px is not None:
                check_numbers(f"poses.{name}", getattr(self, name), error=SceneError, above=0)
        check_numbers("poses.all_pairs", self.all_pairs, error=SceneError)
        if self.all_pairs < 0:
            raise SceneError(f"poses.all_pairs must be 0 or above, got {self.all_pairs}")
        check_numbers("poses.gps_sd_m", self.gps_sd_m, 2, SceneError, above=0)

    def __call__(self, frames: list[ThermalFrame], target: Path) -> Section:
        """Writes ``target``/sparse/0. Returns what was found, what was not, and why.

        Raises:
            SceneError: no two frames could be brought together.
        """
        # What went wrong is said below, by names of frames.
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
        search = Search(self, frames, target)
        search.begin()
        search.copies()
        search.find_features()
        search.match()
        model, others = search.map()
        return search.finish(model, others)


class Search:
    """One search for cameras, step by step; what is done already in the folder is not done again."""

    def __init__(self, options: FindPoses, frames: Sequence[ThermalFrame], target: Path) -> None:
        self.options, self.target, self.work = options, target, target / WORK
        if len(frames) < 3:
            raise SceneError(
                f"{counted(len(frames), 'frame')} cannot tell where cameras stood; three or more that overlap are needed"
            )
        self.devices = devices_of(frames)
        self._check_devices()
        self.device_of = {frame.name: i for i, device in enumerate(self.devices) for frame in device.frames}
        index = ImageIndex(target / "images")
        self.frames = {name: frame for frame in frames if (name := index.find(image_name(frame))) is not None}
        if options.by == "rgb" and (lacking := [f.name for f in frames if f.rgb is None]):
            raise SceneError(
                f"poses=rgb: {len(lacking)} of {len(frames)} frames have no photo, such as {lacking[0]}; "
                "give the folder of photos, or find poses=thermal"
            )
        self.copy_of = {name: f"thermal/{Path(name).with_suffix('.png').as_posix()}" for name in self.frames}
        self.name_of = {copy: name for name, copy in self.copy_of.items()}
        self.database = self.work / "database.db"
        self.origin = self._origin()

    def begin(self) -> None:
        """Takes away what an earlier search left that had other frames or other settings."""
        made_of, note = self._made_of(), self.work / MADE_OF
        if self.work.is_dir() and (not note.is_file() or note.read_text() != made_of):
            log.info("frames or settings of the search for cameras have changed: it begins anew")
            shutil.rmtree(self.work)
        write_atomically(note, made_of)

    def copies(self) -> None:
        """8-bit copies of all frames (and photos) in the work folder."""
        images = self.work / "images"
        todo = [name for name in self.frames if not (images / self.copy_of[name]).is_file()]
        if todo:
            stretches = [
                Stretch([_apparent(frame).pixels for frame in device.frames], self.options.clip)
                for device in self.devices
            ]
            for name in _progress(todo, f"stretching {counted(len(todo), 'frame')}"):
                stretch = stretches[self.device_of[self.frames[name].name]]
                _write_png(images / self.copy_of[name], stretch(_apparent(self.frames[name]).pixels()))
        if self.options.by == "rgb":
            for name in _progress(list(self.frames), f"copying {counted(len(self.frames), 'photo')}"):
                copy = images / self._photo(name)
                if not copy.is_file():
                    _write_png(copy, to_grey(read_image(self.frames[name].rgb)))

    def find_features(self) -> None:
        """Features of all copies, in the database."""
        names = list(self.name_of)
        if self.options.by == "rgb":
            names += [self._photo(name) for name in self.frames]
        reader = pycolmap.ImageReaderOptions(camera_model=self.options.camera_model)
        missing = set(names)
        if self.database.is_file():
            with pycolmap.Database.open(self.database) as database:
                missing -= {
                    image.name for image in database.read_all_images() if database.exists_keypoints(image.image_id)
                }
        todo = [name for name in names if name in missing]
        cameras: dict[Any, int] = {}  # by lens and shape: asked of the database, which lists all of its images
        for name in _progress(todo, f"finding features in {counted(len(todo), 'image')}"):
            kind = self._lens_of(name), _shape(self.work / "images" / name)
            if cameras.get(kind, -1) < 0:
                cameras[kind] = self._camera_of(*kind)
            reader.existing_camera_id = cameras[kind]
            self.options.features.extract(self.database, self.work / "images", name, reader)
        if not todo:
            return
        with pycolmap.Database.open(self.database) as database:
            self._set_focal_lengths(database)
            self._write_priors(database)
            if self.options.by == "rgb":
                cameras = [
                    pycolmap.RigConfigCamera(ref_sensor=True, image_prefix="rgb/"),
                    pycolmap.RigConfigCamera(image_prefix="thermal/", cam_from_rig=pycolmap.Rigid3d()),
                ]
                pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], database)

    def match(self) -> None:
        """Matches of all pairs that may overlap, verified."""
        pairs = [(self.copy_of[a], self.copy_of[b]) for a, b in self.pairs()]
        if self.options.by == "rgb":
            pairs += [(self._photo(a), self._photo(b)) for a, b in self.pairs()]
        blocks = [pairs[i : i + PAIRS_AT_ONCE] for i in range(0, len(pairs), PAIRS_AT_ONCE)]
        for block in _progress(blocks, f"matching {len(pairs)} pairs"):
            self.options.features.match(self.database, block, self.work / "pairs.txt", self.options.seed)

    def pairs(self) -> list[tuple[str, str]]:
        """Names of frames that are matched with each other."""
        names = list(self.frames)
        video = len(names) > self.options.all_pairs if self.options.video is None else self.options.video
        if not video:
            return list(combinations(names, 2))
        steps = {*range(1, self.options.overlap + 1)}
        step = 2 * self.options.overlap
        while step < len(names):
            steps.add(step)
            step *= 2
        found = {(i, i + step) for step in steps for i in range(len(names) - step)}
        places = self._places(names)
        if places is not None:
            near = cKDTree(places).query(places, k=min(2 * self.options.overlap, len(names)))[1].reshape(len(names), -1)
            found |= {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(near) for j in row if i != j}
        return [(names[i], names[j]) for i, j in sorted(found)]

    def map(self) -> tuple[pycolmap.Reconstruction, list[pycolmap.Reconstruction]]:
        """The largest reconstruction, and those that it does not connect to."""
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed, options.num_threads = self.options.seed, 1
        options.min_model_size = 3
        options.mapper.abs_pose_min_num_inliers = 15
        options.mapper.init_min_num_inliers = 50
        refine = self.options.refine_focal
        unknown = any(self._focal(device) is None for device in self.devices)
        options.ba_refine_focal_length = unknown if refine == "auto" else refine
        options.mapper.abs_pose_refine_focal_length = options.ba_refine_focal_length
        if self.options.by == "rgb":
            options.ba_refine_focal_length = True
            options.ba_refine_sensor_from_rig = False  # few frames do not tell it: cameras collapse (``settle_rig``)
        options.use_prior_position = self.origin is not None
        options.use_robust_loss_on_prior_position = True
        folder = self.work / "models"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        log.info("placing cameras of %s", counted(len(self.frames), "frame"))
        with Progress(transient=True, disable=not get_console().is_terminal) as bar:
            task = bar.add_task("placing cameras", total=len(self.frames))
            models = pycolmap.incremental_mapping(
                self.database, self.work / "images", folder, options, next_image_callback=lambda: bar.advance(task)
            )
        if not models:
            raise SceneError(self._nothing())
        ordered = sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
        return ordered[0], ordered[1:]

    def finish(self, model: pycolmap.Reconstruction, others: Sequence[pycolmap.Reconstruction]) -> Section:
        """Writes the model of the thermal frames and says what became of every frame."""
        kept = {image.name: image for image in model.images.values() if image.has_pose and image.name in self.name_of}
        # Of a camera that stands still noise places a few frames somewhere, and cameras that see no point stand anywhere.
        seen = model.num_points3D()
        if len(kept) < 3 or not seen or len(kept) < len(self.frames) / 2 and self._stands_still():
            raise SceneError(self._nothing())
        placed_by_photos = settle_rig(model, self.name_of) if self.options.by == "rgb" else None
        written = thermal_only(model, self.name_of, placed_by_photos)
        folder = self.target / "sparse" / "0"
        write_whole(written, folder, self.work)
        write_world(self.target, None if self.origin is None else 1.0, EAST_NORTH_UP)
        missing = self._why_not({copy for copy in self.name_of if copy not in kept}, others)
        errors = self._gps_residuals(list(written.images.values()))
        cameras = dict(sorted({self._device(copy): image.camera for copy, image in kept.items()}.items()))
        values: dict[str, Any] = {
            "registered": len(kept),
            "frames": len(self.frames),
            "points": written.num_points3D(),
            "reprojection_error_px": round(model.compute_mean_reprojection_error(), 4),
            "cameras": {
                self.devices[i].label: {"model": c.model.name, "params": [round(float(p), 6) for p in c.params]}
                for i, c in cameras.items()
            },
            "not_registered": missing,
            "metres_per_unit": None if self.origin is None else 1.0,
            "origin": None if self.origin is None else [float(x) for x in self.origin],
        }
        lines = [
            f"{len(kept)} of {len(self.frames)} frames found their camera; {values['points']} points, reprojection error "
            f"{values['reprojection_error_px']:.2f} px.",
            *(self._camera_line(i, camera) for i, camera in cameras.items()),
            _world_line(errors),
        ]
        if errors is not None:
            values["gps_residual_m"] = [round(float(e), 3) for e in errors]
        if self.options.by == "rgb":
            turn, offset = self._rig(model, written)
            values["thermal_from_rgb"] = {"degrees": turn, "offset": offset}
            lines.append(_rig_line(turn, offset))
        if len(written.points3D) > 2:
            self._draw(written)
            lines += ["", f"![cameras over the points]({PICTURE})", ""]
        return Section("Poses", [*lines, *_missing_lines(missing)], values)

    def _camera_line(self, device: int, camera: pycolmap.Camera) -> str:
        """The lens that was found of a camera."""
        which = f" {self.devices[device].label}" if len(self.devices) > 1 else ""
        return (
            f"Camera{which}: {camera.model.name}, {', '.join(f'{p:.5g}' for p in camera.params)} (distortion is taken out of the "
            "temperatures when the scene is loaded, as floating point)."
        )

    def _draw(self, written: pycolmap.Reconstruction) -> None:
        """The picture of the cameras, in the order of the frames."""
        by_name = {image.name: image for image in written.images.values()}
        draw_cameras(
            self.target / PICTURE,
            [pose_matrix(by_name[name]) for name in self.frames if name in by_name],
            np.array([point.xyz for point in written.points3D.values()]),
            self.origin is not None,
        )

    def _made_of(self) -> str:
        """What copies, features and matches depend on: the files as the camera wrote them, but not the conditions."""
        frames = [_apparent(frame) for frame in self.frames.values()]
        # A photo in the target is of the frame's own file.
        photos = [frame.rgb for frame in frames if frame.rgb is not None and self.target not in frame.rgb.parents]
        files = [*(frame.path for frame in frames), *photos]
        stats = [(path.stat().st_size, path.stat().st_mtime_ns) for path in files]
        return fingerprint(self.options, frames, stats)

    def _rig(self, model: pycolmap.Reconstruction, written: pycolmap.Reconstruction) -> tuple[float, list[float]]:
        """By how many degrees the thermal camera is turned against the visible one (median over the frames), and where it
        stands in that one's axes (mean): right, down, forward, in units of the world, which are metres with GPS."""
        photos = {image.name: image.cam_from_world() for image in model.images.values() if image.has_pose}
        between = [
            image.cam_from_world() * photos[self._photo(image.name)].inverse()
            for image in written.images.values()
            if self._photo(image.name) in photos
        ]
        turn = np.median([np.degrees(pose.rotation.angle()) for pose in between])
        offset = np.mean([pose.inverse().translation for pose in between], axis=0)
        return round(float(turn), 4), offset.round(4).tolist()

    # What the frames say -----------------------------------------------------------------------------------------------

    def _photo(self, name: str) -> str:
        return self.copy_of[name].replace("thermal/", "rgb/", 1)

    def _check_devices(self) -> None:
        """Raises SceneError for what only one thermal camera can have."""
        if len(self.devices) == 1:
            return
        alone = "Put each into a folder of its own and prepare those"
        if self.options.by == "rgb":
            raise SceneError(
                f"poses=rgb finds one thermal camera by the photos of one beside it, and here are {len(self.devices)}: "
                f"{listed(self.devices)}. {alone}, or find poses=thermal"
            )
        if self.options.focal_px is not None and len({self._stated_focal(device) for device in self.devices}) > 1:
            raise SceneError(
                f"poses.focal_px={self.options.focal_px:g} is one lens, and here are {len(self.devices)}: "
                f"{listed(self.devices)}. {alone}"
            )

    def _focal(self, device: Device) -> float | None:
        """Focal length in pixels of a thermal camera that the user or the files give, or None."""
        return self._stated_focal(device) if self.options.focal_px is None else float(self.options.focal_px)

    def _stated_focal(self, device: Device) -> float | None:
        about = device.like.camera
        if not about.field_of_view_deg:
            return None if about.focal_mm is None else 1000.0 * about.focal_mm / self.options.pixel_um
        return 0.5 * device.like.load().shape[1] / float(np.tan(np.radians(0.5 * about.field_of_view_deg)))

    def _device(self, copy: str) -> int | None:
        """Which of the thermal cameras took a copy; None for photos."""
        return self.device_of[self.frames[self.name_of[copy]].name] if copy in self.name_of else None

    def _lens_of(self, copy: str) -> int | None:
        """What copies of one camera in the database have in common, beside their shape."""
        return self._device(copy)

    def _camera_of(self, device: int | None, shape: tuple[int, int]) -> int:
        """Number in the database of the camera that took the copies of a device (of photos for None) of one height and width; -1
        where it has none yet."""
        if not self.database.is_file():
            return -1
        height, width = shape
        with pycolmap.Database.open(self.database) as database:
            own = {im.camera_id for im in database.read_all_images() if self._device(im.name) == device}
            sized = {key: database.read_camera(key) for key in own}
        return next((key for key, camera in sized.items() if (camera.height, camera.width) == (height, width)), -1)

    def _set_focal_lengths(self, database: pycolmap.Database) -> None:
        """Gives thermal cameras in the database the focal lengths that are known."""
        lengths = [self._focal(device) for device in self.devices]  # each of which may read a file
        known = {
            image.camera_id: lengths[self._device(image.name)]
            for image in database.read_all_images()
            if image.name in self.name_of
        }
        for camera_id, length in known.items():
            if length is not None:
                camera = database.read_camera(camera_id)
                for i in camera.focal_length_idxs():
                    camera.params[i] = length
                camera.has_prior_focal_length = True
                database.update_camera(camera)

    def _origin(self) -> np.ndarray | None:
        """Latitude, longitude and altitude of the first fix; None where GPS does not count or cannot tell frames apart."""
        if not self.options.gps:
            return None
        fixes = [self._fix(frame) for frame in self.frames.values()]
        known = np.array([fix for fix in fixes if fix is not None])
        if len(known) < 3:
            return None
        metres = east_north_up(known, known[0])
        spread = np.linalg.norm(metres[:, :2] - metres[:, :2].mean(0), axis=1).max()
        if spread < 2.0 * self._sd(next(f for f in self.frames.values() if f.position))[0]:
            log.warning("GPS says that all frames were taken within %.1f m; it is not used", spread)
            return None
        return known[0]

    @cached_property
    def _height(self) -> str | None:
        """Which height of positions counts, one for all: above take-off, the better zero, unless more frames tell that above the
        sea. None where none tells any."""
        told = Counter(
            name
            for f in self.frames.values()
            for name in HEIGHTS
            if f.position and getattr(f.position, name) is not None
        )
        return max(HEIGHTS, key=told.__getitem__) if told else None

    def _fix(self, frame: ThermalFrame) -> tuple[float, float, float] | None:
        """Latitude, longitude and height of a frame; None without a position, or without the height that others have."""
        at = frame.position
        height = None if at is None else 0.0 if self._height is None else getattr(at, self._height)
        return None if height is None else (at.latitude_deg, at.longitude_deg, height)

    def _sd(self, frame: ThermalFrame) -> tuple[float, float]:
        position, (across, up) = frame.position, self.options.gps_sd_m
        return position.horizontal_sd_m or across, position.vertical_sd_m or up

    def _places(self, names: Sequence[str]) -> np.ndarray | None:
        """Metres [n, 3] of the frames by GPS; None where it does not count or one lacks it."""
        fixes = [self._fix(self.frames[name]) for name in names]
        if self.origin is None or any(fix is None for fix in fixes):
            return None
        return east_north_up(np.array(fixes), self.origin)

    def _write_priors(self, database: pycolmap.Database) -> None:
        if self.origin is None:
            return
        database.clear_pose_priors()
        for image in database.read_all_images():
            name = self.name_of.get(image.name)
            if self.options.by == "rgb":
                name = (
                    self.name_of.get(image.name.replace("rgb/", "thermal/", 1))
                    if image.name.startswith("rgb/")
                    else None
                )
            fix = None if name is None else self._fix(self.frames[name])
            if fix is None:
                continue
            across, up = self._sd(self.frames[name])
            database.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=east_north_up(np.array([fix]), self.origin)[0],
                    position_covariance=np.diag([across**2, across**2, up**2]),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
            )

    def _gps_residuals(self, placed: Sequence[pycolmap.Image]) -> np.ndarray | None:
        """Root mean square of how far cameras lie from their fixes: horizontally and vertically, in metres."""
        if self.origin is None:
            return None
        known = [(image, fix) for image in placed if (fix := self._fix(self.frames[image.name])) is not None]
        found = np.array([image.projection_center() for image, _ in known])
        away = found - east_north_up(np.array([fix for _, fix in known]), self.origin)
        return np.sqrt(np.array([(away[:, :2] ** 2).sum(1).mean(), (away[:, 2] ** 2).mean()]))

    # What did not work --------------------------------------------------------------------------------------------------

    def _counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Features of every copy, and with how many other copies it has verified matches."""
        with pycolmap.Database.open(self.database) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            features = {name: database.num_keypoints_for_image(key) for key, name in images.items()}
            partners = dict.fromkeys(images.values(), 0)
            for pair, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
                if inliers >= 15:
                    for key in pycolmap.pair_id_to_image_pair(pair):
                        partners[images[key]] += 1
        return features, partners

    def _why_not(self, missing: set[str], others: Sequence[pycolmap.Reconstruction]) -> dict[str, str]:
        """Why each of the copies has no camera, by name of its frame."""
        features, partners = self._counts()
        elsewhere = {image.name: m.num_reg_images() for m in others for image in m.images.values() if image.has_pose}
        reasons = {}
        for copy in sorted(missing):
            if features[copy] < FEW_FEATURES:
                reason = f"only {features[copy]} features: too little contrast, or blurred"
            elif not partners[copy]:
                reason = (
                    f"{features[copy]} features, but no other frame shows enough of them: no overlap, or changed heat"
                )
            elif copy in elsewhere:
                reason = f"belongs to a group of {elsewhere[copy]} frames that nothing connects to the others"
            else:
                reason = f"matches {partners[copy]} other frame(s), but too few of the points that were found"
            reasons[self.name_of[copy]] = reason
        return reasons

    def _stands_still(self) -> bool:
        """Whether images hardly move from frame to frame (phase correlation, Kuglin and Hines 1975)."""
        few = [list(self.copy_of.values())[i] for i in evenly_spread(len(self.copy_of), 9)]
        copies = [read_grey(self.work / "images" / copy).astype(np.float32) for copy in few]
        moved = [np.hypot(*cv2.phaseCorrelate(a, b)[0]) for a, b in pairwise(copies) if a.shape == b.shape]
        return bool(moved) and float(np.median(moved)) < STILL_PX

    def _nothing(self) -> str:
        if self._stands_still():
            return (
                "no cameras could be found: the image does not move, and where cameras stand shows only in frames from several "
                "places"
            )
        features, partners = self._counts()
        thermal = [features[copy] for copy in self.name_of]
        return (
            f"no cameras could be found: frames have {np.median(thermal):.0f} features (median) and overlap with "
            f"{np.median([partners[copy] for copy in self.name_of]):.0f} others. More overlap between frames helps, and "
            "photos of a camera beside (poses=rgb); or bring the cameras of another tool (poses=given)"
        )


def write_whole(model: pycolmap.Reconstruction, folder: Path, work: Path) -> None:
    """Writes a model so that ``folder`` is never half of one."""
    fresh = work / "sparse"
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    model.write_binary(str(fresh))
    put_whole(fresh, folder)


def put_whole(fresh: Path, folder: Path) -> None:
    """Puts a model that was written elsewhere in the place of one that may be there."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    fresh.rename(folder)


def _apparent(frame: ThermalFrame) -> ThermalFrame:
    """The frame as the camera saw it: where cameras stand does not depend on emissivity, air and window."""
    return replace(frame, conditions=Conditions(), sources={})


def _shape(path: Path) -> tuple[int, int]:
    return read_grey(path).shape


def _write_png(path: Path, pixels: np.ndarray) -> None:
    """Written whole or not at all: a stopped search must not find half a copy."""
    done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise SceneError(f"{path} cannot be written")
    write_atomically(path, data.tobytes())


def _progress(items: Sequence[Any], what: str) -> Iterator[Any]:
    """The items with a bar on a terminal, after a line in the log, which is all that a file shows of a long stage."""
    if not items:
        return iter(())
    log.info("%s", what)
    return iter(track(items, what, transient=True, disable=not get_console().is_terminal))


# What the section says -----------------------------------------------------------------------------------------------


def _world_line(errors: Sequence[float] | None) -> str:
    """What the world's axes are, by how far cameras are beside and above their fixes in metres, or None without GPS."""
    if errors is None:
        return "World: scale and orientation of the reconstruction; no GPS that would tell them."
    return (
        f"World: east, north, up in metres of the first GPS fix; cameras lie {errors[0]:.2f} m beside and {errors[1]:.2f} m "
        "above or below their fixes (rms)."
    )


def _rig_line(turn: float, offset: Sequence[float]) -> str:
    where = ", ".join(f"{x:.4g}" for x in offset)
    return (
        f"The thermal camera is turned by {turn:.2f}° against the visible one and stands at ({where}) in its axes (right, down, "
        "forward), as far as they tell: both are brought to the same places in the mean."
    )


def _missing_lines(missing: Mapping[str, str]) -> list[str]:
    """Frames without a camera, each with the reason."""
    lines = []
    if missing:
        lines = [
            f"{counted(len(missing), 'frame')} without a camera, left out of training; more overlap between frames helps, and "
            "photos of a camera beside (poses=rgb):"
        ]
    return [*lines, "", *(f"- {name}: {reason}" for name, reason in missing.items())]
