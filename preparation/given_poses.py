"""Cameras that another tool has found, taken as they are: a COLMAP model, a transforms.json, exports of Metashape and Pix4D."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError, check_option, counted
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
from heatsplat.preparation.features import Features, Sift
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.poses import PICTURE, FindPoses, put_whole, write_whole
from heatsplat.preparation.report import Section
from heatsplat.preparation.target import WORK
from heatsplat.preparation.triangulation import MATCHES, NEAR_PX, Triangulated, stored, triangulated
from heatsplat.preparation.writer import EAST_NORTH_UP, image_name, write_places, write_world

OTHER_SHAPE = 0.01  # by which width over height of a camera and of its frame may differ
FEW_POINTS = 100  # below which points are taken for none (ours)
# Median distance of matches above which cameras are off, in pixels: exact ones have 0.5 at 160x128, those a pixel off 1.2 (ours).
OFF_PX = 1.5


@dataclass(frozen=True)
class GivenPoses:
    """Cameras of another tool of the same frames; called with the frames and the prepared folder.

    Poses, lenses and points are written as they are into sparse/0, under the names of the prepared images. Scale and
    orientation of the world stay the tool's own, unless it knows where on the earth it is: axes are then east, north and up
    in metres, and the places in frames.csv are those of the cameras. Points that are lacking are triangulated.

    Args:
        model: folder with sparse/0 (or cameras.bin itself), with transforms.json, with a cameras.xml of Metashape or with
            *_calibrated_camera_parameters.txt of Pix4D, or one of the last two files; names are those of the camera's files.
        triangulate: "auto": points are triangulated from the frames where the cameras come with fewer than ``FEW_POINTS``;
            True: in place of points that come with them, too; False: never.
        features: what finds and matches features.
        video, all_pairs, overlap, clip, seed: of the search for cameras (``FindPoses``); neighbours in space are those of the
            given cameras.
    """

    model: str
    triangulate: str | bool = "auto"
    features: Features = Sift()
    video: bool | None = None
    all_pairs: int = 120
    overlap: int = 10
    clip: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_option("poses.triangulate", self.triangulate, ("auto", True, False), SceneError)
        self._matching()

    def __call__(self, frames: list[ThermalFrame], target: Path) -> Section:
        """Writes ``target``/sparse/0. Returns which frames have a camera and which have none.

        Raises:
            SceneError: the folder holds no cameras, those of other images, or images of another shape.
        """
        model = model_in(Path(self.model).expanduser(), frames)
        camera_of, why = matched(frames, model)
        viewmats, lenses, posed = {}, {}, []
        for frame in frames:
            if frame.name in camera_of:
                viewmat, lens = model.cameras[camera_of[frame.name]]
                _check_shape(frame, lens, model.source)
                viewmats[image_name(frame)], lenses[image_name(frame)] = viewmat, lens
                posed.append(frame)
        few = len(model.points) < FEW_POINTS
        found, why_not = None, "poses.triangulate=false"
        if self.triangulate is True or self.triangulate == "auto" and few:
            try:
                found = triangulated(self._matching(), posed, target, viewmats, lenses)
            except SceneError as error:
                why_not = str(error)
        points, folder, fresh = model.points, target / "sparse" / "0", target / WORK / "sparse"
        if taken := found is not None and len(found.error_px) >= FEW_POINTS and not found.disagrees:
            points = np.array([point.xyz for point in found.model.points3D.values()])
            write_whole(found.model, folder, target / WORK)
        else:
            stores = {name: stored(lens) for name, lens in lenses.items()}
            kinds = list(dict.fromkeys(stores.values()))
            numbers = {name: kinds.index(kind) for name, kind in stores.items()}
            colors = (255.0 * model.colors).round().astype(np.uint8)
            write_model(fresh, viewmats, kinds, points, colors, camera_of=numbers)
            put_whole(fresh, folder)
        write_world(target, model.metres_per_unit, EAST_NORTH_UP if model.east_north_up else None)
        if model.origin is not None:
            centers = np.stack([np.linalg.inv(viewmat)[:3, 3] for viewmat in viewmats.values()])
            write_places(target, dict(zip(viewmats, latitude_longitude(centers, model.origin), strict=True)))
        lines = [
            f"{len(viewmats)} of {len(frames)} frames have a camera in {model.source}, which is taken as it is; "
            f"{counted(len(points), 'point')}."
        ]
        lines += model.notes or ["Scale and orientation are those of the tool that made it."]
        findings = [] if found is None else _doubts(found)
        if self.triangulate is True or few:
            lines += (said := _of_points(len(model.points), found, taken, why_not))
            if few and self.triangulate is not False and not taken and not findings:
                findings.append(said[0])
        if unused := len(model.cameras) - len(set(camera_of.values())):
            lines.append(f"{unused} of its cameras belong to no frame of this recording.")
        if len(points) > 2:
            draw_cameras(target / PICTURE, list(viewmats.values()), points, model.east_north_up)
            lines += ["", f"![cameras over the points]({PICTURE})", ""]
        missing = {f.name: why.get(f.name, "the model has no camera for it") for f in frames if f.name not in camera_of}
        lines += [f"- {name}: {reason}" for name, reason in missing.items()]
        values = {"registered": len(viewmats), "frames": len(frames), "points": len(points)}
        values |= {"not_registered": missing, "metres_per_unit": model.metres_per_unit}
        values |= {} if found is None else _figures(found)
        return Section("Poses", lines, values, findings)

    def _matching(self) -> FindPoses:
        """How features are found and matched. Raises SceneError for settings that cannot be."""
        return FindPoses(
            self.features,
            video=self.video,
            all_pairs=self.all_pairs,
            overlap=self.overlap,
            gps=False,
            clip=self.clip,
            seed=self.seed,
        )


def _figures(found: Triangulated) -> dict[str, object]:
    """What a program may want to read of triangulated points, as plain JSON values; None where there is none."""
    return {
        "triangulated": len(found.error_px),
        "features": int(np.median(found.features)),
        "matches": len(found.away_px),
        "matches_away_px": _median(found.away_px),
        "matches_near": round(float((found.away_px <= NEAR_PX).mean()), 4) if len(found.away_px) else None,
        "reprojection_error_px": _median(found.error_px),
        "angle_deg": _median(found.angle_deg),
    }


def _median(values: np.ndarray) -> float | None:
    """The lower median, rounded; None of none, and where it is infinite."""
    middle = float(np.quantile(values, 0.5, method="lower")) if len(values) else np.inf
    return round(middle, 4) if np.isfinite(middle) else None


def _of_points(given: int, found: Triangulated | None, taken: bool, why_not: str) -> list[str]:
    """Where points come from, what their lack means, and how well features and cameras agree."""
    has = "The cameras come without points" if not given else f"The cameras come with {counted(given, 'point')}"
    random = "training starts from random ones, and nothing can be checked by points"
    stay = random if not given else "these stay"
    if found is None:
        return [f"{has}, and none were triangulated ({why_not}): {stay}."]
    seen = f"{counted(len(found.away_px), 'matched pair')} of features ({np.median(found.features):.0f} in an image, median)"
    lines = []
    if taken:
        lines.append(
            f"{has}{'' if not given else ', which were replaced'}: {counted(len(found.error_px), 'point')} were triangulated "
            f"from {seen}, with them held; reprojection error {_median(found.error_px):.2f} px, rays meet under "
            f"{_median(found.angle_deg):.1f}° (medians)."
        )
    elif found.disagrees:
        lines.append(f"{has}, and points that such cameras see would be wrong: {stay}.")
    else:
        lines.append(
            f"{has}, and only {len(found.error_px)} could be triangulated from {seen}, where {FEW_POINTS} are needed: {stay}. "
            "More overlap between frames helps, or the tool's own points: in a COLMAP model, or as ply_file_path of a "
            "transforms.json."
        )
    if len(found.away_px) >= MATCHES:
        lines.append(
            f"Matched features lie {_pixels(found)} (median) from where the given cameras see each other's; "
            f"{100.0 * (found.away_px <= NEAR_PX).mean():.0f} % lie within {NEAR_PX:.0f} px."
        )
    return lines


def _pixels(found: Triangulated) -> str:
    """How far matches lie away, in words."""
    middle = _median(found.away_px)
    return "behind a camera" if middle is None else f"{middle:.2g} px"


def _doubts(found: Triangulated) -> list[str]:
    """What is wrong with the given cameras, by the matches of the images."""
    middle = _median(found.away_px)
    if len(found.away_px) < MATCHES or middle is not None and middle <= OFF_PX:
        return []
    said = f"The given cameras and the images {'do not agree' if found.disagrees else 'agree poorly'}: matched features lie "
    said += f"{_pixels(found)} (median) from where the cameras see each other's, and below 1 px where both belong together. "
    if found.disagrees:
        return [
            said
            + "Are the camera's axes those of the format (of a transforms.json x right, y up, z backwards, and poses from "
            "camera to world), are its images those of these names, and its focal length that of this size? Poses of "
            "GPS and gimbal alone are that far off, too. poses=thermal finds cameras anew"
        ]
    return [
        said + "Training with cameras=refined corrects cameras that are a few pixels off; poses=thermal finds them anew"
    ]


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
