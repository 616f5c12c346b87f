"""The frames of a folder that a camera filled: which files are thermal, what they mean, which photos belong to them."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from heatsplat.contracts import SceneError, check_count, check_option, counted, evenly_spread
from heatsplat.datamodules.bounds import spans_told, union
from heatsplat.datamodules.formats import dji, flir
from heatsplat.datamodules.formats.geodesy import east_north_up
from heatsplat.datamodules.formats.images import (
    PSEUDO_COLOUR_LEVELS,
    SUFFIXES,
    colour_levels,
    pages_of,
    read_bytes,
    read_image,
    resized,
    shown_files,
    to_grey,
)
from heatsplat.datamodules.formats.palette import palette_of
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader
from heatsplat.datamodules.formats.temperature_table import MIN_SIDE, read_temperature_table
from heatsplat.datamodules.formats.temperature_table import SUFFIX as TABLE
from heatsplat.datamodules.timestamps import dji_time, instant, zone_of
from heatsplat.io.files import by_numbers
from heatsplat.preparation.devices import devices_of, listed
from heatsplat.preparation.frame import ColouredFrame, ThermalFrame, frame_name
from heatsplat.preparation.makers import RECORDS, exif_details, radiometric_frames
from heatsplat.preparation.meaning import Meaning
from heatsplat.preparation.sharpness import sharpest
from heatsplat.preparation.table import spans_of, tells_spans, with_table

log = logging.getLogger(__name__)

# What makers and people put into names to tell the modalities of one exposure apart.
MODALITY = re.compile(r"[_\-. ](T|V|W|Z|S|IR|R|RGB|VIS|thermal|visible|visual|photo)$", re.IGNORECASE)
DJI_CLOCK = re.compile(r"DJI_(\d{14})_(?=\d+)")
SAME_EXPOSURE_S = 5.0  # by which the clocks in the names of one exposure's files may differ
# A fix farther from the middle of all than so many times the median distance, and than so many metres, is of another place.
ASTRAY, ASTRAY_M = 20.0, 1000.0
# A picture of temperatures: levels of these explain 0.99 of it, of photos 0.2 to 0.9 (a house against the sky).
PREVIEW, LEVELS, LOOKED_AT = 0.95, 64, 3
KINDS = {
    "radiometric": "radiometric files",
    "float": "floating-point images",
    "counts": "16-bit images",
    "grey": "8-bit greys",
}
FULL = {"grey": 255, "counts": 65535}  # the number of white


@dataclass(frozen=True)
class Reading:
    """How a folder is read.

    Args:
        meaning: of numbers without a calibration.
        zone: of times that have none, such as Europe/Berlin or +02:00; None leaves them as they are.
        table: file with a row for each frame, or None.
        columns: its columns: name, time, latitude_deg, longitude_deg, altitude_m, above_takeoff_m, yaw_deg, pitch_deg, roll_deg,
            and min_c and max_c, the °C of black and white of each of greys or pictures in colours.
        every: of each camera every so many-th frame is taken, the first one included.
        sharpest: of each camera the sharpest of each ``every`` frames in a row is taken instead.
        palette: of pictures in false colours, by name or file (``palette_of``), which makes greys of them; None for none.
        palette_hot: side at which the picture of a colour bar in ``palette`` is hottest; None for top or right.

    Raises:
        SceneError: ``every`` is no whole number from 1 on, or 1 where the sharpest is to be taken.
    """

    meaning: Meaning = field(default_factory=Meaning)
    zone: str | None = None
    table: Path | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    every: int = 1
    sharpest: bool = False
    palette: str | None = None
    palette_hot: str | None = None

    def __post_init__(self) -> None:
        if self.palette is None and self.palette_hot is not None:
            raise SceneError(f"palette_hot={self.palette_hot} says how a colour bar lies; give it as palette")
        check_count("every", self.every)
        check_option("sharpest", self.sharpest, (True, False), SceneError)
        if self.sharpest and self.every == 1:
            raise SceneError(
                "sharpest=true changes nothing with every=1: give every=15, say, for the sharpest of each 15 frames"
            )


def reading_of(
    *,
    counts: Mapping[str, Any] | None = None,
    bounds_c: Sequence[float] | None = None,
    band_um: Sequence[float] = Meaning.band_um,
    zone: str | None = None,
    table: str | None = None,
    table_columns: Mapping[str, str] | None = None,
    every: int = 1,
    sharpest: bool = False,
    palette: str | None = None,
    palette_hot: str | None = None,
) -> Reading:
    """How a folder is read, from settings of a command: ``counts``, ``bounds_c`` and ``band_um`` are of ``Meaning``."""
    meaning = Meaning(**(counts or {}), bounds_c=bounds_c, band_um=band_um)
    place = Path(table).expanduser() if table else None
    return Reading(meaning, zone, place, table_columns or {}, every, sharpest, palette, palette_hot)


@dataclass(frozen=True)
class Recording:
    """The frames of a folder, in the order of their times, else of their names, and what was noticed on the way."""

    frames: list[ThermalFrame]
    notes: list[str]


def read_recording(folder: Path, reading: Reading | None = None) -> Recording:
    """The thermal frames of all files in a folder and below.

    Raises:
        SceneError: the folder holds none, several kinds of them, or a file that cannot be read or understood.
    """
    reading = reading or Reading()
    if reading.zone is not None:
        zone_of(reading.zone, "zone")
    if not folder.is_dir():
        raise SceneError(f"source={folder} is no folder")
    spanned = reading.table is not None and tells_spans(reading.table, reading.columns)
    greys_known = spanned or reading.meaning.of_greys(folder)[0] is not None
    kinds, tables = _kinds_in(folder, greys_known, reading.palette)
    kind = next(kind for kind in KINDS if kinds.get(kind))
    reading.meaning.check_use(kind, KINDS[kind])
    if spanned and kind == "grey" and reading.meaning.bounds_c is not None:
        raise SceneError(
            f"bounds_c is one span for all images, and table={reading.table} has one for each: leave bounds_c out, or take the "
            "columns out of the table"
        )
    notes: list[str] = []
    frames = _frames_of(kind, kinds[kind], folder, reading, notes, tables)
    if spanned and (kind == "grey" or (kind == "counts" and not reading.meaning.says_counts(frames[0].load()))):
        frames = _with_spans(frames, kind, reading, notes)
    elif kind != "radiometric":
        frames = _with_calibrations(kind, frames, folder, reading.meaning, notes)
    photos = [*kinds.get("colour", []), *(kinds["grey"] if kind != "grey" and "grey" in kinds else [])]
    frames = _paired(frames, _without_previews(frames, photos, notes))
    if reading.table is not None:
        frames = with_table(frames, reading.table, reading.columns, notes)
    frames = _without_fixes_of_earlier_places([_zoned(frame, reading.zone) for frame in frames], notes)
    _check_names(frames)
    frames = _in_order(frames, notes)
    if reading.sharpest:
        kept, gained = sharpest(frames, reading.every)
        notes.append(
            f"every={reading.every} sharpest=true takes {len(kept)} of {counted(len(frames), 'frame')}, the sharpest of each "
            f"{reading.every}: {gained}"
        )
        frames = kept
    elif reading.every > 1:
        taken = {frame.name for device in devices_of(frames) for frame in device.frames[:: reading.every]}
        notes.append(f"every={reading.every} takes {len(taken)} of {counted(len(frames), 'frame')}")
        frames = [frame for frame in frames if frame.name in taken]
    return Recording(frames, notes)


def _kinds_in(
    folder: Path, greys_known: bool, palette: str | None
) -> tuple[dict[str, list[Path]], dict[Path, tuple[int, int]]]:
    """The images in a folder and below by their kind (``_kind``), one of ``KINDS`` beside greys; and width and height of those
    that are text, which is slow to read, and is read here anyway.

    Args:
        greys_known: whether it is known which temperatures greys are, as which sealed pictures may then be taken.
        palette: with which pictures in colours are greys, None without; a file of that name is none of the images.

    Raises:
        SceneError: there is no thermal image, there are several kinds, or one cannot be read; or with a palette there are no
            pictures in colours, or it is not known which temperatures greys are.
    """
    kinds: dict[str, list[Path]] = {}
    tables: dict[Path, tuple[int, int]] = {}
    found = [path for path in shown_files(folder, (*SUFFIXES, *RECORDS, TABLE)) if path.is_file()]
    if palette is not None:
        own = [place.absolute() / palette for place in (folder, Path())]
        found = [path for path in found if path.absolute() not in own]
    for path in sorted(found, key=lambda p: by_numbers(p.relative_to(folder).as_posix())):
        if path.suffix.lower() == TABLE:
            if (pixels := read_temperature_table(path)) is None:
                continue
            kind, tables[path] = "float", (pixels.shape[1], pixels.shape[0])
        else:
            kind = _kind(path)
        if kind == "sealed" and not greys_known:
            raise SceneError(
                f"{path} is a thermal picture of DJI whose temperatures cannot be read: its sensor values are counts, or not "
                f"there (if it was cut short, copy it again); {dji.CONVERT}. bounds_c=[min,max] takes the pictures as greys "
                "between these °C"
            )
        kinds.setdefault("colour" if kind == "sealed" else kind, []).append(path)
    if palette is not None:
        kinds = _greys_of_palette(kinds, folder, greys_known, palette)
    elif "grey" not in kinds and not kinds.keys() & {"radiometric", "float", "counts"}:
        kinds = _greys_in_colour(kinds, folder)
    there = [kind for kind in KINDS if kinds.get(kind)]
    if len([kind for kind in there if kind != "grey"]) > 1:
        raise SceneError(
            f"{folder} holds several kinds of thermal images: "
            f"{', '.join(f'{KINDS[k]} ({len(kinds[k])}, such as {kinds[k][0].name})' for k in there)}. Put each kind into a "
            "folder of its own and prepare those"
        )
    if not there:
        raise SceneError(
            f"{folder} holds no thermal image: radiometric JPEG of FLIR or DJI, .fff, .seq, .csq, TIFF or PNG with counts or °C, "
            f"tables of °C (.csv), or greys{_no_tables(sorted(found))}"
        )
    return kinds, tables


def _in_order(frames: list[ThermalFrame], notes: list[str]) -> list[ThermalFrame]:
    """Frames in the order of their times; as they are where one has none, which the notes say then."""
    timeless = sum(frame.time is None for frame in frames)
    if timeless:
        notes.append(
            f"{timeless} of {len(frames)} frames have no time, so all are in the order of their names (table=... adds times)"
        )
        return frames
    _check_zones(frames)
    return sorted(
        frames, key=lambda frame: instant(frame.time)
    )  # those of one second stay in the order of their numbers


def _no_tables(found: Iterable[Path]) -> str:
    """What is said of text files of which none is the table of an image; empty where there are none."""
    tables = [path for path in found if path.suffix.lower() == TABLE]
    if not tables:
        return ""
    what = "is no table of pixels" if tables[0].read_bytes().strip() else "is empty, export it again"
    return f". None of its .csv has {MIN_SIDE} rows of {MIN_SIDE} numbers or more: {tables[0].name} {what}"


def _kind(path: Path) -> str:
    """ "radiometric", "float", "counts", "grey", "colour", or "sealed": a thermal picture whose numbers only its maker's
    software converts. Raises SceneError for what is no image."""
    if path.suffix.lower() in RECORDS:
        return "radiometric"
    if path.suffix.lower() in (".jpg", ".jpeg"):
        data = read_bytes(path)
        array = dji.array_of(data)
        if flir.payload_of(data) or (array is not None and dji.holds_temperatures(array)):
            return "radiometric"
        if array is not None or dji.is_thermal(data):
            return "sealed"
    mode, _ = _mode_and_size(path)
    if mode.startswith("I"):
        return "counts"
    return "float" if mode == "F" else "grey" if mode in ("L", "LA", "1") else "colour"


def _mode_and_size(path: Path) -> tuple[str, tuple[int, int]]:
    """Pillow's mode of an image and its (width, height). Raises SceneError for what is no image."""
    try:
        with Image.open(path) as image:
            return image.mode, image.size
    except PermissionError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error
    except UnidentifiedImageError:  # such as TIFF of 64 bits, which Pillow does not know
        pixels = read_image(path, 0)
        if pixels.ndim == 3 and pixels.dtype.kind == "f":
            raise SceneError(
                f"image {path} has {pixels.shape[2]} channels of floats, and temperatures are one; export them alone"
            ) from None
        return "F" if pixels.dtype.kind == "f" else "I", (pixels.shape[1], pixels.shape[0])
    except Exception as error:  # Pillow raises whatever a damaged file leads to
        raise SceneError(f"image {path} is corrupt or no image; copy it again or remove it ({error})") from error


def _greys_in_colour(kinds: dict[str, list[Path]], folder: Path) -> dict[str, list[Path]]:
    """Greys that were stored as colours count as greys, those of 16 bits as counts.

    Raises:
        SceneError: the pictures are pseudo-colours or photos.
    """
    colour = kinds.get("colour", [])
    few = [read_image(path, 0)[..., :3] for path in colour[:3]]
    if few and all(colour_levels(pixels) < PSEUDO_COLOUR_LEVELS for pixels in few):
        return {"counts" if few[0].dtype == np.uint16 else "grey": colour}
    if colour:
        raise SceneError(
            f"{folder} holds coloured pictures alone (such as {colour[0].name}): colours of a palette are no temperatures. "
            "Export radiometric files, 16-bit counts, temperatures as TIFF, or greys with known bounds; or name the palette and "
            "what its ends are: palette=iron bounds_c=[min,max]. Photos are not prepared: with a COLMAP model beside their "
            "folder they train by data=colmap data.images=null data.rgb=FOLDER"
        )
    return kinds


def _greys_of_palette(
    kinds: Mapping[str, list[Path]], folder: Path, greys_known: bool, palette: str
) -> dict[str, list[Path]]:
    """Pictures in colours as greys. Raises SceneError where there are none, or other thermal images, or no bounds."""
    if other := next((kind for kind in KINDS if kinds.get(kind)), None):
        raise SceneError(
            f"palette={palette} is for pictures in false colours, and {folder} holds {KINDS[other]} (such as "
            f"{kinds[other][0].name}): leave it out, or prepare pictures in colours from a folder of their own"
        )
    if kinds.get("colour") and not greys_known:
        raise SceneError(
            f"palette={palette} tells levels from the colours of {kinds['colour'][0].name} and others; say which temperatures "
            "the ends of the scale are: bounds_c=[min,max] in °C, or of each picture by a table with the columns file, min_c and "
            "max_c (table=spans.csv)"
        )
    return {"grey": kinds["colour"]} if kinds.get("colour") else dict(kinds)


def _frames_of(
    kind: str,
    paths: list[Path],
    folder: Path,
    reading: Reading,
    notes: list[str],
    tables: Mapping[Path, tuple[int, int]],
) -> list[ThermalFrame]:
    """The frames in files of a kind; what numbers without a calibration mean is not settled yet."""
    if kind == "radiometric":
        return [frame for path in paths for frame in radiometric_frames(path, folder, reading.meaning, notes)]
    found = []
    reader = None
    if reading.palette is not None:
        reader = PaletteReader(palette_of(reading.palette, reading.palette_hot, folder, "palette"))
        notes.append(f"levels by the palette {reader.note()}")
    for path in paths:
        if path.suffix.lower() == TABLE:
            load = partial(read_temperature_table, path)
            found.append(ThermalFrame(frame_name(path, folder), path, 0, load, size=tables[path]))
            continue
        details, camera = exif_details(path)  # of the file: a TIFF may be a recording that memory cannot hold
        _, size = _mode_and_size(path)
        pages = pages_of(path)
        if several := len(pages) > 1:
            details = {}  # a file has one time and one place, of whichever of its images
            notes.append(f"{path.name}: {len(pages)} images in one file, each is a frame")
        for number, page in enumerate(pages):
            name = frame_name(path, folder, number if several else None)
            about = {"camera": camera, "size": size, **details}
            if reader is not None:
                colours = tuple(
                    np.column_stack([reader.palette.colours, reader.palette.levels]).ravel().round(3).tolist()
                )
                load = partial(_levels, path, page if several else None, reader)
                found.append(ColouredFrame(name, path, number, load, palette=colours, **about))
                continue
            load = partial(read_image if kind == "float" else _grey, path, page if several else None)
            found.append(ThermalFrame(name, path, number, load, **about))
    if reader is not None:
        found[0].load()
        if doubt := reader.doubt():
            notes.append(doubt)
            log.warning("%s", doubt)
    return found


def _with_spans(frames: Sequence[ThermalFrame], kind: str, reading: Reading, notes: list[str]) -> list[ThermalFrame]:
    """Greys, or levels of colours, by the span that a table has of each of them."""
    spans, full = spans_of(frames, reading.table, reading.columns), FULL[kind]
    whole = union(spans.values())
    told = spans_told(spans.values())
    notes.append(f"greys of {whole.min_c:g} .. {whole.max_c:g} °C by {reading.table.name}: {told}")
    return [
        replace(
            frame,
            span=(span := spans[frame.name]),
            calibration=reading.meaning.of_temperatures(span.span_k / full, span.min_c),
        )
        for frame in frames
    ]


def _with_calibrations(
    kind: str, frames: Sequence[ThermalFrame], folder: Path, meaning: Meaning, notes: list[str]
) -> list[ThermalFrame]:
    """The frames with what the numbers in each file mean, by the first frame of its camera."""
    devices, calibrations = devices_of(frames), {}
    for device in devices:
        sample = device.frames[0]
        try:
            if kind == "grey":
                calibration, note = meaning.of_greys(folder)
            elif kind == "counts":
                calibration, note = meaning.of_counts(sample.load(), sample.path)
            else:
                calibration, note = meaning.of_floats(sample.load(), sample.path)
        except SceneError as error:
            if len(devices) == 1:
                raise
            raise SceneError(
                f"{error} These are {len(devices)} cameras: {listed(devices)}. Where their numbers mean different things, put "
                "each into a folder of its own and prepare those"
            ) from error
        if note not in notes:
            notes.append(note)
        calibrations |= dict.fromkeys((frame.path for frame in device.frames), calibration)
    return [replace(frame, calibration=calibrations[frame.path]) for frame in frames]


def _grey(path: Path, page: int | None) -> np.ndarray:
    pixels = read_image(path, page)
    return to_grey(pixels[..., :3]) if pixels.ndim == 3 else pixels


def _levels(path: Path, page: int | None, reader: PaletteReader) -> np.ndarray:
    """Levels [H, W] float32 from 0 to 255 of a picture in colours, NaN where its palette tells none."""
    pixels = read_image(path, page)
    found = reader.read(pixels[..., :3] if pixels.ndim == 3 else pixels, None, str(path))
    return np.where(found.known, found.levels, np.float32(np.nan)).astype(np.float32)


def _exposure(path: Path) -> str:
    """What the files of one exposure have in common."""
    stem = path.stem
    while (shorter := MODALITY.sub("", stem)) != stem:
        stem = shorter
    return DJI_CLOCK.sub("DJI_", stem).lower()


def _apart_s(one: Path, other: Path) -> float:
    """Seconds between two exposures by the clocks in DJI's names; 0 where one has none."""
    clocks = [DJI_CLOCK.search(path.stem) for path in (one, other)]
    try:
        first, second = (datetime.strptime(clock[1], "%Y%m%d%H%M%S") for clock in clocks if clock)
    except ValueError:  # no two clocks, or digits that are no time
        return 0.0
    return abs((first - second).total_seconds())


def _paired(frames: Iterable[ThermalFrame], photos: list[Path]) -> list[ThermalFrame]:
    """Frames with the photo of the same exposure: of several that may be, one of the same name, in the same folder.

    Cards count from one in every folder: a photo beside a frame of its exposure is no other frame's. Counters restart within
    a folder, too: names with clocks have to say about the same time.
    """
    frames = list(frames)
    by_exposure: dict[str, list[Path]] = {}
    for photo in photos:
        by_exposure.setdefault(_exposure(photo), []).append(photo)
    beside = {(_exposure(frame.path), frame.path.parent) for frame in frames}

    def photo_of(frame: Path) -> Path | None:
        def unlike(photo: Path) -> tuple[bool, bool, float]:
            return photo.stem.lower() != frame.stem.lower(), photo.parent != frame.parent, _apart_s(photo, frame)

        exposure = _exposure(frame)
        free = (
            p
            for p in by_exposure.get(exposure, [])
            if (p.parent == frame.parent or (exposure, p.parent) not in beside)
            and _apart_s(p, frame) <= SAME_EXPOSURE_S
        )
        return min(free, key=unlike, default=None)

    return [replace(frame, rgb=photo_of(frame.path)) for frame in frames]


def _without_previews(frames: list[ThermalFrame], photos: list[Path], notes: list[str]) -> list[Path]:
    """The photos without pictures of the temperatures themselves, in greys or colours, as programs export them beside files.

    Pictures of one ending and one mark in their names, such as _V, are of one kind: a few that belong to frames tell it.
    """
    kinds: dict[tuple[str, str], list[Path]] = {}
    for photo in photos:
        mark = MODALITY.search(photo.stem)
        kinds.setdefault((photo.suffix.lower(), mark[1].lower() if mark else ""), []).append(photo)
    previews: set[Path] = set()
    for kind in kinds.values():
        pairs = [frame for frame in _paired(frames, kind) if frame.rgb is not None]
        looked = [pairs[i] for i in evenly_spread(len(pairs), LOOKED_AT)]
        if looked and all(_explained(frame) > PREVIEW for frame in looked):
            previews.update(kind)
            notes.append(
                f"{counted(len(kind), 'picture')} such as {kind[0].name} show the temperatures themselves in greys or colours: "
                "they are no photos, and left out"
            )
    return [photo for photo in photos if photo not in previews]


def _explained(frame: ThermalFrame) -> float:
    """Share of what differs in the photo of a frame that its thermal values alone explain; 0 where nothing differs."""
    values, colours = frame.load(), read_image(frame.rgb, 0)
    colours = resized(colours, values.shape[1], values.shape[0]).reshape(*values.shape, -1)[..., :3]
    known = np.isfinite(values)
    order = np.argsort(values[known], kind="stable")
    colours = colours[known][order].astype(np.float32)
    apart = colours.var(0).sum() * len(colours)
    alike = sum(level.var(0).sum() * len(level) for level in np.array_split(colours, LEVELS) if len(level))
    return float(1 - alike / apart) if apart else 0.0


def _zoned(frame: ThermalFrame, zone: str | None) -> ThermalFrame:
    """The frame with a time, of its name where the file has none, in the zone that was given for those without one."""
    time = frame.time
    if time is None and frame.number == 0 and (seconds := dji_time(frame.path.name)) is not None:
        time = datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None)
    if time is not None and time.tzinfo is None and zone is not None:
        time = time.replace(tzinfo=zone_of(zone, "zone"))
    return replace(frame, time=time)


def _without_fixes_of_earlier_places(frames: list[ThermalFrame], notes: list[str]) -> list[ThermalFrame]:
    """The frames, without positions that lie in another place than those of the others: a receiver tells where it was last until
    it knows better."""
    placed = [frame for frame in frames if frame.position is not None]
    if len(placed) < 3:
        return frames
    fixes = np.array([(frame.position.latitude_deg, frame.position.longitude_deg, 0.0) for frame in placed])
    away = np.linalg.norm(east_north_up(fixes, np.median(fixes, axis=0))[:, :2], axis=1)
    far = away > max(ASTRAY * float(np.median(away)), ASTRAY_M)
    if not far.any():
        return frames
    astray = {frame.name for frame, one in zip(placed, far, strict=True) if one}
    notes.append(
        f"GPS of {counted(len(astray), 'frame')}, such as {min(astray)}, lies {away.max() / 1000:.3g} km from that of the "
        "others, as where the receiver was before, and is left out"
    )
    return [replace(frame, position=None) if frame.name in astray else frame for frame in frames]


def _check_zones(frames: Sequence[ThermalFrame]) -> None:
    """Raises SceneError where some times state a zone and others none: hours may lie between the two clocks."""
    without = [frame for frame in frames if frame.time.tzinfo is None]
    if 0 < len(without) < len(frames):
        told = next(frame for frame in frames if frame.time.tzinfo is not None)
        raise SceneError(
            f"the times of {len(without)} of {len(frames)} frames state no zone, such as {without[0].path.name} "
            f"({without[0].time.isoformat(' ')}), and the others do, such as {told.path.name} ({told.time.isoformat(' ')}). Give "
            "the zone that the clock of the former showed, as in zone=Europe/Berlin or zone=UTC"
        )


def _check_names(frames: list[ThermalFrame]) -> None:
    twice = [name for name, count in Counter(frame.name for frame in frames).items() if count > 1]
    if twice:
        first, second = [frame.path for frame in frames if frame.name == twice[0]][:2]
        raise SceneError(f"{first} and {second} would both become {twice[0]}.tiff; rename or remove one of them")
