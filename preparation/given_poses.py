"""Cameras that another tool has found, taken as they are: a COLMAP model, a transforms.json, exports of Metashape and Pix4D."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats.aligned_cameras import AlignedCameras
from heatsplat.datamodules.formats.colmap import find_model, is_model, read_model_of, write_model
from heatsplat.datamodules.formats.geodesy import latitude_longitude
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.metashape import is_metashape, read_metashape
from heatsplat.datamodules.formats.nerfstudio import lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.formats.pix4d import ENDING as PIX4D
from heatsplat.datamodules.formats.pix4d import is_pix4d, read_pix4d
from heatsplat.datamodules.nerfstudio import find_transforms
from heatsplat.datamodules.points import ply_points
from heatsplat.preparation.cameras_picture import draw_cameras
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.poses import PICTURE, put_whole
from heatsplat.preparation.report import Section
from heatsplat.preparation.target import WORK
from heatsplat.preparation.writer import EAST_NORTH_UP, image_name, write_places, write_world

OTHER_SHAPE = 0.01  # by which width over height of a camera and of its frame may differ


@dataclass(frozen=True)
class GivenPoses:
    """Cameras of another tool of the same frames; called with the frames and the prepared folder.

    Poses, lenses and points are written as they are into sparse/0, under the names of the prepared images. Scale and
    orientation of the world stay the tool's own, unless it knows where on the earth it is: axes are then east, north and up
    in metres, and the places in frames.csv are those of the cameras.

    Args:
        model: folder with sparse/0 (or cameras.bin itself), with transforms.json, with a cameras.xml of Metashape or with
            *_calibrated_camera_parameters.txt of Pix4D, or one of the last two files; names are those of the camera's files.
    """

    model: str

    def __call__(self, frames: list[ThermalFrame], target: Path) -> Section:
        """Writes ``target``/sparse/0. Returns which frames have a camera and which have none.

        Raises:
            SceneError: the folder holds no cameras, those of other images, or images of another shape.
        """
        model = model_in(Path(self.model).expanduser(), frames)
        camera_of, why = matched(frames, model)
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
        write_world(target, model.metres_per_unit, EAST_NORTH_UP if model.east_north_up else None)
        if model.origin is not None:
            centers = np.stack([np.linalg.inv(viewmat)[:3, 3] for viewmat in viewmats.values()])
            write_places(target, dict(zip(viewmats, latitude_longitude(centers, model.origin), strict=True)))
        lines = [
            f"{len(viewmats)} of {len(frames)} frames have a camera in {model.source}, which is taken as it is; "
            f"{len(model.points)} points."
        ]
        lines += model.notes or ["Scale and orientation are those of the tool that made it."]
        if not len(model.points):
            lines.append("It has no points: training starts from random ones, and nothing can be checked by points.")
        if unused := len(model.cameras) - len(set(camera_of.values())):
            lines.append(f"{unused} of its cameras belong to no frame of this recording.")
        if len(model.points) > 2:
            draw_cameras(target / PICTURE, list(viewmats.values()), model.points, model.east_north_up)
            lines += ["", f"![cameras over the points]({PICTURE})", ""]
        missing = {f.name: why.get(f.name, "the model has no camera for it") for f in frames if f.name not in camera_of}
        lines += [f"- {name}: {reason}" for name, reason in missing.items()]
        values = {"registered": len(viewmats), "frames": len(frames), "points": len(model.points)}
        values |= {"not_registered": missing, "metres_per_unit": model.metres_per_unit}
        return Section("Poses", lines, values)


def model_in(folder: Path, frames: Sequence[ThermalFrame]) -> AlignedCameras:
    """The cameras in a folder, or in a file of Metashape or Pix4D: a COLMAP model before a transforms.json before those.

    Raises:
        SceneError: it holds none of them, or several files of Metashape and Pix4D.
    """
    # The folder of the model itself is as good, whatever it is called, and that above sparse/0, sparse/1, ..., too.
    found = find_model(folder) or next((place for place in (folder, folder / "0") if is_model(place)), None)
    if found is not None:
        model = read_model_of(found)
        cameras = {n: (v, lens) for n, v, lens in zip(model.names, model.viewmats, model.lenses, strict=True)}
        return AlignedCameras(found, cameras, model.points, model.colors)
    files = find_transforms(folder)
    if not files:
        return _exported_in(folder)
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
    return AlignedCameras(next(iter(files)), cameras, points, np.full(points.shape, 0.5) if colors is None else colors)


def _exported_in(place: Path) -> AlignedCameras:
    """The cameras of a file of Metashape or Pix4D, or of the only one in a folder."""
    files = (
        [place]
        if place.is_file()
        else [path for path in sorted(place.glob("*")) if is_metashape(path) or is_pix4d(path)]
    )
    if len(files) > 1:
        names = ", ".join(path.name for path in files)
        raise SceneError(f"poses.model={place} holds several files of cameras ({names}); give one of them")
    if files and is_pix4d(files[0]):
        return read_pix4d(files[0])
    if files and is_metashape(files[0]):
        return read_metashape(files[0])
    what = "is none of them" if files else "holds none of them" if place.is_dir() else "does not exist"
    raise SceneError(
        f"poses.model={place} {what}: the folder of a COLMAP model (sparse/0) or of a transforms.json, or a "
        f"cameras.xml of Metashape or a *{PIX4D} of Pix4D, is needed"
    )


def images_of(frames: Sequence[ThermalFrame], names: Iterable[str]) -> dict[str, list[str]]:
    """By name of a frame, which images of another tool may be it: those with the name of its file, whatever ending they have.

    Folders count where they tell images of one name apart, such as those of a visible camera beside. Frames that none is are
    left out.
    """
    given = defaultdict(list)  # people and tools change the case of names
    for name in names:
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
        same = whole.get(frame.name.lower()) or by_own.get(own[frame.name]) or by_file.get(file.get(frame.name))
        if images := [image for name in same or () for image in given[name]]:
            found[frame.name] = images
    return found


def matched(frames: Sequence[ThermalFrame], model: AlignedCameras) -> tuple[dict[str, str], dict[str, str]]:
    """By name of a frame, which image of a model it is (``images_of``), and why it has no camera where the model says that.

    Raises:
        SceneError: none of them has a name of a frame, several have that of one, or the camera of one is no lens here.
    """
    found, why = {}, {}
    by_name = images_of(frames, [*model.cameras, *model.left_out, *model.refused])
    for frame in frames:
        images = by_name.get(frame.name, [])
        posed = [image for image in images if image in model.cameras]
        if len(posed) > 1:
            raise SceneError(
                f"{model.source}: {' and '.join(posed)} may both be the camera of {frame.path}; give a model of the thermal "
                "images alone, or its images the folders of the camera's files"
            )
        if posed:
            found[frame.name] = posed[0]
        elif said := next((model.refused[image] for image in images if image in model.refused), None):
            raise SceneError(said)
        elif images:
            why[frame.name] = model.left_out[images[0]]
    if not found and why:
        name, reason = next(iter(why.items()))
        raise SceneError(
            f"{model.source} has no camera of a frame: of {len(why)} none, such as {name}, because {reason}"
        )
    if not found:
        names = [*model.cameras, *model.refused]
        raise SceneError(
            f"none of the {len(names)} cameras of {model.source} belongs to a frame: it has names like "
            f"{names[0]!r}, the recording like {frames[0].name!r}. Names of both have to be those of the "
            "camera's files"
        )
    return found, why


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
