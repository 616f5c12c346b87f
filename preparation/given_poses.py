"""Cameras that another tool has found: a COLMAP model or a transforms.json, taken as it is."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats.colmap import find_model, is_model, read_model_of, write_model
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.nerfstudio import lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.nerfstudio import find_transforms
from heatsplat.datamodules.points import ply_points
from heatsplat.preparation.cameras_picture import draw_cameras
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.poses import PICTURE, put_whole
from heatsplat.preparation.report import Section
from heatsplat.preparation.target import WORK
from heatsplat.preparation.writer import image_name, write_world

OTHER_SHAPE = 0.01  # by which width over height of a camera and of its frame may differ


@dataclass(frozen=True)
class Model:
    """Cameras as another tool wrote them.

    Args:
        source: file or folder that they stand in.
        cameras: name of an image -> world-to-camera [4, 4] and lens.
        points, colors: [P, 3], colors in [0, 1]; none of them where the tool wrote none.
    """

    source: Path
    cameras: dict[str, tuple[np.ndarray, Lens]]
    points: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class GivenPoses:
    """Cameras of a COLMAP model or a transforms.json of the same frames; called with the frames and the prepared folder.

    Poses, lenses and points are written as they are into sparse/0, under the names of the prepared images. Scale and
    orientation of the world stay the tool's own.

    Args:
        model: folder with sparse/0 (or cameras.bin itself), or with transforms.json; names are those of the camera's files.
    """

    model: str

    def __call__(self, frames: list[ThermalFrame], target: Path) -> Section:
        """Writes ``target``/sparse/0. Returns which frames have a camera and which have none.

        Raises:
            SceneError: the folder holds no cameras, those of other images, or images of another shape.
        """
        model = model_in(Path(self.model).expanduser(), frames)
        camera_of = matched(frames, model)
        viewmats, lenses = {}, {}
        for frame in frames:
            if frame.name in camera_of:
                viewmat, lens = model.cameras[camera_of[frame.name]]
                _check_shape(frame, lens, model.source)
                viewmats[image_name(frame)] = viewmat
                lenses[image_name(frame)] = _stored(lens)
        kinds = list(dict.fromkeys(lenses.values()))
        numbers = {name: kinds.index(kind) for name, kind in lenses.items()}
        colors = (255.0 * model.colors).round().astype(np.uint8)
        fresh = target / WORK / "sparse"
        write_model(fresh, viewmats, kinds, model.points, colors, camera_of=numbers)
        put_whole(fresh, target / "sparse" / "0")
        write_world(target, None)
        lines = [
            f"{len(viewmats)} of {len(frames)} frames have a camera in {model.source}, which is taken as it is; "
            f"{len(model.points)} points. Scale and orientation are those of the tool that made it."
        ]
        if not len(model.points):
            lines.append("It has no points: training starts from random ones, and nothing can be checked by points.")
        if unused := len(model.cameras) - len(set(camera_of.values())):
            lines.append(f"{unused} of its cameras belong to no frame of this recording.")
        if len(model.points) > 2:
            draw_cameras(target / PICTURE, list(viewmats.values()), model.points)
            lines += ["", f"![cameras over the points]({PICTURE})", ""]
        missing = {f.name: "the model has no camera for it" for f in frames if f.name not in camera_of}
        lines += [f"- {name}: {reason}" for name, reason in missing.items()]
        values = {"registered": len(viewmats), "frames": len(frames), "points": len(model.points)}
        return Section("Poses", lines, {**values, "not_registered": missing, "metres_per_unit": None})


def model_in(folder: Path, frames: Sequence[ThermalFrame]) -> Model:
    """The cameras in a folder, a COLMAP model before a transforms.json. Raises SceneError where it holds neither."""
    # The folder of the model itself is as good, whatever it is called, and that above sparse/0, sparse/1, ..., too.
    found = find_model(folder) or next((place for place in (folder, folder / "0") if is_model(place)), None)
    if found is not None:
        model = read_model_of(found)
        cameras = {n: (v, lens) for n, v, lens in zip(model.names, model.viewmats, model.lenses, strict=True)}
        return Model(found, cameras, model.points, model.colors)
    files = find_transforms(folder)
    if not files:
        raise SceneError(
            f"poses.model={folder} holds neither a COLMAP model (sparse/0) nor a transforms.json; give the folder of one"
        )
    height, width = frames[0].load().shape
    cameras, points, colors = {}, np.zeros((0, 3)), None
    for path in files:
        transforms = read_transforms(path)
        for frame in transforms.frames:
            name = str(frame.get("thermal_file_path", frame["file_path"]))
            lens = lens_in(transforms, frame, lambda: (width, height))
            cameras[name] = viewmat_of(transforms, frame, opengl=True), lens
        ply = transforms.values.get("ply_file_path")
        if ply and (path.parent / str(ply)).is_file():
            points, colors = ply_points(path.parent / str(ply))
    return Model(next(iter(files)), cameras, points, np.full(points.shape, 0.5) if colors is None else colors)


def matched(frames: Sequence[ThermalFrame], model: Model) -> dict[str, str]:
    """By name of a frame, which image of a model it is: that with the name of its file, whatever ending it has.

    Folders count where they tell images of one name apart, such as those of a visible camera beside.

    Raises:
        SceneError: none of them has a name of a frame, or several have that of one.
    """
    given = defaultdict(list)  # people and tools change the case of names
    for name in model.cameras:
        given[name.lower()].append(name)
    whole = defaultdict(list)  # as names of frames have their folders
    for name in given:
        plain = name.replace("\\", "/")
        whole[(plain.rpartition(".")[0] or plain).replace("/", "_")].append(name)
    single = Counter(frame.path for frame in frames)
    own = {frame.name: (frame.path.parent / f"{frame.name}.tiff").as_posix().lower() for frame in frames}
    file = {frame.name: frame.path.as_posix().lower() for frame in frames if single[frame.path] == 1}
    by_own, by_file = (_alone(same_files(list(names.values()), given)) for names in (own, file))
    found = {}
    for frame in frames:
        names = whole.get(frame.name.lower()) or by_own.get(own[frame.name]) or by_file.get(file.get(frame.name))
        images = [image for name in names or () for image in given[name]]
        if len(images) > 1:
            raise SceneError(
                f"{model.source}: {' and '.join(images)} may both be the camera of {frame.path}; give a model of the thermal "
                "images alone, or its images the folders of the camera's files"
            )
        if images:
            found[frame.name] = images[0]
    if not found:
        raise SceneError(
            f"none of the {len(model.cameras)} cameras of {model.source} belongs to a frame: it has names like "
            f"{next(iter(model.cameras))!r}, the recording like {frames[0].name!r}. Names of both have to be those of the "
            "camera's files"
        )
    return found


def _alone(same: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Of what ``same_files`` found, what belongs to one frame only: nothing tells whose the rest is."""
    frames = Counter(name for names in same.values() for name in names)
    return {frame: [name for name in names if frames[name] == 1] for frame, names in same.items()}


def _check_shape(frame: ThermalFrame, lens: Lens, source: Path) -> None:
    height, width = frame.load().shape
    if abs(lens.width / lens.height / (width / height) - 1.0) > OTHER_SHAPE:
        raise SceneError(
            f"{source}: the camera of {frame.path.name} is one of {lens.width}x{lens.height} pixels, the frame has {width}x"
            f"{height}; give the model of the images as the camera wrote them, not of cropped or undistorted ones"
        )


def _stored(lens: Lens) -> tuple[str, tuple[float, ...], int, int]:
    """A lens as COLMAP's camera: model, parameters, width, height."""
    matrix = (lens.fx, lens.fy, lens.cx, lens.cy)
    if lens.fisheye:
        return "OPENCV_FISHEYE", (*matrix, *lens.distortion), lens.width, lens.height
    if lens.is_distorted:
        full = (*lens.distortion, *[0.0] * (8 - len(lens.distortion)))
        return "FULL_OPENCV", (*matrix, *full), lens.width, lens.height
    return "PINHOLE", matrix, lens.width, lens.height
