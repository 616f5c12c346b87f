"""Parts of a scene whose surfaces have an emissivity of their own: boxes of a table, their pixels, and what that changes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import max_pool2d

from heatsplat.contracts import Camera, SceneError, quantile
from heatsplat.datamodules.side_files import finite, read_table, shortened
from heatsplat.geometry.projection import to_camera, to_pixels, to_world
from heatsplat.geometry.sight_lines import rays
from heatsplat.io.page import plain
from heatsplat.io.pictures import (
    ERROR,
    INK,
    PANEL_HEIGHT,
    WIDEST_PANEL,
    Bar,
    Panel,
    colorize,
    compose,
    enlarged,
    lettering,
    lut,
)
from heatsplat.io.tables import NONE, markdown_table, number
from heatsplat.physics.radiometry import (
    LIMITS,
    Conditions,
    Response,
    directional_emissivity,
    surface_temperature,
    uncertainty,
)
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.preparation.conditions import HOT_C, InputUncertainty
from heatsplat.preparation.report import Section

OPTION = "correct.regions"
CORNERS = ("x1", "y1", "z1", "x2", "y2", "z2")
NEEDED = ("name", *CORNERS, "emissivity")
REFLECTED = "reflected_c"
# Columns of the viewer's table of boxes, which say what the picture showed.
VIEWERS = re.compile(r"values|time \(s\)|clock \(.*\)|(min|mean|max|standard deviation)( \(.*\))?|pixels|.* \(%\)")
FARTHEST = 1e12  # beyond lie no coordinates
# Below it a surface sends more of its surroundings than of itself, and is no smooth dielectric whose emissivity Fresnel's law
# of the angle gives: metals.
MIRRORS = 0.5
# No surface that anyone records is colder: what is left beside the reflection is none of its own (ours).
COLDEST_C = -100.0
EDGE_C = 2.0  # by which a pixel at an edge may differ with the region that it is counted to (ours)
WHITE = (255, 255, 255)
EDGE_POINTS = 64  # along an edge of a box that is drawn


@dataclass(frozen=True)
class Region:
    """A box of the scene, and what its surfaces are.

    Args:
        name: of the region; of several each another.
        low, high: corners [3] float64 in the coordinates of the data set.
        emissivity: along the normal, in (0, 1].
        reflected_c: apparent temperature of what its surfaces reflect, in °C; None for that of the conditions.
    """

    name: str
    low: Tensor
    high: Tensor
    emissivity: float
    reflected_c: float | None = None

    @property
    def volume(self) -> float:
        return float((self.high - self.low).prod())

    def conditions(self, near: Conditions, at: Tensor, cosine: Tensor, index: float | None) -> Conditions:
        """Conditions of the pixels ``at`` [H, W] bool if they lie in the region; other arguments as of ``Regions.parts``."""
        emissivity: float | Tensor = self.emissivity
        if index is not None and not self.mirrors:
            emissivity = directional_emissivity(emissivity, cosine[at], index)
        reflected_k = near.reflected_k if self.reflected_c is None else self.reflected_c + KELVIN_AT_0_C
        return replace(near, emissivity=emissivity, reflected_k=reflected_k, distance_m=near.distance_m[at])

    @property
    def mirrors(self) -> bool:
        """Whether it reflects more than it emits, as bare metals do."""
        return self.emissivity < MIRRORS


@dataclass(frozen=True)
class Parts:
    """What regions make of an image.

    Args:
        number: [H, W] int64, place of each pixel's region in the table; -1 outside of all.
        celsius: [H, W] float64 temperatures in the regions; NaN elsewhere, and where no surface could send so little.
        unsure: by input ("emissivity", "reflected_k") [H, W] float64, the standard uncertainty that it leaves in K.
        edge: [H, W] bool, pixels beside another region, or the outside, with which they would have another temperature by more
            than ``EDGE_C``: depths do not tell edges to the pixel, and a pixel there shows both.
    """

    number: Tensor
    celsius: Tensor
    unsure: dict[str, Tensor]
    edge: Tensor


def read_regions(path: Path) -> list[Region]:
    """The regions of a table.

    **Convention:** the corners x1, y1, z1 and x2, y2, z2 are any two opposite ones, in the coordinates and units of the data
    set, as those of ``box`` of src/export.py are. The viewer's table of boxes has them; a column emissivity makes it one of
    regions, and what else it has is not looked at. Separators and decimal commas are those of ``read_table``.

    Args:
        path: CSV with the columns name, x1 ... z2 and emissivity, and reflected_c (°C) where there is another one than that of
            the conditions; its cells may be empty.

    Raises:
        SceneError: there is no such table, or a row is no region; file, line and remedy are named.
    """
    table = read_table(path, comments=False)  # a region may be called #1
    _check_columns(path, table.columns)
    if not table.rows:
        raise SceneError(f"{path} has no region: below the names of columns it needs a line for each box")
    found: list[Region] = []
    for line, cells in table.rows:
        row = dict(zip(table.columns, map(table.pointed, cells), strict=False))
        row["name"] = cells[table.columns.index("name")]
        region = _region(row, f"{path}, line {line}")
        for other in found:
            if other.name == region.name:
                raise SceneError(
                    f"{path}, line {line}: there is a region '{region.name}' already; give each its own name"
                )
            if torch.equal(other.low, region.low) and torch.equal(other.high, region.high):
                raise SceneError(
                    f"{path}, line {line}: '{region.name}' is the same box as '{other.name}'; delete one of the lines"
                )
        found.append(region)
    return found


def _check_columns(path: Path, columns: Sequence[str]) -> None:
    """Raises SceneError where columns are missing, not known, or there twice."""
    known = (*NEEDED, REFLECTED)
    if twice := next((one for one in columns if columns.count(one) > 1), None):
        raise SceneError(f"{path} has two columns '{twice}'; delete or rename one")
    missing = [one for one in NEEDED if one not in columns]
    others = [one for one in columns if one not in known and not VIEWERS.fullmatch(one)]
    if not missing and not others:
        return
    told = f"needed are {', '.join(NEEDED)} (two opposite corners of a box), and {REFLECTED} may be there"
    if missing:
        alike = "".join(_meant(one, missing) for one in others)
        raise SceneError(f"{path} has no column {' and no '.join(missing)}{alike}; {told}")
    raise SceneError(
        f"{path}: the column {shortened(others[0])} means nothing here{_meant(others[0], known)}; {told}. Rename or delete it"
    )


def _meant(column: str, names: Sequence[str]) -> str:
    alike = difflib.get_close_matches(column.strip().lower(), names, n=1)
    return f" (is '{column}' meant to be {alike[0]}?)" if alike else ""


def _region(row: dict[str, str], where: str) -> Region:
    """The region of a row. Raises SceneError, naming ``where``, for what is none."""
    name = row["name"]
    if not name:
        raise SceneError(f"{where}: the region has no name; give it one, by which the report calls it")
    where = f"{where}, '{name}'"
    if not any(row[key] for key in CORNERS):
        raise SceneError(
            f"{where} has no corners: the viewer gives them to boxes that show a surface, and to no lines; delete the line"
        )
    places = []
    for key in CORNERS:
        place = finite(row[key], f"{where}: {key}", "a coordinate")
        if abs(place) > FARTHEST:
            raise SceneError(f"{where}: {key} is {place:g}, a coordinate of the scene is needed")
        places.append(place)
    low, high = torch.tensor(places, dtype=torch.float64).reshape(2, 3).sort(dim=0).values
    if not bool((low < high).all()):
        flat = [axis for axis, less in zip("xyz", (low < high).tolist(), strict=True) if not less]
        raise SceneError(
            f"{where}: both corners have the same {' and '.join(flat)}, and a box without volume holds no surface; make it "
            "larger than the object to all sides"
        )
    emissivity = finite(row["emissivity"], f"{where}: emissivity", "a number above 0 and up to 1")
    least, most = LIMITS["emissivity"]
    if not least <= emissivity <= most:
        percent = f"; if per cent are meant, {emissivity / 100:g}" if 1 < emissivity <= 100 else ""
        raise SceneError(f"{where}: emissivity is {emissivity:g}, it must lie between {least:g} and {most:g}{percent}")
    reflected = None
    if row.get(REFLECTED):
        reflected = finite(row[REFLECTED], f"{where}: {REFLECTED}", "a temperature in °C")
        least, most = (limit - KELVIN_AT_0_C for limit in LIMITS["reflected_k"])
        if not least <= reflected <= most:
            raise SceneError(f"{where}: {REFLECTED} is {reflected:g}, it must lie between {least:g} and {most:g} °C")
    return Region(name, low, high, emissivity, reflected)


def region_of(regions: Sequence[Region], places: Tensor) -> Tensor:
    """Which region places [..., 3] in the coordinates of the data set lie in: its place in the table, -1 outside of all, int64.

    Where boxes overlap the smallest one counts, of equally large ones the first. What is not finite lies in none.
    """
    found = torch.full(places.shape[:-1], -1)
    for i in sorted(range(len(regions)), key=lambda i: (-regions[i].volume, -i)):
        found[((places >= regions[i].low) & (places <= regions[i].high)).all(-1)] = i
    return found


def _beside(mask: Tensor) -> Tensor:
    """Pixels of a mask [H, W] and their neighbours."""
    return max_pool2d(mask[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0


@dataclass
class Tally:
    """What became of a region, image by image.

    Args:
        pixels: of all images that show it and have a temperature there.
        images: that have such a pixel.
        lost: pixels that have no temperature any more.
        edge: others that are left out because they lie at an edge.
        kept: pixels that have one without and with the region; the sums are over them.
        before, after: sums of °C.
        unsure: sums of standard uncertainties in K.
    """

    pixels: int = 0
    images: int = 0
    lost: int = 0
    edge: int = 0
    kept: int = 0
    before: float = 0.0
    after: float = 0.0
    unsure: dict[str, float] = field(default_factory=lambda: {"emissivity": 0.0, "reflected_k": 0.0})

    def mean(self, of: float) -> float:
        """Of a sum; NaN where nothing was added."""
        return of / self.kept if self.kept else float("nan")


@dataclass(frozen=True)
class Shown:
    """An image of the report: its camera, its parts, and °C [H, W] without and with regions."""

    camera: Camera
    parts: Parts
    before: Tensor
    after: Tensor


class Regions:
    """The regions of a scene, and what they did to its images.

    Args:
        regions: of the table.
        uncertain: standard uncertainties of their emissivities and of what they reflect.
        origin: [3] float64, where the world counts from in the coordinates of the data set.
    """

    def __init__(self, regions: Sequence[Region], uncertain: InputUncertainty, origin: Tensor) -> None:
        self.regions, self.uncertain, self.origin = regions, uncertain, origin
        self.tallies = [Tally() for _ in regions]
        self.edge = 0  # pixels outside of all regions that are left out beside them
        self.assumed = False
        self._shown: tuple[float, Shown] | None = None

    def parts(
        self,
        camera: Camera,
        depth: Tensor,
        signal: Tensor,
        response: Response,
        near: Conditions,
        cosine: Tensor,
        index: float | None,
        alike: Tensor,
    ) -> Parts:
        """What an image is in the regions.

        Args:
            camera, depth: of the image; camera z [H, W] in world units, infinite where there is no surface.
            signal: [H, W] of the camera, NaN where it is unknown.
            response: of the thermal camera.
            near: conditions of all pixels, with the distance [H, W] of each.
            cosine: [H, W] of the angle between line of sight and normal.
            index: refractive index, by which emissivities fall with the angle but for those of regions that mirror; None for no
                angle.
            alike: [H, W] °C of pixels outside of all regions.
        """
        places = to_world(rays(camera) * depth.double()[..., None], camera.viewmat) + self.origin
        found = region_of(self.regions, places)
        celsius = torch.full(found.shape, torch.nan, dtype=torch.float64)
        unsure = {name: celsius.clone() for name in ("emissivity", "reflected_k")}
        standard = {"emissivity": self.uncertain.emissivity, "reflected_k": self.uncertain.reflected_c}
        beside = _beside(found < 0)
        known = alike.nan_to_num(-KELVIN_AT_0_C)
        low, high = known.where(beside, torch.inf), known.where(beside, -torch.inf)
        for i, region in enumerate(self.regions):
            inside = found == i
            if not inside.any():
                continue
            beside = _beside(inside)
            own = region.conditions(near, beside, cosine, index)
            there = surface_temperature(signal[beside], response, own) - KELVIN_AT_0_C
            there = there.where(there > COLDEST_C, torch.nan)
            celsius[inside] = there[inside[beside]]
            known = there.nan_to_num(-KELVIN_AT_0_C)
            low[beside], high[beside] = torch.minimum(low[beside], known), torch.maximum(high[beside], known)
            left = uncertainty(signal[inside], response, region.conditions(near, inside, cosine, index), standard)
            for name, values in unsure.items():
                values[inside] = left[name].where(celsius[inside].isfinite(), torch.nan)
        return Parts(found, celsius, unsure, edge=high - low > EDGE_C)

    def add(self, camera: Camera, parts: Parts, before: Tensor, after: Tensor, known: Tensor, assumed: bool) -> None:
        """Counts an image.

        Args:
            camera: of the image.
            parts: of it.
            before, after: [H, W] °C without and with regions.
            known: [H, W] bool, pixels of which the image has a temperature.
            assumed: whether nothing says what its surfaces reflect.
        """
        self.edge += int((known & parts.edge & (parts.number < 0) & before.isfinite()).sum())
        sizes = []
        for i, tally in enumerate(self.tallies):
            here = (parts.number == i) & known
            sizes.append(int(here.sum()))
            if not sizes[-1]:
                continue
            kept = here & before.isfinite() & after.isfinite()
            tally.pixels += sizes[-1]
            tally.images += 1
            impossible = here & parts.celsius.isnan()
            tally.lost += int(impossible.sum())
            tally.edge += int((here & parts.edge & ~impossible).sum())
            tally.kept += int(kept.sum())
            tally.before += float(before[kept].sum())
            tally.after += float(after[kept].sum())
            for name, values in parts.unsure.items():
                tally.unsure[name] += float(values[kept].sum())
            region = self.regions[i]
            self.assumed |= assumed and region.reflected_c is None and region.emissivity < 1
        worth = float(np.log1p(sizes).sum())  # of each region something
        if worth > 0 and (self._shown is None or worth > self._shown[0]):
            self._shown = worth, Shown(camera, parts, before, after)

    def section(self, conditions: Conditions, index: float | None, points: Tensor, picture: str) -> Section:
        """Of the report.

        Args:
            conditions: of what lies in no region.
            index: refractive index, or None.
            points: [P, 3] of the scene in its world, which tell where it lies.
            picture: name of that of ``picture``.
        """
        reflected_c = float(conditions.reflected_k) - KELVIN_AT_0_C
        u = self.uncertain
        head = ["region", "emissivity", "reflected °C", "pixels", "images", "before °C", "after °C"]
        head += [f"emissivity ± {u.emissivity:g}", f"reflected ± {u.reflected_c:g} °C", "no temperature", "at edges"]
        rows, values = [], {}
        for region, tally in zip(self.regions, self.tallies, strict=True):
            own_c = reflected_c if region.reflected_c is None else region.reflected_c
            before, after = tally.mean(tally.before), tally.mean(tally.after)
            unsure = {name: tally.mean(sum_) for name, sum_ in tally.unsure.items()}
            rows.append(
                [plain(region.name), f"{region.emissivity:g}", f"{own_c:.1f}", f"{tally.pixels:,}", tally.images]
                + [number(before, 2), number(after, 2)]
                + [f"± {number(unsure[name], 2)}" if tally.kept else NONE for name in unsure]
                + [f"{tally.lost:,}", f"{tally.edge:,}"]
            )
            values[region.name] = {
                "pixels": tally.pixels, "images": tally.images, "lost": tally.lost, "edge": tally.edge,
                "before_c": before, "after_c": after,
                "emissivity_c": unsure["emissivity"], "reflected_c": unsure["reflected_k"],
            }  # fmt: skip
        lines = [
            "A pixel has the emissivity of the smallest box that its surface lies in; all others keep "
            f"{float(conditions.emissivity):g} (reflected {reflected_c:.1f} °C). Means over the pixels of a region: before, "
            "as if it were like all others; after, with its own emissivity; and the uncertainty in °C that remains where the "
            "emissivity or the reflected temperature is uncertain by so much. Pixels at edges, which would differ by more than "
            f"{EDGE_C:g} °C if they lay on the other side, are left out (NaN): of those that lie in no region {self.edge:,}.",
            "",
            *markdown_table(head, rows, "lrrrrrrrrrr"),
        ]
        mirrors = [plain(region.name) for region in self.regions if region.mirrors]
        if index is not None and mirrors:
            lines += [
                "",
                f"The angle counts for dielectrics alone; below {MIRRORS:g} the emissivity stays the same at every angle: "
                f"{', '.join(mirrors)}.",
            ]
        if self._shown is not None:
            lines += ["", f"![regions, and temperatures before and after]({picture})"]
        return Section("Parts of other emissivity", lines, {"regions": values}, self._findings(reflected_c, points))

    def _findings(self, reflected_c: float, points: Tensor) -> list[str]:
        found = []
        if self.assumed:
            found.append(
                f"Nothing says what the surfaces of the regions reflect, so {reflected_c:.0f} °C are assumed: give "
                f"conditions.reflected_c, or a column {REFLECTED}."
            )
        for region, tally in zip(self.regions, self.tallies, strict=True):
            name = plain(region.name)
            if region.reflected_c is not None and region.reflected_c > HOT_C:
                kelvin = region.reflected_c
                found.append(
                    f"{REFLECTED} of '{name}', {kelvin:g}, is in °C; if it was meant in kelvin, give "
                    f"{kelvin - KELVIN_AT_0_C:.4g}."
                )
            if not tally.pixels:
                ends = quantile(points.double(), torch.tensor([0.01, 0.99], dtype=torch.float64)) + self.origin
                found.append(
                    f"The region '{name}' has no pixel: no image has a temperature of a surface between {_place(region.low)} and "
                    f"{_place(region.high)} that lies in no smaller box. The scene's points lie between {_place(ends[0])} and "
                    f"{_place(ends[1])}; check its corners, or make it larger."
                )
                continue
            if region.mirrors:
                own_c = reflected_c if region.reflected_c is None else region.reflected_c
                by_emissivity, by_reflected = (number(tally.mean(sum_), 1) for sum_ in tally.unsure.values())
                found.append(
                    f"Most of what '{name}' sends is reflected (emissivity {region.emissivity:g}): an emissivity that is off by "
                    f"{self.uncertain.emissivity:g} leaves {by_emissivity} °C, and a reflected temperature off by "
                    f"{self.uncertain.reflected_c:g} °C leaves {by_reflected} °C. Measure what it reflects ({own_c:.1f} °C "
                    "here), or put matt tape on it and give that a box of its own."
                )
            if tally.edge > 0.5 * tally.pixels:
                found.append(
                    f"{tally.edge:,} of the {tally.pixels:,} pixels of '{name}' are left out because they lie at its edges: "
                    "images show it too small, or its box only touches the surface; make it larger where nothing else is near."
                )
            if tally.lost:
                found.append(
                    f"{tally.lost:,} of the {tally.pixels:,} pixels of '{name}' have no temperature, and are left out (NaN): at "
                    f"emissivity {region.emissivity:g} they would reflect all that was measured of them, or more. Its emissivity "
                    "is higher, what it reflects is colder, or the box holds something else, too."
                )
        return found

    def picture(self) -> np.ndarray | None:
        """The image that shows most regions: their pixels, boxes and names, and its temperatures before and after; None where no
        image shows any."""
        if self._shown is None:
            return None
        shown = self._shown[1]
        height, width = shown.before.shape
        factor = max(1, round(min(PANEL_HEIGHT / height, WIDEST_PANEL / width)))
        known = torch.cat([values[values.isfinite()] for values in (shown.before, shown.after)])
        bounds = quantile(known.double(), torch.tensor([0.01, 0.99], dtype=torch.float64))
        low, high = map(float, bounds) if len(known) else (0.0, 1.0)
        bar = Bar(low, high, "°C")
        change = (shown.after - shown.before).where(shown.parts.number >= 0, 0.0)
        sizes = change[(shown.parts.number >= 0) & change.isfinite()].abs()
        most = max(float(quantile(sizes, 0.99)), 1e-3) if len(sizes) else 1.0
        changes = Bar(-most, most, "°C", ERROR)

        def outlined(values: Tensor, colours: Bar, line: tuple[int, int, int]) -> np.ndarray:
            image = enlarged(colorize(values, colours.low, colours.high, colours.colormap), factor)
            return self._outlines(image, shown.parts.number.numpy(), factor, line)

        panels = [
            Panel(outlined(shown.before, bar, WHITE), "before: one emissivity", bar.of(shown.before.numpy())),
            Panel(outlined(shown.after, bar, WHITE), "after: each region's own", bar.of(shown.after.numpy())),
            Panel(outlined(change, changes, INK), "change", changes),
            Panel(self._named(shown, low, high, factor), "regions and their boxes"),
        ]
        return compose(panels, columns=2)

    def _colour(self, i: int) -> np.ndarray:
        """Of a region: one of ten, RGB."""
        return lut("tab10")[i % 10]

    def _outlines(self, image: np.ndarray, parts: np.ndarray, factor: int, colour: tuple[int, int, int]) -> np.ndarray:
        """An image that was enlarged by a factor, with the outlines of the pixels of each region."""
        image = np.ascontiguousarray(image)
        for i in range(len(self.regions)):
            mask = np.repeat(np.repeat((parts == i).astype(np.uint8), factor, axis=0), factor, axis=1)
            lines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, lines, -1, colour, 1)
        return image

    def _named(self, shown: Shown, low: float, high: float, factor: int) -> np.ndarray:
        """The image in greys, with regions in their colours, edges of their boxes, and their names."""
        parts = shown.parts.number.numpy()
        image = colorize(shown.before, low, high, "gray").astype(np.float64)
        for i in range(len(self.regions)):
            image[parts == i] = 0.45 * image[parts == i] + 0.55 * self._colour(i)
        page = Image.fromarray(enlarged(image.round().astype(np.uint8), factor))
        draw = ImageDraw.Draw(page)
        for i, region in enumerate(self.regions):
            colour = tuple(int(part) for part in self._colour(i))
            for edge in _edges(region, shown.camera, self.origin):
                places = [tuple(place) for place in (edge * factor).tolist()]
                draw.line(places, fill=INK, width=3)
                draw.line(places, fill=colour, width=1)
        for i, region in enumerate(self.regions):
            if (place := _middle(parts == i)) is not None:
                lettering(draw, (factor * (place[0] + 0.5), factor * (place[1] + 0.5)), region.name, within=page.width)
        return np.asarray(page)


def _edges(region: Region, camera: Camera, origin: Tensor) -> list[np.ndarray]:
    """Places (column, row) [n, 2] along those parts of the twelve edges of a box that lie before a camera."""
    ends = torch.stack([region.low, region.high]) - origin
    share = torch.linspace(0.0, 1.0, EDGE_POINTS, dtype=torch.float64)
    found = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for one, other in ((0, 0), (0, 1), (1, 0), (1, 1)):
            line = torch.empty(EDGE_POINTS, 3, dtype=torch.float64)
            line[:, axis] = torch.lerp(ends[0, axis], ends[1, axis], share)
            line[:, others[0]], line[:, others[1]] = ends[one, others[0]], ends[other, others[1]]
            local = to_camera(line, camera.viewmat)
            local = local[local[:, 2] > 1e-3 * local.norm(dim=1)]
            if len(local) > 1:
                found.append(to_pixels(local, camera.K).clamp(-1e5, 1e5).numpy())
    return found


def _middle(mask: np.ndarray) -> tuple[float, float] | None:
    """Column and row of a place well inside the largest connected part of a mask [H, W]; None of an empty one."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return None
    largest = labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()
    inward = cv2.distanceTransform(np.pad(largest.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    places = np.argwhere(inward > 0.99 * inward.max())
    row, column = places[((places - places.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    return float(column), float(row)


def _place(corner: Tensor) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in corner.tolist())}]"
