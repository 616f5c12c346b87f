"""Radiometry pixel by pixel, once a scene is trained: its own depth is the distance, its own surfaces give the angle.

A tool that sees one image at a time has one distance for all pixels and an emissivity that knows no angle. A trained scene
knows both, so the air between a pixel's surface and the camera, and what the surface emits in that direction, are corrected
for each pixel.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, View, ViewSet, check_numbers, quantile
from heatsplat.datamodules.colmap import FRAMES_FILE
from heatsplat.datamodules.file_names import stem_of
from heatsplat.datamodules.formats.colmap import pinholes, write_model
from heatsplat.datamodules.side_files import found_file, read_table
from heatsplat.export.place import placed, unit_in_metres
from heatsplat.geometry.sight_lines import cosines, distances, normals
from heatsplat.io.pictures import Bar, Panel, colorize, write_png
from heatsplat.io.pictures import compose as side_by_side
from heatsplat.io.tables import markdown_table, write_csv
from heatsplat.io.tiff import write_temperature
from heatsplat.physics.planck import Band
from heatsplat.physics.radiometry import (
    LIMITS,
    Atmosphere,
    BandResponse,
    Conditions,
    PlanckResponse,
    Response,
    directional_emissivity,
    measured_signal,
    surface_temperature,
)
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.frame import Attitude, Position
from heatsplat.preparation.regions import OPTION, Parts, Region, Regions, read_regions
from heatsplat.preparation.report import Section, write_report
from heatsplat.preparation.target import CORRECTED, Target, wrote
from heatsplat.preparation.writer import write_bounds, write_world
from heatsplat.runs.run import load

log = logging.getLogger(__name__)

PLACED = [part.name for kind in (Position, Attitude) for part in fields(kind)]  # columns of frames.csv
GRAZING = 0.17  # cosine of 80°: beyond, a smooth surface is an idea
REGIONS_PICTURE = "report/regions.png"
PERCENT = (1, 5, 50, 95, 99)
ASSUMED = "Nothing says what air the scene was recorded in, so 20 °C and 50 % are assumed"
TURNED, FEW_POINTS = 15.0, 30  # degrees by which views may disagree on normals (ours), and points that tell it
NEARLY_ALL, MANY = 0.99, 0.1  # quantile of the points' depths, and share of pixels beyond it that is too many (ours)
# Share by which distances of splats and of measured points may differ: the air changes as little with them (ours).
APART = 0.1


@dataclass(frozen=True)
class Corrected:
    """One image, corrected.

    Args:
        one: °C with one distance for all pixels and no angle, [H, W] float64.
        distance_only: °C with a distance for each pixel.
        alike: °C with a distance and an angle for each pixel, and the same surfaces everywhere.
        celsius: the same, in regions with the emissivity of each.
        distance_m: to the surface; NaN where there is none.
        angle_deg: between line of sight and normal; NaN where it is not known.
        known: [H, W] bool, pixels of which the image has a temperature.
        parts: of the regions; None without any.
    """

    one: Tensor
    distance_only: Tensor
    alike: Tensor
    celsius: Tensor
    distance_m: Tensor
    angle_deg: Tensor
    known: Tensor
    parts: Parts | None = None


def corrected(
    celsius: Tensor,
    camera: Camera,
    depth: Tensor,
    metres_per_unit: float,
    response: Response,
    done: Conditions,
    wanted: Conditions,
    index: float | None,
    regions: Regions | None = None,
) -> Corrected:
    """An image of a trained scene under conditions that are known for each pixel.

    Args:
        celsius: [H, W] temperatures as they were trained on, NaN where unknown.
        camera, depth: of the image; camera z [H, W] in world units, infinite where there is no surface.
        metres_per_unit: scale of the world.
        response: of the thermal camera.
        done: conditions that the temperatures are corrected for already; that is taken back first.
        wanted: those to correct for; their distance is the one for all pixels, and stays where there is no surface.
        index: refractive index of the surfaces; None leaves the emissivity the same at all angles.
        regions: of the scene whose surfaces have an emissivity of their own.
    """
    signal = measured_signal(celsius.double() + KELVIN_AT_0_C, response, done)
    metres = distances(camera, depth) * metres_per_unit
    there = metres.isfinite()
    near = replace(wanted, distance_m=torch.where(there, metres, wanted.distance_m))
    cosine = cosines(camera, depth)

    def under(conditions: Conditions) -> Tensor:
        return surface_temperature(signal, response, conditions) - KELVIN_AT_0_C

    one, distance_only = under(wanted), under(near)
    seen = cosine.nan_to_num(1.0).clamp(min=GRAZING)
    alike = distance_only
    if index is not None:
        alike = under(replace(near, emissivity=directional_emissivity(wanted.emissivity, seen, index)))
    parts, all_of_it = None, alike
    if regions is not None:
        parts = regions.parts(camera, depth, signal, response, near, seen, index, alike)
        all_of_it = torch.where(parts.number >= 0, parts.celsius, alike).where(~parts.edge, torch.nan)
    angle = torch.rad2deg(torch.arccos(cosine))
    known = celsius.isfinite()
    return Corrected(one, distance_only, alike, all_of_it, metres.where(there, torch.nan), angle, known, parts)


def correct(
    ckpt: str | None,
    target: Path,
    *,
    conditions: Mapping[str, float | None],
    band_um: Sequence[float],
    refractive_index: float | None,
    metres_per_unit: float | None,
    regions: str | None = None,
    uncertainty: Mapping[str, float] | None = None,
    downscale: float | None = 1.0,
    trust: Sequence[str] = (),
) -> Path:
    """Corrects the images of a trained scene pixel by pixel and returns the path of a report on what that changed.

    The folder then has images/ (float32 TIFF in °C), the cameras in sparse/0, temperature_bounds.json, world.json and
    frames.csv (with dates, places and attitudes where the preparation's has them): it trains with ``data=colmap``. What the
    scene's own preparation corrected for is taken back first.

    Args:
        ckpt: checkpoint of a run on the scene.
        target: folder of the corrected scene.
        conditions: arguments of ``GivenConditions``; None takes those of the preparation.
        band_um: wavelengths in which the camera sees, where the preparation did not keep its calibration.
        refractive_index: of the surfaces, above 1; None for an emissivity without an angle.
        metres_per_unit: scale of the world; None takes the scene's, or that of its cameras' positions.
        regions: table of the boxes whose surfaces have an emissivity of their own (``read_regions``), or None.
        uncertainty: arguments of ``InputUncertainty``; what they leave in regions is reported.
        downscale: factor by which images shrink first, whatever the run was trained at; None is what it was trained at.
        trust: classes of yours that the checkpoint may name.

    Raises:
        SceneError: the scene has no temperatures or no scale or is corrected already, ``target`` is its own folder or holds what
            no correction wrote, the table of regions is none, or the conditions leave nothing to correct.
    """
    boxes = [] if regions is None else read_regions(found_file(OPTION, regions, None))
    recorded = {"downscale": downscale, "degrade": "null", "upsample": "null"}  # a run may have been given less
    trained = load(ckpt, data=recorded, trust=trust)
    root = trained.config["data"]["root"]  # of a synthetic scene there is none, and no preparation
    folders = [] if root is None else [Path(root), Path(root) / str(trained.config["data"].get("scene"))]
    return correct_scene(
        trained.scene,
        trained.depth,
        folders,
        target,
        GivenConditions(**conditions),
        BandResponse(Band(*band_um, nodes=16)),
        refractive_index,
        metres_per_unit or scale_of(trained.scene),
        boxes,
        InputUncertainty(**(uncertainty or {})),
        trained.module.cameras.of,
    )


def scale_of(scene: SceneData) -> float | None:
    """Metres of one unit of a scene, by itself or by the positions of its cameras; None where neither tells."""
    return unit_in_metres(scene, None if scene.metres_per_unit is not None else placed(scene))


def correct_scene(
    scene: SceneData,
    depth_of: Any,
    folders: Sequence[Path],
    target: Path,
    given: GivenConditions,
    response: Response,
    index: float | None,
    metres_per_unit: float | None,
    boxes: Sequence[Region] = (),
    uncertain: InputUncertainty | None = None,
    camera_of: Callable[[Frame], Camera] = attrgetter("camera"),
) -> Path:
    """As ``correct``, of a scene whose depth [H, W] in a frame ``depth_of`` gives; ``folders`` may hold its preparation.

    Cameras are those that ``camera_of`` a frame gives, such as a run has learned them (``cameras=refined``).
    """
    _check(scene, folders, target, index, metres_per_unit)
    place = Target(target, CORRECTED)
    place.claim()
    views = _by_name(scene, camera_of)
    few = [(frame.camera, depth_of(frame)) for frame in views.frames[:: max(1, len(views) // 8)]]
    far = typical_distance(few) * metres_per_unit
    doubts = [_doubt(few, scene.points), _beyond(few, scene.points)]
    doubts += [] if index is None else [_unsettled(few, scene.points)]
    doubts = [doubt for doubt in (*doubts, *given.doubts()) if doubt]
    for doubt in doubts:
        log.warning("%s", doubt)

    outcome, recorded = Outcome(), _recorded(folders)
    regions = Regions(boxes, uncertain or InputUncertainty(), scene.origin) if boxes else None
    for number, view in enumerate(track(views, "correcting")):
        calibration, done = preparation_of(view.frame.name, folders)
        wanted = given.conditions(done)
        if wanted.distance_m == 0:
            wanted = replace(wanted, distance_m=far)
        image = corrected(
            _celsius(scene, view),
            view.camera,
            depth_of(view.frame),
            metres_per_unit,
            calibration or response,
            done,
            wanted,
            index,
            regions,
        )
        file = f"{Path(view.frame.name).with_suffix('').as_posix()}.tiff"
        write_temperature(target / "images" / file, image.celsius.float().numpy())
        outcome.add(file, view.camera, image, wanted, air_assumed=given.air_c is None and done.distance_m == 0)
        outcome.cut_off += _cut_off(view)
        if regions is not None:
            guessed = given.reflected_c is None and done.emissivity == 1
            regions.add(view.camera, image.parts, image.alike, image.celsius, image.known, guessed)
        timed = {} if view.frame.time_s is None else {"time_s": view.frame.time_s}
        outcome.rows.append({"file": file, **timed, **recorded.get(stem_of(file), {})})
        if number == len(views) // 2:
            outcome.shown = image
    if not outcome.low < outcome.high:
        raise SceneError(
            f"under these conditions no pixel of {scene.name} has a temperature; are they those of the recording?"
        )

    _write_cameras(target, scene, outcome.cameras)
    place.has_cameras()
    write_csv(target / FRAMES_FILE, outcome.rows)
    write_world(target, metres_per_unit, scene.notes.get("axes"))
    write_bounds(target, outcome.low, outcome.high)
    write_png(target / "report" / "correction.png", _picture(outcome.shown))
    late = [f"{ASSUMED}: give conditions.air_c and conditions.humidity_percent."] if outcome.air_assumed else []
    if outcome.lost:
        late.append(
            f"{outcome.lost:,} pixels{' outside of all regions' if boxes else ''} have no temperature under these conditions, "
            "and are left out (NaN): they would reflect more than was measured of them, or lie farther than the formula of "
            "the air reaches."
        )
    if outcome.cut_off:
        late.append(
            f"{outcome.cut_off:,} pixels were cut off at an end of the span that the camera had chosen for their image: what was "
            "recorded is a bound of their temperature, which cannot be corrected, and they are left out (NaN)."
        )
    sections = [_section(outcome, far, index, [*doubts, *late], bool(boxes))]
    if regions is not None:
        sections.append(regions.section(outcome.conditions, index, scene.points, REGIONS_PICTURE))
        late += sections[-1].findings
        if (picture := regions.picture()) is not None:
            write_png(target / REGIONS_PICTURE, picture)
    for doubt in late:
        log.warning("%s", doubt)
    page = write_report(target, sections, f"{CORRECTED} by the trained scene {scene.name}")
    log.info("%s", page.with_suffix(".html"))
    return page


def _check(
    scene: SceneData, folders: Sequence[Path], target: Path, index: float | None, metres_per_unit: float | None
) -> None:
    """Raises SceneError where a scene cannot be corrected so, or would be lost."""
    if scene.thermal_range is None:
        raise SceneError(
            f"{scene.name} has no temperatures to correct; prepare it from a camera's files, or give it bounds"
        )
    if not metres_per_unit:
        raise SceneError(
            "the scale of the scene is not known, and the air between camera and surface counts in metres: give "
            "correct.metres_per_unit (poses with GPS have 1), or the positions of the cameras in frames.csv"
        )
    check_numbers("correct.metres_per_unit", metres_per_unit, error=SceneError, above=0)
    if index is not None:
        check_numbers("correct.refractive_index", index, error=SceneError)
    if index is not None and not index > 1:
        raise SceneError(f"correct.refractive_index must be above 1, got {index}; null is for no angle")
    scene_folder = next((folder for folder in reversed(folders) if folder.is_dir()), None)  # a root may hold several
    if scene_folder is not None and target.resolve() == scene_folder.resolve():
        raise SceneError(
            f"target={target} is the folder of the scene that is to be corrected, whose images would be lost: give another one"
        )
    if scene_folder is not None and wrote(scene_folder) == CORRECTED:
        raise SceneError(
            f"{scene_folder} is corrected already, and would be corrected twice: give the ckpt of a run on the scene that it "
            "was made from"
        )


def _celsius(scene: SceneData, view: View) -> Tensor:
    """Temperatures [H, W] float64 in °C that a view was trained on, NaN where a pixel does not count or is only a bound."""
    celsius = scene.thermal_range.to_celsius(view.thermal[..., 0].double())
    return celsius if view.known is None else celsius.where(view.known, torch.nan)


def _cut_off(view: View) -> int:
    """How many pixels that count are mere bounds of a temperature."""
    if view.ends is None:
        return 0
    return int(((view.ends != 0) if view.mask is None else (view.ends != 0) & view.mask).sum())


class Spread:
    """Mean size and percentiles of numbers that come image by image, in memory that does not grow with the images.

    Numbers are counted by the nearest of 16 bits, which is right to one part in 2048, and are taken to lie evenly about it.
    """

    def __init__(self) -> None:
        self.count, self._sizes = 0, 0.0
        self._counts = np.zeros(1 << 16, dtype=np.int64)

    def add(self, values: Tensor) -> None:
        """Counts those that are finite."""
        known = values[values.isfinite()].float().numpy()
        self.count += known.size
        self._sizes += float(np.abs(known).sum(dtype=np.float64))
        self._counts += np.bincount(known.astype(np.float16).view(np.uint16), minlength=len(self._counts))

    @property
    def mean_size(self) -> float:
        """NaN where nothing was counted."""
        return self._sizes / self.count if self.count else float("nan")

    def percentiles(self, shares: Sequence[float]) -> np.ndarray:
        """Of shares in per cent; NaN where nothing was counted."""
        if not self.count:
            return np.full(len(shares), np.nan)
        values = np.arange(len(self._counts), dtype=np.uint16).view(np.float16).astype(np.float64)
        finite = np.flatnonzero(np.isfinite(values))
        rising = finite[np.argsort(values[finite], kind="stable")]
        middles = values[rising]
        ends = np.concatenate([middles[:1], 0.5 * (middles[1:] + middles[:-1]), middles[-1:]])
        below = np.concatenate([[0], self._counts[rising].cumsum()])
        return np.round(np.interp(np.asarray(shares) / 100 * self.count, below, ends), 4) + 0.0  # no -0


@dataclass
class Outcome:
    """What a correction did, gathered image by image.

    Args:
        changes: in °C, by what each pixel was given: its distance, its angle, both.
        without_angle: share of the pixels of each image that have no known angle.
        low, high: bounds of the temperatures in °C; empty (low > high) where there are none.
        rows: of frames.csv.
        cameras: by file of the image.
        conditions: those that the last image was corrected for.
        air_assumed: whether nothing says of the air of some image what it was.
        lost: pixels of all images, but for those in regions, that have a temperature no more.
        cut_off: pixels of all images that never had one, but a bound of it.
        shown: the image that the report shows.
    """

    changes: dict[str, Spread] = field(default_factory=lambda: {key: Spread() for key in ("distance", "angle", "both")})
    without_angle: list[float] = field(default_factory=list)
    low: float = np.inf
    high: float = -np.inf
    rows: list[dict[str, Any]] = field(default_factory=list)
    cameras: dict[str, Camera] = field(default_factory=dict)
    conditions: Conditions = Conditions()
    air_assumed: bool = False
    lost: int = 0
    cut_off: int = 0
    shown: Corrected | None = None

    def add(self, file: str, camera: Camera, image: Corrected, conditions: Conditions, air_assumed: bool) -> None:
        """Counts an image."""
        self.changes["distance"].add(image.distance_only - image.one)
        self.changes["angle"].add(image.alike - image.distance_only)
        self.changes["both"].add(image.alike - image.one)
        self.without_angle.append(float(image.angle_deg.isnan().double().mean()))
        known = image.celsius.float().numpy()
        if np.isfinite(known).any():
            self.low, self.high = min(self.low, float(np.nanmin(known))), max(self.high, float(np.nanmax(known)))
        self.cameras[file] = camera
        self.conditions = conditions
        self.air_assumed |= air_assumed
        lost = image.known & image.alike.isnan()
        self.lost += int((lost if image.parts is None else lost & (image.parts.number < 0)).sum())


def _by_name(scene: SceneData, camera_of: Callable[[Frame], Camera]) -> ViewSet:
    """All views of a scene from these cameras, each decoded when it is asked for: together they may be more than memory holds."""
    places = [(part, k) for part in (scene.train, scene.test) for k in range(len(part))]
    places.sort(key=lambda place: place[0].frames[place[1]].name)
    with torch.no_grad():
        frames = [replace(part.frames[k], camera=camera_of(part.frames[k])) for part, k in places]
    return ViewSet(frames, lambda i: replace(places[i][0][places[i][1]], frame=frames[i]))


def _doubt(few: Sequence[tuple[Camera, Tensor]], points: Tensor) -> str:
    """What to say of a few cameras and their depths [H, W] where the splats lie elsewhere than the points that were measured."""
    found = []
    for camera, depth in few:
        at, within = _pixels(camera, points)
        far = camera.project(points[within])[1]
        found.append(depth[at[:, 1], at[:, 0]] / far)
    ratios = torch.cat(found)
    ratios = ratios[ratios.isfinite()]
    off = float(ratios.median()) - 1.0 if len(ratios) else 0.0
    if abs(off) <= APART:
        return ""
    return (
        f"The trained surfaces lie {100 * abs(off):.0f} % {'farther' if off > 0 else 'nearer'} than the points that the "
        "reconstruction measured (median): distances are not settled; train longer (preset=fast, balanced)."
    )


def _beyond(few: Sequence[tuple[Camera, Tensor]], points: Tensor) -> str:
    """What to say where many pixels are farther than nearly any point that was measured in their image; empty where few are."""
    beyond = []
    for camera, depth in few:
        _, within = _pixels(camera, points)
        if within.any():
            farthest = quantile(camera.project(points[within])[1].double(), NEARLY_ALL)
            known = depth[depth.isfinite()]
            beyond.append((known > (1.0 + APART) * farthest).double())
    share = float(torch.cat(beyond).mean()) if beyond else 0.0
    if not share > MANY:
        return ""
    return (
        f"{100 * share:.0f} % of the pixels lie farther than the points that the reconstruction measured in their images: where "
        "surfaces have no texture distances are not settled; train longer (preset=fast, balanced), or look at the picture of "
        "distances."
    )


def _unsettled(few: Sequence[tuple[Camera, Tensor]], points: Tensor) -> str:
    """What to say where views disagree on the normals of the same points; empty where they do not."""
    seen = []
    for camera, depth in few:
        turn, found = camera.viewmat[:3, :3], normals(camera, depth)
        at, within = _pixels(camera, points)
        own = torch.full((len(points), 3), torch.nan, dtype=torch.float64)
        own[within] = found[at[:, 1], at[:, 0]] @ turn
        seen.append(own)
    cosine = torch.cat([(one * other).sum(-1) for one, other in pairwise(seen)] or [torch.zeros(0)])
    cosine = cosine[cosine.isfinite()]
    if len(cosine) < FEW_POINTS:
        return "Too few points show their normals to two views: angles cannot be checked."
    apart = float(torch.rad2deg(torch.arccos(cosine.clamp(-1.0, 1.0))).median())
    if apart <= TURNED:
        return ""
    return (
        f"Two views see the normal of the same point {apart:.0f}° apart (median): angles are not settled, and what they change "
        "is mostly wrong; train longer, or leave correct.refractive_index out."
    )


def _pixels(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (column, row) [n, 2] of the points that lie in an image, and which these are, [P] bool."""
    places, depths = camera.project(points)
    within = camera.inside(places, depths)
    return places[within].floor().long(), within


def _recorded(folders: Sequence[Path]) -> dict[str, dict[str, str]]:
    """By name of a frame, what its preparation's table tells beside its temperatures: date, place, attitude."""
    path = next((p for f in folders if (p := f / FRAMES_FILE).is_file()), None)
    if path is None:
        return {}
    table = read_table(path)
    if "file" not in table.columns:  # one of the user's own
        return {}
    kept = [(i, c) for i, c in enumerate(table.columns) if c in {"time", *PLACED}]
    return {
        stem_of(cells[table.columns.index("file")]): {column: cells[i] for i, column in kept} for _, cells in table.rows
    }


def typical_distance(few: Sequence[tuple[Camera, Tensor]]) -> float:
    """Median distance in world units over a few cameras with their depths [H, W]: what one would give for all pixels.

    Raises:
        SceneError: none of them sees a surface.
    """
    found = [distances(camera, depth) for camera, depth in few]
    known = torch.cat([d[d.isfinite()] for d in found])
    if not len(known):
        raise SceneError("the trained scene shows no surface to any of its cameras; train it longer")
    return float(known.median())


def preparation_of(name: str, folders: Sequence[Path]) -> tuple[Response | None, Conditions]:
    """The calibration and the conditions that an image was prepared with; None and no correction where nothing says so."""
    path = next((p for f in folders if (p := (f / "images" / name).with_suffix(".json")).is_file()), None)
    if path is None:
        return None, Conditions()
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        stated = {key: float(record["conditions"][key]["value"]) for key in LIMITS}
        done = Conditions(**stated, atmosphere=Atmosphere(**record["atmosphere"]))
        kind = dict(record["calibration"])
        if kind.pop("kind") == "planck":
            return PlanckResponse(**kind), done
        return BandResponse(Band(*kind["band_um"], nodes=16)), done
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise SceneError(f"{path} is no record of a preparation ({error}); prepare the scene again") from error


def _write_cameras(target: Path, scene: SceneData, cameras: Mapping[str, Camera]) -> None:
    """Cameras and points in the coordinates of the data set: what lies at a place in one scene lies there in the other."""
    kinds, camera_of = pinholes(cameras)
    poses = {name: camera.viewmat.clone() for name, camera in cameras.items()}
    for pose in poses.values():
        pose[:3, 3] -= pose[:3, :3] @ scene.origin
    poses = {name: pose.numpy() for name, pose in poses.items()}
    colours = scene.point_colors if scene.point_colors is not None else torch.full((len(scene.points), 3), 0.5)
    points = (scene.points.double() + scene.origin).numpy()
    write_model(target / "sparse" / "0", poses, kinds, points, _bytes(colours), camera_of=camera_of)


def _bytes(colours: Tensor) -> np.ndarray:
    return (colours.double().clamp(0, 1) * 255).round().numpy().astype(np.uint8)


def _picture(found: Corrected) -> np.ndarray:
    change = found.alike - found.one
    most = max(float(np.nanquantile(change.abs().numpy(), 0.99)), 1e-3)
    panels = []
    for values, title, unit, ends in (
        (found.distance_m, "distance", "m", None),
        (found.angle_deg, "angle", "°", (0.0, 90.0)),
        (found.celsius, "temperature", "°C", None),
        (change, "change against one distance", "°C", (-most, most)),
    ):
        known = values[values.isfinite()]
        low, high = ends or (float(quantile(known, 0.01)), float(quantile(known, 0.99))) if len(known) else (0.0, 1.0)
        colours = "RdBu_r" if title.startswith("change") else "inferno"
        panels.append(Panel(colorize(values, low, high, colours), title, Bar(low, high, unit, colours)))
    return side_by_side(panels)


def _section(
    outcome: Outcome, far: float, index: float | None, doubts: Sequence[str], regions: bool = False
) -> Section:
    """What a distance (and an angle, where it counts) for each pixel changed, in °C; with ``regions`` before these count."""
    conditions, without_angle = outcome.conditions, float(np.mean(outcome.without_angle))
    names = {"distance": "distance of each pixel"}
    if index is not None:
        names |= {"angle": "angle of each pixel", "both": "both"}
    table, values = [], {}
    for key, name in names.items():
        size, quantiles = outcome.changes[key].mean_size, outcome.changes[key].percentiles(PERCENT)
        table.append([name, f"{size:.3f}", *(f"{q:+.3f}" for q in quantiles)])
        values[key] = {
            "mean_abs_c": size,
            "percentiles_c": dict(zip(map(str, PERCENT), quantiles.tolist(), strict=True)),
        }
    lines = [
        f"{len(outcome.cameras)} images, against one distance of {float(conditions.distance_m):.1f} m for all pixels (the "
        f"scene's median is {far:.1f} m) and an emissivity of {float(conditions.emissivity):g} at every angle"
        f"{' (in regions, too: they are below)' if regions else ''}. Air "
        f"{float(conditions.air_k) - KELVIN_AT_0_C:.1f} °C, {100 * float(conditions.humidity):.0f} %, reflected "
        f"{float(conditions.reflected_k) - KELVIN_AT_0_C:.1f} °C, "
        + (
            f"refractive index {index:g}; {100 * without_angle:.0f} % of the pixels have no known angle (edges, and what is too "
            "rough for a plane) and keep the emissivity along the normal."
            if index is not None
            else "no angle."
        ),
        "",
        *markdown_table(["change in °C", "mean of its size", *(f"{p} %" for p in PERCENT)], table, "lrrrrrr"),
        "",
        "![distance, angle, temperature and change](report/correction.png)",
    ]
    angle = "" if index is None else " and an angle"
    return Section(f"What a distance{angle} for each pixel changes", lines, values, list(doubts))
