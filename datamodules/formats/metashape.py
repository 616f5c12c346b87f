"""Cameras that Agisoft Metashape has aligned: the cameras.xml that it exports ("Agisoft XML").

The elements are document/chunk with sensors/sensor/calibration, components/component/transform (or a transform of the chunk
itself), cameras/camera (also in groups) and reference, the coordinate system as WKT. A camera's transform is camera-to-chunk, 4x4
by rows, of a camera that looks along z with y down; that of a chunk leads on to geocentric or to local coordinates in metres.
Of frame cameras, with x = X/Z, y = Y/Z and r² = x² + y² (user manual, appendix on camera models)

    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2 x²) + 2 p2 x y          u = w/2 + cx + x' (f + b1) + y' b2
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p2 (r² + 2 y²) + 2 p1 x y          v = h/2 + cy + y' f

in pixels from the corner of the image. p1 and p2 are OpenCV's p2 and p1. OpenCV has no r⁸: a ratio of two cubics in r² takes the
place of a polynomial with k4. Numbers that are zero are left out of the file.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.aligned_cameras import (
    WGS_84_M,
    AlignedCameras,
    checked_skew,
    numbers_in,
    world_to_camera,
)
from heatsplat.datamodules.formats.geodesy import east_north_up_axes, from_geocentric
from heatsplat.datamodules.formats.lens import Lens, lens_of
from heatsplat.datamodules.poses import checked_pose

EXPORT = "export the cameras from Metashape again (File > Export > Export Cameras, Agisoft XML)"
OPTIMIZE = "in Metashape, Tools > Optimize Cameras without"
NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
FITTED_PX = 0.01  # how far a ratio of cubics may be from a polynomial with k4, anywhere in the image
ON_EARTH_M = (6.33e6, 6.43e6)  # how far cameras may be from the middle of the earth

# Rotation [3, 3], shift [3] and scale of chunk coordinates into those of its reference.
Transform = tuple[np.ndarray, np.ndarray, float]


def is_metashape(path: Path) -> bool:
    """Whether a file may be a cameras.xml: it is XML of a <document>."""
    try:
        with path.open("rb") as file:
            return path.suffix.lower() == ".xml" and b"<document" in file.read(2000)
    except OSError:
        return False


@dataclass
class _Listed:
    """The cameras that a chunk lists, by label: element and camera-to-chunk pose of those that are aligned, and why others are
    left out or refused."""

    elements: dict[str, ElementTree.Element] = field(default_factory=dict)
    poses: dict[str, np.ndarray] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def leave_out(self, name: str, why: str) -> None:
        del self.poses[name]
        self.left_out[name] = why

    def sensor(self, name: str) -> str | None:
        return self.elements[name].get("sensor_id")


def read_metashape(path: Path) -> AlignedCameras:
    """The cameras of a cameras.xml: in metres east, north and up of the first one where the chunk is georeferenced, else in the
    local coordinates of its reference, else in those of the chunk.

    Raises:
        SceneError: the file is none, or one of its numbers cannot be; it names file, key and remedy.
    """
    chunk = _chunk(path)
    listed = _listed(path, chunk)
    used = _transforms_of(path, chunk, listed)
    lenses, unread, notes = _lenses(path, chunk, {listed.sensor(name) for name in listed.poses})
    rotations, centers = _in_reference(listed.poses, used)
    world = _World(chunk.findtext("reference") or "", next(iter(used.values())), centers)
    axes, zero, origin = np.eye(3), np.zeros(3), None
    if world.on_earth:
        origin, zero = from_geocentric(centers[:1])[0], centers[0]
        axes = east_north_up_axes(origin)
    cameras, refused = {}, listed.refused
    for name, rotation, center in zip(listed.poses, rotations, centers, strict=True):
        sensor = listed.sensor(name)
        if sensor in lenses:
            viewmat = world_to_camera(axes @ rotation, axes @ (center - zero), f"{path}: transform of camera {name}")
            cameras[name] = viewmat, lenses[sensor]
        else:
            refused[name] = unread[sensor]
    return AlignedCameras(
        source=path,
        cameras=cameras,
        left_out=listed.left_out,
        refused=refused,
        notes=[*notes, world.says],
        metres_per_unit=world.metres_per_unit,
        east_north_up=world.on_earth,
        origin=origin if world.ellipsoid is None else None,
    )


def _listed(path: Path, chunk: ElementTree.Element) -> _Listed:
    """The cameras of a chunk. Raises SceneError where none is left because of labels that two of them have."""
    found = _Listed()
    for camera in chunk.iterfind("cameras//camera"):
        name, matrix = camera.get("label"), camera.find("transform")
        if not name:
            raise SceneError(f"{path}: camera {camera.get('id')} has no label, the name of its image; {EXPORT}")
        if name in found.elements:
            found.refused[name] = (
                f"{path}: two cameras have the label {name!r}, and nothing tells whose camera is whose; rename one in Metashape, "
                "or export each flight from a chunk of its own"
            )
        found.elements[name] = camera
        if camera.get("enabled", "true").lower() in ("false", "0"):
            found.left_out[name] = "it is disabled in Metashape"
        elif matrix is None:
            found.left_out[name] = _unaligned(camera)
        else:
            where = f"{path}: transform of camera {name}"
            found.poses[name] = checked_pose(numbers_in(matrix.text, 16, where, EXPORT).reshape(4, 4), where)
    for name in found.refused:
        found.poses.pop(name, None)
        found.left_out.pop(name, None)
    if not found.poses and found.refused:
        raise SceneError(next(iter(found.refused.values())))
    return found


def _transforms_of(path: Path, chunk: ElementTree.Element, listed: _Listed) -> dict[str, Transform | None]:
    """What leads each aligned camera from chunk coordinates to those of the reference, by label.

    Of components that nothing connects, only the largest keeps its cameras. Raises SceneError where none is left.
    """
    of_components = {one.get("id"): _transform(one.find("transform"), f"{path}: transform of component {one.get('id')}")
                     for one in chunk.iterfind("components/component")}  # fmt: skip
    of_chunk = _transform(chunk.find("transform"), f"{path}: transform of the chunk")
    component_of = {name: listed.elements[name].get("component_id") for name in listed.poses}
    used = {name: of_components.get(component) or of_chunk for name, component in component_of.items()}
    if None in used.values() and len(set(component_of.values())) > 1:  # components in coordinates of their own
        largest = Counter(component_of.values()).most_common(1)[0][0]
        for name, component in component_of.items():
            if component != largest:
                listed.leave_out(
                    name, f"it belongs to component {component}, which nothing connects to component {largest}"
                )
                del used[name]
    if not listed.poses:
        raise SceneError(
            f"{path}: none of its {len(listed.left_out)} cameras is aligned and enabled; align them in Metashape first"
        )
    return used


def _chunk(path: Path) -> ElementTree.Element:
    """The chunk that has cameras."""
    try:
        document = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise SceneError(f"{path} is not readable XML ({error}); {EXPORT}") from error
    chunks = [chunk for chunk in document.iter("chunk") if chunk.find("cameras//camera") is not None]
    if document.tag != "document" or not chunks:
        what = f"is a <{document.tag}>" if document.tag != "document" else "has no chunk with a camera"
        raise SceneError(f"{path} {what}, not a document of Metashape's cameras; {EXPORT}")
    if len(chunks) > 1:
        raise SceneError(
            f"{path} has {len(chunks)} chunks with cameras, each in coordinates of its own; export one of them"
        )
    return chunks[0]


def _unaligned(camera: ElementTree.Element) -> str:
    if (master := camera.get("master_id")) not in (None, camera.get("id")):
        return (
            f"it has no transform of its own: it follows camera {master} of a multi-camera system, whose offsets are not read. "
            "Align the thermal images as single cameras"
        )
    return "it is not aligned in Metashape"


def _transform(element: ElementTree.Element | None, where: str) -> Transform | None:
    """A transform of chunk coordinates; None where there is none."""
    if element is None or all(element.find(key) is None for key in ("rotation", "translation", "scale")):
        return None
    rotation = numbers_in(element.findtext("rotation", "1 0 0 0 1 0 0 0 1"), 9, f"{where}: rotation", EXPORT).reshape(
        3, 3
    )
    shift = numbers_in(element.findtext("translation", "0 0 0"), 3, f"{where}: translation", EXPORT)
    scale = float(numbers_in(element.findtext("scale", "1"), 1, f"{where}: scale", EXPORT)[0])
    if scale <= 0:
        raise SceneError(f"{where}: scale is {scale:g}, a number above 0 is needed; {EXPORT}")
    return checked_pose(np.column_stack([rotation, shift]), where)[:3, :3], shift, scale


def _in_reference(
    poses: Mapping[str, np.ndarray], transforms: Mapping[str, Transform | None]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Camera-to-reference rotations [3, 3], and places [n, 3], of camera-to-chunk poses."""
    rotations, centers = [], []
    for name, pose in poses.items():
        rotation, shift, scale = transforms[name] or (np.eye(3), np.zeros(3), 1.0)
        rotations.append(rotation @ pose[:3, :3])
        centers.append(scale * rotation @ pose[:3, 3] + shift)
    return rotations, np.stack(centers)


class _World:
    """What the coordinates of a chunk's reference are.

    Args:
        reference: WKT.
        transform: of the chunk, or None.
        centers: of cameras in them.

    Attributes:
        on_earth: whether they are geocentric.
        ellipsoid: name of that of another datum than WGS 84 (or ETRS89), or None.
        metres_per_unit: or None.
        says: a sentence about them.
    """

    def __init__(self, reference: str, transform: Transform | None, centers: np.ndarray) -> None:
        far = np.linalg.norm(centers, axis=1)
        near_surface = bool(((far > ON_EARTH_M[0]) & (far < ON_EARTH_M[1])).all())
        local = reference.strip().upper().startswith("LOCAL")
        self.on_earth = transform is not None and near_surface and not local
        self.metres_per_unit: float | None = None
        spheroid = re.search(r'(?:SPHEROID|ELLIPSOID)\s*\[\s*"([^"]*)"\s*,\s*([\d.]+)', reference)
        self.ellipsoid = spheroid[1] if spheroid and abs(float(spheroid[2]) - WGS_84_M) > 1.0 else None
        if self.on_earth:
            self.metres_per_unit = 1.0
            self.says = "World: east, north, up in metres of the first camera, by the reference of the chunk" + (
                f"; its ellipsoid is {self.ellipsoid}, so that its own coordinates are not those of GPS."
                if self.ellipsoid
                else ", heights above the ellipsoid."
            )
        elif transform is not None and local:
            unit = re.findall(r'UNIT\s*\[\s*"[^"]*"\s*,\s*([\d.eE+-]+)', reference)
            self.metres_per_unit = float(unit[-1]) if unit and float(unit[-1]) > 0 else 1.0
            self.says = "World: local coordinates of the chunk's reference."
        else:
            self.says = "World: scale and orientation of the chunk, which has no reference on the earth."


def _lenses(
    path: Path, chunk: ElementTree.Element, used: set[str | None]
) -> tuple[dict[str | None, Lens], dict[str | None, str], list[str]]:
    """By number of a sensor its lens, or why it has none here: only images that are used have to have one; and notes on them."""
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    lenses, unread, notes = {}, {}, []
    for key in sorted(used, key=str):
        try:
            lenses[key], told = _lens(sensors.get(key), f"{path}: sensor {key}")
            notes += told
        except SceneError as error:
            unread[key] = str(error)
    return lenses, unread, notes


def _lens(sensor: ElementTree.Element | None, where: str) -> tuple[Lens, list[str]]:
    """The lens of a sensor by its adjusted calibration, or what other there is, and notes on it."""
    calibrations = [] if sensor is None else sensor.findall("calibration")
    if not calibrations:
        what = "is not in the file" if sensor is None else "has no calibration"
        raise SceneError(f"{where} {what}; align its images in Metashape, and {EXPORT}")
    calibration = next((one for one in calibrations if one.get("class") == "adjusted"), calibrations[0])
    notes = []
    if calibration.get("class", "adjusted") != "adjusted":
        notes.append(f"{where} has its {calibration.get('class')} calibration: none that an alignment has adjusted.")
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind != "frame":
        raise SceneError(f"{where}: type is {kind}, and only frame is read; let Metashape undistort its images first")
    texts = {key: calibration.findtext(key, "0") for key in NUMBERS}
    values = {key: float(numbers_in(text, 1, f"{where}: {key}", EXPORT)[0]) for key, text in texts.items()}
    if values["f"] <= 0:
        raise SceneError(f"{where}: f is {values['f']:g}, the focal length in pixels is needed; {EXPORT}")
    if beyond := next((key for key in ("p3", "p4") if values[key]), None):
        raise SceneError(f"{where}: {beyond} is {values[beyond]:g}, which lenses here do not have; {OPTIMIZE} {beyond}")
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    width, height = (
        int(numbers_in(None if size is None else size.get(side), 1, f"{where}: {side} of its resolution", EXPORT)[0])
        for side in ("width", "height")
    )
    cx, cy = width / 2 + values["cx"], height / 2 + values["cy"]
    notes += checked_skew(values["b2"], values["f"], cy, height, f"{where}: b2", f"{OPTIMIZE} b1, b2")
    fx, fy = values["f"] + values["b1"], values["f"]
    radial, divisor = [values[key] for key in ("k1", "k2", "k3")], [0.0] * 3
    if values["k4"]:
        corner = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
        radial, divisor, off = _without_r8([*radial, values["k4"]], corner)
        if off * fy > FITTED_PX:
            raise SceneError(
                f"{where}: k4 is {values['k4']:g}, and lenses here come no nearer to such a distortion than {off * fy:.2g} "
                f"pixels; {OPTIMIZE} k4"
            )
    parameters = [fx, fy, cx, cy, *radial[:2], values["p2"], values["p1"], radial[2], *divisor]
    return lens_of("FULL_OPENCV", parameters, width, height, where), notes


def _without_r8(radial: list[float], corner: float) -> tuple[list[float], list[float], float]:
    """Coefficients of r², r⁴, r⁶ above and below a line that are nearest to 1 + k1 r² + ... + k4 r⁸ up to the corner of the
    image, and by how much r times it is off at most."""
    # Chebyshev points of r², as shares of the largest.
    shares = 0.5 - 0.5 * np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    powers = shares[:, None] ** np.arange(1, 5)
    scales = corner ** (2.0 * np.arange(1, 5))
    wanted = 1.0 + powers @ (np.array(radial) * scales)
    found = np.linalg.lstsq(
        np.column_stack([powers[:, :3], -wanted[:, None] * powers[:, :3]]), wanted - 1.0, rcond=1e-12
    )[0]
    below = 1.0 + powers[:, :3] @ found[3:]
    ratio = (1.0 + powers[:, :3] @ found[:3]) / below
    off = float(np.abs((ratio - wanted) * np.sqrt(shares) * corner).max()) if (below > 0).all() else np.inf
    return list(found[:3] / scales[:3]), list(found[3:] / scales[:3]), off
