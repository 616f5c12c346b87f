"""Points from the images of cameras that are known, and how well both agree: for cameras of other tools that bring no points."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heatsplat.contracts import counted
from heatsplat.datamodules.formats.colmap import posed_images
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.preparation.fingerprint import fingerprint
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.poses import FindPoses, Search
from heatsplat.preparation.writer import image_name

log = logging.getLogger(__name__)

NEAR_PX = 4.0  # COLMAP's greatest reprojection error of a point
MATCHES = 100  # from which on they tell how well cameras and images agree (ours)
# Root mean square distance of cameras from their middle, in the units in which points are found. COLMAP ends where squared errors
# change little with a step of one unit: in metres of a flight that leaves points where they are.
SPREAD = 0.01


@dataclass(frozen=True)
class Triangulated:
    """Points that images and their known cameras tell.

    Args:
        model: cameras as they were given, features of the images, and the points that they see.
        features: number of features of each image.
        away_px: [M] of each verified match, how far the feature in one image lies from where the other one's, seen by the given
            cameras, may be (``away``); inf where it would lie behind a camera.
        error_px: [P] mean reprojection error of each point, in pixels of the frames.
        angle_deg: [P] angle under which the two rays furthest from each other meet at each point.
    """

    model: pycolmap.Reconstruction
    features: np.ndarray
    away_px: np.ndarray
    error_px: np.ndarray
    angle_deg: np.ndarray

    @property
    def disagrees(self) -> bool:
        """Whether most matches lie where the given cameras cannot see them: these are not the cameras of these images."""
        return len(self.away_px) >= MATCHES and float((self.away_px <= NEAR_PX).mean()) < 0.5


def triangulated(
    options: FindPoses,
    frames: Sequence[ThermalFrame],
    target: Path,
    viewmats: Mapping[str, np.ndarray],
    lenses: Mapping[str, Lens],
) -> Triangulated:
    """Points by COLMAP's triangulation, with features and matches as the search for cameras finds them.

    Poses and lenses are held. Points whose reprojection error is above 4 pixels or whose rays meet under less than 1.5° are
    left out, as in the search. One thread and one seed: the same frames and cameras give the same bits.

    Args:
        options: of a search.
        frames: those that have a camera, three or more.
        target: the prepared folder; its work folder keeps copies, features and matches.
        viewmats: world to camera [4, 4] by name of an image in the folder.
        lenses: likewise.

    Raises:
        SceneError: there are fewer than three frames, or they show nothing.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    search = KnownCameras(options, frames, target, viewmats, lenses)
    search.begin()
    search.copies()
    search.find_features()
    search.match()
    return search.triangulate()


class KnownCameras(Search):
    """A search up to its matches, in frames whose cameras are known."""

    def __init__(
        self,
        options: FindPoses,
        frames: Sequence[ThermalFrame],
        target: Path,
        viewmats: Mapping[str, np.ndarray],
        lenses: Mapping[str, Lens],
    ) -> None:
        super().__init__(options, frames, target)
        self.viewmats = {name: viewmats[image_name(frame)] for name, frame in self.frames.items()}
        self.given = {name: lenses[image_name(frame)] for name, frame in self.frames.items()}
        sizes = {name: frame.size or frame.load().shape[::-1] for name, frame in self.frames.items()}
        self.lenses = {name: lens.resized(*sizes[name]) for name, lens in self.given.items()}
        self.kinds = list(dict.fromkeys(self.lenses.values()))

    def triangulate(self) -> Triangulated:
        """The points of all matches."""
        with pycolmap.Database.open(self.database) as database:
            numbers = {self.name_of[image.name]: image.image_id for image in database.read_all_images()}
            keypoints = {
                name: np.asarray(database.read_keypoints(key), np.float64)[:, :2] for name, key in numbers.items()
            }
            pairs, geometries = database.read_two_view_geometries()
        name_of = {key: name for name, key in numbers.items()}
        rays = {name: self._rays(name, keypoints[name]) for name in self.frames}
        distances = [np.zeros(0)]
        for pair, geometry in zip(pairs, geometries, strict=True):
            a, b = (name_of[key] for key in pycolmap.pair_id_to_image_pair(pair))
            if len(matches := np.asarray(geometry.inlier_matches)):
                between = self.viewmats[b] @ np.linalg.inv(self.viewmats[a])
                focal = 0.5 * (self.lenses[b].fx + self.lenses[b].fy)
                distances.append(focal * away(rays[a][matches[:, 0]], rays[b][matches[:, 1]], between))
        away_px = np.concatenate(distances)
        away_px = away_px[~np.isnan(away_px)]  # pixels that the lens's polynomial brings from nowhere
        found = self._points() if len(away_px) else pycolmap.Reconstruction()
        return self._as_given(found, keypoints, away_px)

    def _points(self) -> pycolmap.Reconstruction:
        """COLMAP's own points, in pixels of the frames, brought back to the world of the cameras."""
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed, options.num_threads = self.options.seed, 1
        copies = {self.copy_of[name]: name for name in self.frames}
        numbers = {copy: self.kinds.index(self.lenses[name]) for copy, name in copies.items()}
        centers = self._places(list(self.frames))
        middle = centers.mean(axis=0)
        unit = np.sqrt(((centers - middle) ** 2).sum(1).mean()) / SPREAD or 1.0
        viewmats = {copy: self.viewmats[name].copy() for copy, name in copies.items()}
        for viewmat in viewmats.values():
            viewmat[:3, 3] = (viewmat[:3, :3] @ middle + viewmat[:3, 3]) / unit
        posed = posed_images(viewmats, [stored(lens) for lens in self.kinds], numbers)
        folder = self.work / "models"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        log.info("triangulating points of %s", counted(len(self.frames), "frame"))
        images = self.work / "images"
        found = pycolmap.triangulate_points(posed, self.database, images, folder, True, options, False)
        for point in found.points3D.values():
            point.xyz = middle + unit * point.xyz
        return found

    def _as_given(
        self, found: pycolmap.Reconstruction, keypoints: Mapping[str, np.ndarray], away_px: np.ndarray
    ) -> Triangulated:
        """The points beside the cameras that were given: found poses have passed through COLMAP, and its lenses are those of
        the frames."""
        kinds = list(dict.fromkeys(self.given.values()))
        by_name = {image_name(self.frames[name]): name for name in self.frames}
        model = posed_images(
            {image: self.viewmats[name] for image, name in by_name.items()},
            [stored(lens) for lens in kinds],
            {image: kinds.index(self.given[name]) for image, name in by_name.items()},
            {image: keypoints[name] * self._enlarged(name) for image, name in by_name.items()},
        )
        own = {image.name: key for key, image in model.images.items()}
        number = {key: own[image_name(self.frames[self.name_of[image.name]])] for key, image in found.images.items()}
        centers = {key: image.projection_center() for key, image in model.images.items()}
        errors, angles = [], []
        for point in (point for _, point in sorted(found.points3D.items())):
            seen = [(number[e.image_id], e.point2D_idx) for e in point.track.elements]
            track = pycolmap.Track([pycolmap.TrackElement(*one) for one in seen])
            model.add_point3D(point.xyz, track, point.color)
            towards = np.stack([centers[key] for key, _ in seen]) - point.xyz
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            angles.append(np.degrees(np.arccos(np.clip((towards @ towards.T).min(), -1.0, 1.0))))
            errors.append(point.error)
        model.update_point_3d_errors()
        features = np.array([len(keypoints[name]) for name in self.frames])
        return Triangulated(model, features, away_px, np.array(errors), np.array(angles))

    def _enlarged(self, name: str) -> np.ndarray:
        """How many pixels of the given lens [2] one of the frame is."""
        given, own = self.given[name], self.lenses[name]
        return np.array([given.width / own.width, given.height / own.height])

    def _rays(self, name: str, pixels: np.ndarray) -> np.ndarray:
        """Directions [K, 3] in camera axes, with depth 1, of pixels of a frame."""
        model, params, width, height = stored(self.lenses[name])
        camera = pycolmap.Camera(model=model, params=list(params), width=width, height=height)
        return np.column_stack([np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2), np.ones(len(pixels))])

    # What is given is not asked of the files ----------------------------------------------------------------------------

    def _made_of(self) -> str:
        cameras = [(name, self.viewmats[name].tolist(), stored(self.given[name])) for name in self.frames]
        return fingerprint(super()._made_of(), cameras)

    def _lens_of(self, copy: str) -> int:
        return self.kinds.index(self.lenses[self.name_of[copy]])

    def _camera_of(self, device: int | None, shape: tuple[int, int]) -> int:
        """Number in the database of a lens."""
        with pycolmap.Database.open(self.database) as database:
            if not database.exists_camera(device + 1):
                for i, lens in enumerate(self.kinds):
                    model, params, width, height = stored(lens)
                    camera = pycolmap.Camera(
                        model=model, params=list(params), width=width, height=height, camera_id=i + 1
                    )
                    camera.has_prior_focal_length = True
                    database.write_camera(camera, use_camera_id=True)
        return device + 1

    def _set_focal_lengths(self, database: pycolmap.Database) -> None:
        pass

    def _origin(self) -> None:
        return None

    def _places(self, names: Sequence[str]) -> np.ndarray:
        return np.stack([np.linalg.inv(self.viewmats[name])[:3, 3] for name in names])


def away(rays: np.ndarray, others: np.ndarray, between: np.ndarray) -> np.ndarray:
    """How far features lie from where those of another image may be seen, as tangents (times the focal length: pixels).

    A ray of one camera is a line in the other's image, from the image of what is infinitely far to that of what is in front of
    both. Errors of what is infinitely far, as of cameras that only turn, are those of directions.

    Args:
        rays: [M, 3] in the axes of the first camera.
        others: [M, 3] in those of the second, depth 1.
        between: [4, 4] from the first camera's axes to those of the second.

    Returns:
        [M]; inf where all of the ray is behind the second camera.
    """
    start, step = rays @ between[:3, :3].T, between[:3, 3]
    line = np.cross(start, step)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = (line * others).sum(1) / (line[:, :2] ** 2).sum(1)
        foot = others.copy()
        foot[:, :2] -= off[:, None] * line[:, :2]
        # The foot is start + nearness * step, but for its length.
        along, against = np.cross(foot, np.broadcast_to(step, foot.shape)), np.cross(foot, start)
        nearness = -(along * against).sum(1) / (along**2).sum(1)
        met = (nearness >= 0) & (start[:, 2] + nearness * step[2] > 0)
        on_line = np.abs(off) * np.hypot(line[:, 0], line[:, 1])
        endless = np.hypot(*(start[:, :2] / start[:, 2:] - others[:, :2]).T)
    return np.where(met, on_line, np.where(start[:, 2] > 0, endless, np.inf))


def stored(lens: Lens) -> tuple[str, tuple[float, ...], int, int]:
    """A lens as COLMAP's camera: model, parameters, width, height."""
    matrix = (lens.fx, lens.fy, lens.cx, lens.cy)
    if lens.fisheye:
        return "OPENCV_FISHEYE", (*matrix, *lens.distortion), lens.width, lens.height
    if lens.is_distorted:
        full = (*lens.distortion, *[0.0] * (8 - len(lens.distortion)))
        return "FULL_OPENCV", (*matrix, *full), lens.width, lens.height
    return "PINHOLE", matrix, lens.width, lens.height
