"""Where a scene lies on the earth, or at least which way is up: its points in metres east, north and up."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from heatsplat.contracts import Camera, SceneData, SceneError
from heatsplat.export.camera_positions import named, read_positions
from heatsplat.export.formats.base import optional
from heatsplat.export.moment import Moment
from heatsplat.geometry.alignment import Similarity, similarity_between
from heatsplat.geometry.rotations import matrices_to_quats, quats_to_matrices
from heatsplat.geometry.trajectories import upward

log = logging.getLogger("heatsplat")

AUTO = "auto"
LOOSE = 0.7  # share of how far positions are from their middle by which cameras may be off them (rms): half of their variance
LEAST_SPREAD = 0.1  # positions whose second extent is below this share of the first lie on a line
AXES = "east, north, up"  # of a world whose axes preparation has set by GPS (``notes["axes"]``)
ONE_WAY = 0.95  # length of the mean viewing direction from which on all cameras look the same way


@dataclass(frozen=True)
class Place:
    """Points of the world in other coordinates: east, north, up (x to the right and y to the top of a map).

    Args:
        similarity: from the world.
        crs: such as "EPSG:32631"; None where the scene is not known to lie anywhere.
        unit: of lengths: "metre", or "unit of the scene".
    """

    similarity: Similarity
    crs: str | None
    unit: str

    @property
    def scale(self) -> float:
        return float(self.similarity.scale)

    def __call__(self, points: Tensor) -> Tensor:
        """Points [n, 3] float64."""
        return self.similarity(points.double())

    def latitudes_longitudes(self, points: Tensor) -> list[tuple[float, float]]:
        """Latitude and longitude (WGS 84, degrees) of points [n, 3] of the world, where it has a ``crs``."""
        east, north, _ = self(points).T.tolist()
        longitudes, latitudes = optional("rasterio.warp", "map").transform(self.crs, "EPSG:4326", east, north)
        return list(zip(latitudes, longitudes, strict=True))


def place_of(scene: SceneData, gps: str | Path | None = None, above: Tensor | None = None) -> Place:
    """Where a scene lies: by a table of camera positions in a UTM zone, else with its own scale and direction of up.

    Positions tell only the shift of a world whose axes are known to be east, north and up, and whose scale is: the turn about
    a line of flight would follow from decimetres between its positions. They place any other world as a whole.

    Args:
        scene: with its training cameras.
        gps: CSV with the name, latitude and longitude (WGS 84, degrees) and height (metres) of camera positions; "auto" takes
            the scene's own, where it has one that places its cameras and ``above`` does not say otherwise; None takes none.
        above: [3] direction that counts as up, in place of the scene's own; not with a table. None: that of its weather, or of
            its axes where they are east, north and up; else where all cameras look the same way (a drone that looks down, a
            wall seen from the front) back towards them; else upward in their images.

    Raises:
        SceneError: the table cannot be read, or its positions do not place the cameras.
        ImportError: rasterio, which knows map projections, is not installed.
    """
    if gps == AUTO:
        if scene.positions is not None and above is None:
            try:
                return _placed(scene, scene.positions)
            except SceneError as error:
                log.warning("%s: what is written has no place on the earth", error)
    elif gps is not None:
        return _placed(scene, Path(gps).expanduser())
    cameras = [frame.camera for frame in scene.train.frames]
    images_up = upward(cameras).double()
    up = normalize(above.double() if above is not None else _up(scene, cameras, images_up), dim=0)
    axes = torch.eye(3, dtype=torch.float64)
    # North is y of the world, unless that is (nearly) up; where the cameras look down their images' top.
    known = scene.weather is not None or _east_north_up(scene)
    candidates = [axes[1], images_up, axes[2], axes[0]] if known else [images_up, *axes[[1, 2, 0]]]
    north = next(one for one in candidates if (one - (one @ up) * up).norm() > 0.5)
    north = normalize(north - (north @ up) * up, dim=0)
    rotation = torch.stack([torch.linalg.cross(north, up), north, up])
    metres = scene.metres_per_unit
    scale = torch.tensor(1.0 if metres is None else metres, dtype=torch.float64)
    shift = torch.zeros(3, dtype=torch.float64)
    return Place(Similarity(scale, rotation, shift), None, "unit of the scene" if metres is None else "metre")


def _up(scene: SceneData, cameras: Sequence[Camera], images_up: Tensor) -> Tensor:
    """The direction [3] of up that a scene knows or its cameras tell."""
    if scene.weather is not None:
        return scene.weather.up.double()
    if _east_north_up(scene):
        return torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    forward = torch.stack([camera.viewmat[2, :3] for camera in cameras]).mean(0)
    return -forward if forward.norm() > ONE_WAY else images_up


def place_in_file(scene: SceneData, gps: str | Path | None = None, above: Tensor | None = None) -> Place:
    """As ``place_of``, for coordinates that are written: where these have no place on the earth, and an origin was taken off the
    scene, a warning says what they are."""
    place, origin = place_of(scene, gps, above), scene.notes.get("origin")
    if place.crs is None and origin is not None:
        log.warning(
            "coordinates count from %s of the data set, whose numbers are too large for float32, in axes and lengths of their "
            "own: what=ply and what=npz have those of the data set", ", ".join(f"{x:.10g}" for x in origin),
        )  # fmt: skip
    return place


def placed(scene: SceneData) -> Place | None:
    """Where a scene lies on the earth by its own camera positions, as by ``place_of``; None where it has none that tell, or where
    rasterio is not installed."""
    try:
        place = None if scene.positions is None else place_of(scene, AUTO)
    except ImportError:  # of the extra "export"
        return None
    return None if place is None or place.crs is None else place


def unit_in_metres(scene: SceneData, place: Place | None) -> float | None:
    """Metres of one unit of a scene: its own scale, else that of its place on the earth (``placed``), which is logged; None where
    neither is known."""
    if scene.metres_per_unit is not None or place is None:
        return scene.metres_per_unit
    log.info("one unit of scene '%s' is taken for %.4g m, by the positions of its cameras in %s", scene.name, place.scale,
             scene.positions)  # fmt: skip
    return place.scale


def upright(moment: Moment) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3], rotations [N, 4] wxyz and scales [N, 3] with y up and z towards the south (or the viewer), in metres.

    The axes of glTF and of SPZ; in units of the scene where it has no scale.
    """
    place = place_in_file(moment.module.scene)
    scale, rotation, _ = place.similarity
    axes = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    turned = axes @ rotation @ quats_to_matrices(moment.seen.quats.double())
    means = place(moment.seen.means) @ axes.T
    return means.float(), matrices_to_quats(turned).float(), moment.seen.scales * float(scale)


def _placed(scene: SceneData, path: Path) -> Place:
    """By the shift, or else the similarity, that brings the cameras closest to their positions."""
    positions = read_positions(path, flat=_east_north_up(scene))
    found = {
        frame.camera.center: positions[name]
        for frame, name in zip(scene.frames, named(scene.frames, positions), strict=True)
        if name is not None
    }
    if len(found) < 3:
        names = ", ".join(frame.name for frame in scene.frames[:2])
        raise SceneError(f"{path} has positions of {len(found)} of the images ({names}, ...); 3 are needed")
    degrees = torch.tensor(list(found.values()), dtype=torch.float64)
    warp = optional("rasterio.warp", "map")
    # Degrees from the first one on: positions may lie on both sides of the 180th.
    beside = (degrees[:, 1] - degrees[0, 1] + 180.0) % 360.0 - 180.0
    latitude, longitude = float(degrees[:, 0].mean()), float(degrees[0, 1] + beside.mean())
    crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + int((longitude + 180) // 6) % 60 + 1}"
    east, north = warp.transform("EPSG:4326", crs, degrees[:, 1].tolist(), degrees[:, 0].tolist())
    target = torch.tensor([east, north, degrees[:, 2].tolist()], dtype=torch.float64).T
    source = torch.stack(list(found)).double()
    across, along = torch.linalg.svdvals(target - target.mean(0))[[1, 0]].tolist()
    if _east_north_up(scene):
        similarity = _shifted(scene.metres_per_unit, _grid_north(warp, crs, latitude, longitude), source, target)
    elif across < LEAST_SPREAD * along:
        raise SceneError(
            f"{path}: the positions lie on a line ({across / along:.0%} as wide as long), which leaves the turn about it open. A "
            "second strip beside it would tell it; prepare.py, run again, notes the axes of a folder that it has placed by GPS"
        )
    else:
        similarity = _fitted(path, source, target)
    off = similarity(source) - target
    # By what the world may be tipped about the line of flight, as far below it as the ground is.
    height = (similarity(source)[:, 2].median() - similarity(scene.points.double())[:, 2].median()).abs().item()
    tipped = height * off[:, 2].square().mean().sqrt().item() * len(source) ** 0.5 / max(across, 1e-9)
    log.info(
        "%s: %d cameras placed in %s, %.2f m from their positions (rms); %.0f m below them, the ground may be off by %.1f m "
        "across the line of flight",
        path, len(found), crs, off.square().sum(1).mean().sqrt().item(), height, tipped,
    )  # fmt: skip
    return Place(similarity, crs, "metre")


def _fitted(path: Path, source: Tensor, target: Tensor) -> Similarity:
    """The similarity that brings cameras [n, 3] closest to their positions [n, 3].

    Raises:
        SceneError: they have little to do with each other, such as those of a walk about a machine with GPS that is metres off,
            or all are at one place: any scale and turn would do.
    """
    apart = (target - target.mean(0)).square().sum(1).mean().sqrt().item()
    try:
        similarity = similarity_between(source, target)
    except ValueError as error:
        raise SceneError(f"{path} does not place the cameras: {error}") from error
    off = (similarity(source) - target).square().sum(1).mean().sqrt().item()
    if not off < LOOSE * apart:
        raise SceneError(
            f"{path} does not place the cameras: at best they lie {off:.2g} m from its positions, which are only {apart:.2g} m "
            "from their middle (rms). GPS is metres off, and the scene may be too small for it"
        )
    return similarity


def _east_north_up(scene: SceneData) -> bool:
    """Whether the axes of the world are known to be east, north and up, in a known scale."""
    return scene.notes.get("axes") == AXES and scene.metres_per_unit is not None


def _shifted(metres_per_unit: float, grid_north: tuple[float, float], source: Tensor, target: Tensor) -> Similarity:
    """Of a world whose axes are east, north and up to a map projection: only its shift follows from points [n, 3] of both.

    Args:
        metres_per_unit: of the world.
        grid_north: easting and northing in the projection of one metre to the north.
        source, target: in the world, in the projection.
    """
    east, north = grid_north
    stretch = math.hypot(east, north)
    cosine, sine = north / stretch, east / stretch
    rotation = torch.tensor([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    scale = torch.tensor(metres_per_unit * stretch, dtype=torch.float64)
    return Similarity(scale, rotation, (target - scale * source @ rotation.T).mean(0))


def _grid_north(warp: Any, crs: str, latitude: float, longitude: float) -> tuple[float, float]:
    """Easting and northing in a map projection of one metre to the north of a place."""
    angle, step = 2 * math.radians(latitude), 1e-3
    metres = step * (111132.954 - 559.822 * math.cos(angle) + 1.175 * math.cos(2 * angle))  # of the meridian, WGS 84
    east, north = warp.transform("EPSG:4326", crs, [longitude] * 2, [latitude - step / 2, latitude + step / 2])
    return (east[1] - east[0]) / metres, (north[1] - north[0]) / metres
