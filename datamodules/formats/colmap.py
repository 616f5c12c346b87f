"""COLMAP sparse models, binary or text: reading them into plain arrays and writing them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from heatsplat.contracts import Camera, SceneError
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.formats.colmap_records import check_records, names_in_text, plain_text, point_ids_in
from heatsplat.datamodules.formats.lens import MODELS, Lens, lens_of

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")


@dataclass(frozen=True)
class SparseModel:
    """What heatsplat takes from a sparse model.

    Args:
        folder: where it lies.
        names: image names as the model has them, sorted.
        viewmats: world-to-camera [4, 4] float64 of each name.
        lenses: lens of each name.
        points: [P, 3] float64.
        colors: [P, 3] float64 in [0, 1].
        point_ids: [P] numbers of the points, which are in the order of COLMAP's own table in memory.
    """

    folder: Path
    names: tuple[str, ...]
    viewmats: tuple[np.ndarray, ...]
    lenses: tuple[Lens, ...]
    points: np.ndarray
    colors: np.ndarray
    point_ids: tuple[int, ...]

    def rows(self) -> np.ndarray:
        """Row [P] of each point in the file of points, for what is written in the order of that."""
        row_of = {number: row for row, number in enumerate(point_ids_in(self.folder))}
        return np.array([row_of[number] for number in self.point_ids], dtype=np.int64)


def find_model(scene: Path) -> Path | None:
    """The folder of the sparse model in a scene folder (sparse/0, sparse, colmap/sparse/0, colmap/sparse), or None."""
    return next((scene / place for place in PLACES if is_model(scene / place)), None)


def is_model(folder: Path) -> bool:
    """Whether a folder is itself one of a sparse model: it has cameras.bin or cameras.txt."""
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def nearly_model(scene: Path) -> str:
    """What makes a sparse model of what a scene folder has in place of one, in words; empty where it has nothing like it."""
    for place in PLACES:
        if any((scene / place / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return f"{place} has images, and neither cameras.bin nor cameras.txt: copy the model or export it from COLMAP again"
    others = [path for path in sorted((scene / "sparse").glob("*")) if is_model(path)]
    return f"sparse/{others[0].name} is a model: rename it to sparse/0" if others else ""


def read_model(scene: Path) -> SparseModel:
    """The sparse model of a scene folder.

    Raises:
        SceneError: there is none, a file of it is missing, empty or damaged, or a camera model is not supported.
    """
    folder = find_model(scene)
    if folder is None:
        raise SceneError(
            f"no sparse model in {scene}: looked for cameras.bin or cameras.txt in {', '.join(PLACES)}. "
            "Reconstruct the scene with COLMAP first, or point data.root and data.scene at the folder above sparse/."
        )
    return read_model_of(folder)


def read_model_of(folder: Path) -> SparseModel:
    """The sparse model whose files lie in a folder. Raises SceneError as ``read_model``."""
    suffix = "bin" if (folder / "cameras.bin").is_file() else "txt"
    check_records(folder, suffix)
    try:
        with TemporaryDirectory() as plain:
            model = pycolmap.Reconstruction(str(plain_text(folder, Path(plain)) if suffix == "txt" else folder))
    except Exception as error:
        if "amera model" in str(error):
            raise SceneError(
                f"sparse model {folder}: cameras.{suffix} names a camera model that COLMAP does not know; "
                f"supported are {', '.join(MODELS)}"
            ) from error
        raise SceneError(f"sparse model {folder} is damaged: {str(error).strip().splitlines()[0]}") from error
    lenses = {
        key: lens_of(c.model.name, list(c.params), c.width, c.height, f"{folder}, camera {key}")
        for key, c in model.cameras.items()
    }
    told = names_in_text(folder / "images.txt") if suffix == "txt" else {}
    posed = [image for image in model.images.values() if image.has_pose]
    names = [told.get(image.image_id, image.name).replace("\\", "/") for image in posed]  # as written on Windows
    named = sorted(zip(names, posed, strict=True), key=lambda one: one[0])
    images = [image for _, image in named]
    if not images:
        raise SceneError(f"sparse model {folder} has no registered image; reconstruct the scene again")
    ids, points = list(model.points3D.keys()), list(model.points3D.values())
    return SparseModel(
        folder=folder,
        names=tuple(name for name, _ in named),
        viewmats=tuple(pose_matrix(image) for image in images),
        lenses=tuple(lenses[image.camera_id] for image in images),
        points=np.array([p.xyz for p in points], dtype=np.float64).reshape(-1, 3),
        colors=np.array([p.color for p in points], dtype=np.float64).reshape(-1, 3) / 255.0,
        point_ids=tuple(ids),
    )


def pose_matrix(image: pycolmap.Image) -> np.ndarray:
    """World to camera [4, 4] float64 of an image that has a pose, OpenCV axes."""
    return np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])


def pinholes(
    cameras: Mapping[str, Camera],
) -> tuple[list[tuple[str, tuple[float, ...], int, int]], dict[str, int]]:
    """Cameras without distortion by image name as ``write_model`` takes them: each lens once, and which one an image has."""
    kinds: dict[tuple, int] = {}
    camera_of = {}
    for name, camera in cameras.items():
        k = camera.K.tolist()
        kind = ("PINHOLE", (k[0][0], k[1][1], k[0][2], k[1][2]), camera.width, camera.height)
        camera_of[name] = kinds.setdefault(kind, len(kinds))
    return list(kinds), camera_of


def write_model(
    folder: Path,
    viewmats: Mapping[str, np.ndarray],
    cameras: Sequence[tuple[str, Sequence[float], int, int]],
    points: np.ndarray,
    colors: np.ndarray,
    *,
    camera_of: Mapping[str, int] | None = None,
    text: bool = False,
) -> None:
    """Writes a sparse model of points that no image is said to see.

    Args:
        folder: the model's own folder (scene/sparse/0), made where missing.
        viewmats: image name -> world-to-camera [4, 4], OpenCV axes.
        cameras: (COLMAP model name, its parameters, width, height) of each camera.
        points: [P, 3] world coordinates.
        colors: [P, 3] uint8.
        camera_of: image name -> position in ``cameras``; the first camera for all when left out.
        text: True for .txt files, False for .bin.
    """
    model = posed_images(viewmats, cameras, camera_of)
    for xyz, color in zip(points, colors, strict=True):
        model.add_point3D(np.asarray(xyz, dtype=np.float64), pycolmap.Track(), np.asarray(color, dtype=np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))


def posed_images(
    viewmats: Mapping[str, np.ndarray],
    cameras: Sequence[tuple[str, Sequence[float], int, int]],
    camera_of: Mapping[str, int] | None = None,
    keypoints: Mapping[str, np.ndarray] | None = None,
) -> pycolmap.Reconstruction:
    """A sparse model without points; images are numbered from 1 in the order of ``viewmats``, cameras in that of ``cameras``.

    Args:
        viewmats: as in ``write_model``.
        cameras: as in ``write_model``.
        camera_of: as in ``write_model``.
        keypoints: image name -> features [K, 2] in pixels of its camera, from the image's corner; none when left out.
    """
    model = pycolmap.Reconstruction()
    for i, (kind, params, width, height) in enumerate(cameras):
        camera = pycolmap.Camera(model=kind, width=width, height=height, params=list(params), camera_id=i + 1)
        model.add_camera_with_trivial_rig(camera)
    for i, (name, viewmat) in enumerate(viewmats.items()):
        camera_id = 1 + (camera_of[name] if camera_of else 0)
        pose = pycolmap.Rigid3d(np.asarray(viewmat, dtype=np.float64)[:3])
        seen = np.zeros((0, 2)) if keypoints is None else np.asarray(keypoints[name], dtype=np.float64)
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=i + 1, keypoints=seen)
        model.add_image_with_trivial_frame(image, pose)
    return model
