"""Cameras that Pix4D has calibrated: *_calibrated_camera_parameters.txt in the folder params of its first step.

Of each image it has ten lines: name, width, height; K [3, 3]; radial R1 R2 R3; tangential T1 T2; place t [3]; R [3, 3]. With
X' = R (X - t), x right, y down and z forward, a point is seen at m = K x, where x is X' / Z' distorted as by OpenCV (k1 k2 k3 are
R1 R2 R3, p1 p2 are T1 T2). Pixels are taken to count from the corner of the image. *_offset.xyz beside it was taken off the
coordinates of *_wkt.prj, a map projection.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.aligned_cameras import (
    WGS_84_M,
    AlignedCameras,
    checked_skew,
    numbers_in,
    world_to_camera,
)
from heatsplat.datamodules.formats.geodesy import east_north_up, from_utm
from heatsplat.datamodules.formats.lens import Lens, lens_of
from heatsplat.datamodules.side_files import read_text
from heatsplat.geometry.alignment import similarity_between

ENDING = "_calibrated_camera_parameters.txt"
EXPORT = "process the project's first step again with Camera Internals and Externals exported, or give the file as Pix4D wrote it"
# Lines of an image below its name: what stands there and how many numbers.
LINES = (*(("camera matrix K", 3),) * 3, ("radial distortion", 3), ("tangential distortion", 2), ("camera position t", 3),
         *(("camera rotation R", 3),) * 3)  # fmt: skip
IMAGE = re.compile(r"(.*\S)\s+([1-9]\d+)\s+([1-9]\d+)")  # its name, width and height
NUMBER = re.compile(r"-?\d+(\.\d*)?(e[+-]?\d+)?\s", re.IGNORECASE)
ARM_M = 500.0  # of the cross in a map projection by which its axes are compared with east and north


def is_pix4d(path: Path) -> bool:
    """Whether a file has the name of Pix4D's calibrated camera parameters."""
    return path.name.lower().endswith(ENDING)


def read_pix4d(path: Path) -> AlignedCameras:
    """The cameras of a file of calibrated camera parameters: in metres east, north and up of the first one where the projection
    is UTM of WGS 84 (or of ETRS89), else in the coordinates of the file.

    Raises:
        SceneError: the file is none, or one of its numbers cannot be; it names file, line, key and remedy.
    """
    cameras: dict[str, tuple[np.ndarray, Lens]] = {}
    refused: dict[str, str] = {}
    notes: list[str] = []
    lenses: dict[tuple, Lens] = {}
    lines = [(i, line.strip()) for i, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    # Past the heading, which has words.
    at = next((i for i, (_, line) in enumerate(lines) if IMAGE.fullmatch(line) or NUMBER.match(line)), len(lines))
    if at == len(lines):
        raise SceneError(f"{path} has no line of an image (fileName imageWidth imageHeight); {EXPORT}")
    while at < len(lines):
        number, line = lines[at]
        head = IMAGE.fullmatch(line)
        if head is None:
            raise SceneError(
                f"{path}, line {number}: fileName imageWidth imageHeight are needed, it is {line[:60]!r}; {EXPORT}"
            )
        name, size = head[1], (int(head[2]), int(head[3]))
        below = lines[at + 1 : at + 1 + len(LINES)]
        if len(below) < len(LINES):
            raise SceneError(f"{path} ends within {name}, after {len(below)} of its {len(LINES)} lines; {EXPORT}")
        values = [numbers_in(text, count, f"{path}, line {i}: {what} of {name}", EXPORT)
                  for (i, text), (what, count) in zip(below, LINES, strict=True)]  # fmt: skip
        viewmat = world_to_camera(
            np.stack(values[6:]).T, values[5], f"{path}, line {number}: camera rotation R of {name}"
        )
        at += 1 + len(LINES)
        if name in cameras or name in refused:
            refused[name] = (
                f"{path}, line {number}: {name} has two cameras; take one out, or rename the files of one flight"
            )
            cameras.pop(name, None)
            continue
        key = (*size, *np.concatenate(values[:5]))
        try:
            if key not in lenses:
                lenses[key], told = _lens(np.stack(values[:3]), values[3], values[4], size, f"{path}, {name}")
                notes += told
            cameras[name] = viewmat, lenses[key]
        except SceneError as error:
            refused[name] = str(error)
    return _placed(path, cameras, refused, notes)


def _lens(
    matrix: np.ndarray, radial: np.ndarray, tangential: np.ndarray, size: tuple[int, int], where: str
) -> tuple[Lens, list[str]]:
    if matrix[1, 0] or (matrix[2] != (0, 0, 1)).any() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise SceneError(f"{where}: camera matrix K is {matrix.tolist()}, not [fx 0 cx, 0 fy cy, 0 0 1]; {EXPORT}")
    remedy = "give the project's images a camera without skew"
    notes = checked_skew(matrix[0, 1], matrix[1, 1], matrix[1, 2], size[1], f"{where}: camera matrix K", remedy)
    parameters = [matrix[0, 0], matrix[1, 1], *matrix[:2, 2], *radial[:2], *tangential, radial[2], 0.0, 0.0, 0.0]
    return lens_of("FULL_OPENCV", parameters, *size, where), notes


def _placed(
    path: Path, cameras: dict[str, tuple[np.ndarray, Lens]], refused: dict[str, str], notes: list[str]
) -> AlignedCameras:
    """The cameras on the earth, as far as the files beside theirs tell."""
    stem = path.name[: -len(ENDING)]
    offset_file, projection_file = path.with_name(f"{stem}_offset.xyz"), path.with_name(f"{stem}_wkt.prj")
    projection = read_text(projection_file) if projection_file.is_file() else ""
    zone = re.search(r'^\s*PROJCS\s*\[\s*"[^"]*UTM[ _]zone[ _]*(\d+)\s*([NS])', projection, re.IGNORECASE)
    spheroid = re.search(r'SPHEROID\s*\[\s*"[^"]*"\s*,\s*([\d.]+)', projection)
    unit = re.findall(r'UNIT\s*\[\s*"[^"]*"\s*,\s*([\d.eE+-]+)', projection)
    metres = float(unit[-1]) if unit and projection.lstrip().upper().startswith("PROJCS") else None
    known = AlignedCameras(path, cameras, refused=refused, notes=notes, metres_per_unit=metres)
    if not offset_file.is_file() or not cameras:
        lacking = f"no {offset_file.name} beside it, which tells where they are"
    elif not projection_file.is_file():
        lacking = f"no {projection_file.name} beside it, which tells their projection"
    elif zone is None or spheroid is None or abs(float(spheroid[1]) - WGS_84_M) > 1.0 or metres != 1.0:
        lacking = f"{projection_file.name} is not UTM of WGS 84, in metres"
    else:
        offset = numbers_in(read_text(offset_file).replace(",", " "), 3, str(offset_file), EXPORT)
        return _east_north_up(known, offset, int(zone[1]), zone[2].upper() == "N")
    says = f"World: coordinates of the file{'' if metres is None else ', whose unit the projection tells'} ({lacking})."
    return replace(known, notes=[*notes, says])


def _east_north_up(known: AlignedCameras, offset: np.ndarray, zone: int, north: bool) -> AlignedCameras:
    """The cameras in metres east, north and up of the first: a projection is turned against north, and stretched."""
    first = np.linalg.inv(next(iter(known.cameras.values()))[0])[:3, 3]
    arms = ARM_M * np.array([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    places = from_utm(arms + first + offset, zone, north)
    there = torch.from_numpy(east_north_up(places, places[0]))
    scale, rotation, shift = (one.numpy() for one in similarity_between(torch.from_numpy(arms), there))
    cameras = {}
    for name, (viewmat, lens) in known.cameras.items():
        pose = np.linalg.inv(viewmat)
        center = scale * rotation @ (pose[:3, 3] - first) + shift
        cameras[name] = world_to_camera(rotation @ pose[:3, :3], center, f"{known.source}: {name}"), lens
    hemisphere = "N" if north else "S"
    says = f"World: east, north, up in metres of the first camera, by UTM zone {zone}{hemisphere}, with its heights."
    return replace(
        known, cameras=cameras, notes=[*known.notes, says], metres_per_unit=1.0, east_north_up=True, origin=places[0]
    )
