"""The frames of a folder that a camera filled: which files are thermal, what they mean, which photos belong to them."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from heatsplat.contracts import SceneError
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats import dji, flir
from heatsplat.datamodules.formats.exif import exif_in
from heatsplat.datamodules.formats.images import (
    PSEUDO_COLOUR_LEVELS,
    SUFFIXES,
    colour_levels,
    pages_of,
    read_image,
    to_grey,
)
from heatsplat.datamodules.formats.radiometric import Calibration, read_bytes
from heatsplat.datamodules.side_files import read_table
from heatsplat.datamodules.timestamps import dji_time, instant, zone_of
from heatsplat.physics.radiometry import Conditions, PlanckResponse
from heatsplat.preparation.devices import devices_of, listed
from heatsplat.preparation.frame import Attitude, CameraInfo, Position, ThermalFrame
from heatsplat.preparation.meaning import Meaning

log = logging.getLogger(__name__)

SEQUENCES = (".seq", ".csq")
RECORDS = (".fff", *SEQUENCES)
# What makers and people put into names to tell the modalities of one exposure apart.
MODALITY = re.compile(r"[_\-. ](T|V|W|Z|S|IR|R|RGB|VIS|thermal|visible|visual|photo)$", re.IGNORECASE)
DJI_CLOCK = re.compile(r"DJI_(\d{14})_(?=\d+)")
SAME_EXPOSURE_S = 5.0  # by which the clocks in the names of one exposure's files may differ
# Columns of a table that make up a position and an attitude.
NUMBERS = {
    Position: ("latitude_deg", "longitude_deg", "altitude_m", "above_takeoff_m"),
    Attitude: ("yaw_deg", "pitch_deg", "roll_deg"),
}
KINDS = {
    "radiometric": "radiometric files",
    "float": "floating-point images",
    "counts": "16-bit images",
    "grey": "8-bit greys",
}


@dataclass(frozen=True)
class Reading:
    """How a folder is read.

    Args:
        meaning: of numbers without a calibration.
        zone: of times that have none, such as Europe/Berlin or +02:00; None leaves them as they are.
        table: file with a row for each frame, or None.
        columns: its columns: name, time, latitude_deg, longitude_deg, altitude_m, above_takeoff_m, yaw_deg, pitch_deg, roll_deg.
    """

    meaning: Meaning = field(default_factory=Meaning)
    zone: str | None = None
    table: Path | None = None
    columns: Mapping[str, str] = field(default_factory=dict)


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
    kinds: dict[str, list[Path]] = {}
    greys_known = reading.meaning.of_greys(folder)[0] is not None
    found = (p for p in folder.rglob("*") if p.suffix.lower() in (*SUFFIXES, *RECORDS) and p.is_file())
    for path in sorted(found, key=lambda p: by_numbers(p.relative_to(folder).as_posix())):
        kind = _kind(path)
        if kind == "sealed" and not greys_known:
            raise SceneError(
                f"{path} is a thermal picture of DJI whose temperatures cannot be read: its sensor values are counts, or not "
                f"there (if it was cut short, copy it again); {dji.CONVERT}. bounds_c=[min,max] takes the pictures as greys "
                "between these °C"
            )
        kinds.setdefault("colour" if kind == "sealed" else kind, []).append(path)
    if "grey" not in kinds and not kinds.keys() & {"radiometric", "float", "counts"}:
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
            "or greys"
        )
    kind, thermal = there[0], kinds[there[0]]
    reading.meaning.check_use(kind, KINDS[kind])
    notes: list[str] = []
    frames = list(_frames_of(kind, thermal, folder, reading, notes))
    frames = _paired(frames, [*kinds.get("colour", []), *(kinds["grey"] if kind != "grey" and "grey" in kinds else [])])
    frames = [_zoned(frame, reading.zone) for frame in _with_table(frames, reading, notes)]
    _check_names(frames)
    if all(frame.time is not None for frame in frames):
        frames.sort(key=lambda f: (instant(f.time), f.name))
    else:
        notes.append(
            f"{sum(f.time is None for f in frames)} of {len(frames)} frames have no time, so all are in the order of their "
            "names (table=... adds times)"
        )
    return Recording(frames, notes)


def by_numbers(name: str) -> list[str | int]:
    """What names are sorted by so that "image 2" comes before "image 10"."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]


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
        return "F" if pixels.dtype.kind == "f" else "I", (pixels.shape[1], pixels.shape[0])
    except Exception as error:  # Pillow raises whatever a damaged file leads to
        raise SceneError(f"image {path} is corrupt or no image; copy it again or remove it ({error})") from error


def _greys_in_colour(kinds: dict[str, list[Path]], folder: Path) -> dict[str, list[Path]]:
    """Greys that were stored as colours count as greys. Raises SceneError where the pictures are pseudo-colours or photos."""
    colour = kinds.get("colour", [])
    if colour and all(colour_levels(read_image(path, 0)[..., :3]) < PSEUDO_COLOUR_LEVELS for path in colour[:3]):
        return {"grey": colour}
    if colour:
        raise SceneError(
            f"{folder} holds coloured pictures alone (such as {colour[0].name}): colours of a palette are no temperatures. "
            "Export radiometric files, 16-bit counts, temperatures as TIFF, or greys with known bounds"
        )
    return kinds


def _frames_of(
    kind: str, paths: list[Path], folder: Path, reading: Reading, notes: list[str]
) -> Iterator[ThermalFrame]:
    if kind == "radiometric":
        for path in paths:
            yield from _radiometric(path, folder, reading, notes)
        return
    found = []
    for path in paths:
        details, camera = _of_exif(read_bytes(path))
        _, size = _mode_and_size(path)
        pages = pages_of(path)
        if several := len(pages) > 1:
            details = {}  # a file has one time and one place, of whichever of its images
            notes.append(f"{path.name}: {len(pages)} images in one file, each is a frame")
        for number, page in enumerate(pages):
            name = _name(path, folder, number if several else None)
            load = partial(_grey if kind == "grey" else read_image, path, page if several else None)
            found.append(ThermalFrame(name, path, number, load, camera=camera, size=size, **details))
    devices, calibrations = devices_of(found), {}
    for device in devices:
        sample = device.frames[0]
        try:
            if kind == "grey":
                calibration, note = reading.meaning.of_greys(folder)
            elif kind == "counts":
                calibration, note = reading.meaning.of_counts(sample.load(), sample.path)
            else:
                calibration, note = reading.meaning.of_floats(sample.load(), sample.path)
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
    yield from (replace(frame, calibration=calibrations[frame.path]) for frame in found)


def _grey(path: Path, page: int | None) -> np.ndarray:
    pixels = read_image(path, page)
    return to_grey(pixels[..., :3]) if pixels.ndim == 3 else pixels


def _name(path: Path, folder: Path, number: int | None = None) -> str:
    stem = path.relative_to(folder).with_suffix("").as_posix().replace("/", "_")
    return stem if number is None else f"{stem}_{number:06d}"


def _radiometric(path: Path, folder: Path, reading: Reading, notes: list[str]) -> Iterator[ThermalFrame]:
    if path.suffix.lower() in SEQUENCES:
        places = flir.frames_in(path)
        if cut := path.stat().st_size - sum(places[-1]):
            notes.append(
                f"{path.name}: {cut} bytes after its last whole frame are left out; was the recording cut short?"
            )
        for number, (start, length) in enumerate(places):
            record = flir.Record(flir.read_part(path, start, length), f"{path}, frame {number}")
            read = partial(flir.read_part, path, start, length)
            yield _of_flir(record, path, _name(path, folder, number), number, read, planck=reading.meaning.planck)
        return
    data = read_bytes(path)
    if payload := flir.payload_of(data):
        record = flir.Record(payload, str(path))
        read = partial(_payload, path)
        yield _of_flir(record, path, _name(path, folder), 0, read, data, planck=reading.meaning.planck)
    elif dji.array_of(data) is not None:
        yield _of_dji(path, _name(path, folder), data, reading)
    else:
        raise SceneError(f"{path} is no FLIR file; copy it again or remove it")


def _payload(path: Path) -> bytes:
    return flir.payload_of(read_bytes(path))


def _of_flir(
    record: flir.Record,
    path: Path,
    name: str,
    number: int,
    read: Callable[[], bytes],
    data: bytes = b"",
    planck: Sequence[float] | None = None,
) -> ThermalFrame:
    """The frame of an FFF record, by the camera's own constants unless others are given.

    It is read anew for its pixels, so that a recording need not fit into memory.
    """
    found = record.measured()
    response = found.response if planck is None else PlanckResponse(*(float(x) for x in planck))
    details, camera = _of_exif(data)
    if found.time is not None:
        details["time"] = found.time
    if found.latitude_deg is not None and "position" not in details:
        details["position"] = Position(found.latitude_deg, found.longitude_deg, found.altitude_m)

    def again() -> flir.Record:
        return flir.Record(read(), record.name)

    return ThermalFrame(
        name,
        path,
        number,
        load=lambda: again().counts(),
        calibration=Calibration(response),
        conditions=found.conditions,
        sources=dict.fromkeys(found.given, "file"),
        camera=CameraInfo(
            camera.make or "FLIR",
            found.model,
            found.serial,
            camera.focal_mm,
            found.field_of_view_deg,
            found.frame_rate_hz,
        ),
        size=record.size(),
        picture=(lambda: again().picture() or b"") if record.picture() else None,
        **details,
    )


def _of_dji(path: Path, name: str, data: bytes, reading: Reading) -> ThermalFrame:
    if reading.meaning.planck is not None:
        raise SceneError(f"counts.planck are constants of FLIR's cameras; {path} is of DJI and holds kelvin")
    stated, xmp = dji.parameters_in(data), dji.xmp_in(data)
    details, camera = _of_exif(data)
    height, width = dji.array_of(data).shape

    def number(key: str) -> float | None:
        try:
            return float(xmp[key])
        except (KeyError, ValueError):
            return None

    if (taken := taken_at(data)) is not None:
        details["time"] = taken
    if (place := details.get("position")) is not None:
        spread = [s for s in (number("RtkStdLat"), number("RtkStdLon")) if s is not None]
        details["position"] = replace(
            place,
            altitude_m=number("AbsoluteAltitude") or place.altitude_m,
            above_takeoff_m=number("RelativeAltitude"),
            horizontal_sd_m=float(np.hypot(*spread)) if len(spread) == 2 else None,
            vertical_sd_m=number("RtkStdHgt"),
        )
    angles = [number(f"Gimbal{axis}Degree") for axis in ("Yaw", "Pitch", "Roll")]
    if all(angle is not None for angle in angles):
        details["attitude"] = Attitude(*angles)
    return ThermalFrame(
        name,
        path,
        0,
        load=lambda: dji.array_of(read_bytes(path)),
        calibration=reading.meaning.of_temperatures(1.0 / dji.PER_KELVIN, -273.15),
        conditions=Conditions(**stated),
        sources=dict.fromkeys(stated, "file"),
        camera=replace(camera, serial=xmp.get("CameraSerialNumber") or camera.serial),
        size=(width, height),
        **details,
    )


def taken_at(data: bytes) -> datetime | None:
    """When a picture was taken: DJI's UTC at the exposure, or EXIF's clock, with a zone where it says one; None without."""
    if text := dji.xmp_in(data).get("UTCAtExposure"):
        try:
            return datetime.fromisoformat(text).replace(tzinfo=UTC)
        except ValueError:
            log.debug("UTCAtExposure is %r", text)
    return exif_in(data).get("time")


def _of_exif(data: bytes) -> tuple[dict[str, object], CameraInfo]:
    """(time and position as arguments of a frame, camera) as far as a picture's EXIF has them."""
    found = exif_in(data) if data else {}
    details = {"time": found["time"]} if "time" in found else {}
    if "latitude_deg" in found:
        details["position"] = Position(found["latitude_deg"], found["longitude_deg"], found.get("altitude_m"))
    return details, CameraInfo(found.get("make"), found.get("model"), found.get("serial"), found.get("focal_mm"))


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


def _zoned(frame: ThermalFrame, zone: str | None) -> ThermalFrame:
    """The frame with a time, of its name where the file has none, in the zone that was given for those without one."""
    time = frame.time
    if time is None and frame.number == 0 and (seconds := dji_time(frame.path.name)) is not None:
        time = datetime.fromtimestamp(seconds, UTC).replace(tzinfo=None)
    if time is not None and time.tzinfo is None and zone is not None:
        time = time.replace(tzinfo=zone_of(zone, "zone"))
    return replace(frame, time=time)


def _with_table(frames: list[ThermalFrame], reading: Reading, notes: list[str]) -> list[ThermalFrame]:
    """Frames with what a table says of them, which goes before what their files say.

    Raises:
        SceneError: the table has no row for any frame or several for one, or no column that is known, or a cell cannot be read.
    """
    if reading.table is None:
        return frames
    table = read_table(reading.table)
    at = {key: table.columns.index(column) for key, column in reading.columns.items() if column in table.columns}
    if "name" not in at:
        raise SceneError(
            f"table={reading.table} has no column {reading.columns.get('name')!r} with the names of files; it has "
            f"{', '.join(table.columns)}: set table_columns.name"
        )
    if not at.keys() - {"name"}:
        raise SceneError(
            f"table={reading.table} has none of the columns {', '.join(c for k, c in reading.columns.items() if k != 'name')}; "
            f"it has {', '.join(table.columns)}: say which is which, as in table_columns.time={table.columns[-1]}"
        )
    by_name: dict[str, tuple[int, list[str]]] = {}
    for line, cells in table.rows:
        if by_name.setdefault(cells[at["name"]], (line, cells))[1] != cells:
            raise SceneError(f"table={reading.table}, line {line}: {cells[at['name']]} has another row above; keep one")
    count = Counter(frame.path for frame in frames)
    # Rows name a file, or one of its frames, as flight_000003.
    named = [(frame.path.with_name(f"{frame.path.stem}_{frame.number:06d}.tiff"), frame.path) for frame in frames]
    by_file = {}
    for path, names in same_files([path.as_posix() for both in named for path in both], by_name).items():
        if len(names) > 1:
            raise SceneError(f"table={reading.table}: {' and '.join(names)} may both be {path}; keep one of them")
        if names:
            by_file[path] = by_name[names[0]]
    rows = {}
    for frame, (own, path) in zip(frames, named, strict=True):
        if count[path] > 1 and own.as_posix() in by_file:
            rows[frame.name] = by_file[own.as_posix()]
        elif path.as_posix() in by_file:
            line, cells = rows[frame.name] = by_file[path.as_posix()]
            if count[path] > 1 and "time" in at and cells[at["time"]]:
                raise SceneError(
                    f"{reading.table}, line {line}: {path.name} holds {count[path]} frames, which have no time in common; give "
                    f"each a row, as {own.stem}"
                )
    matched = len(rows)
    if not matched:
        raise SceneError(
            f"table={reading.table} has no row for any of the {len(frames)} frames, such as {frames[0].path.name}; "
            f"its column {reading.columns['name']} begins with {next(iter(by_name), 'nothing')}"
        )
    told: set[str] = set()

    def of(frame: ThermalFrame) -> ThermalFrame:
        if frame.name not in rows:
            return frame
        line, cells = rows[frame.name]

        def number(key: str) -> float | None:
            if key not in at or not cells[at[key]]:
                return None
            try:
                return table.number(cells[at[key]])
            except ValueError as error:
                raise SceneError(
                    f"{reading.table}, line {line}: {cells[at[key]]!r} in column {reading.columns[key]} is no number"
                ) from error

        changes: dict[str, object] = {}
        if "time" in at and (text := cells[at["time"]]):
            try:
                changes["time"] = datetime.fromisoformat(text)
            except ValueError as error:
                raise SceneError(
                    f"{reading.table}, line {line}: {text!r} in column {reading.columns['time']} is no date-time such as "
                    "2024-08-06T15:35:05.376"
                ) from error
            told.add("time")
        for part, kind in (("position", Position), ("attitude", Attitude)):
            said = {key: value for key in NUMBERS[kind] if (value := number(key)) is not None}
            known = getattr(frame, part)
            if said and (known is not None or _needed(kind) <= said.keys()):
                changes[part] = kind(**said) if known is None else replace(known, **said)
                told.update(said)
        return replace(frame, **changes)

    found = [of(frame) for frame in frames]
    for kind, keys in NUMBERS.items():
        idle = [key for key in keys if key in at and key not in told and any(row[at[key]] for _, row in rows.values())]
        if idle:
            lacking = ", ".join(reading.columns.get(key, key) for key in sorted(_needed(kind) - {idle[0]}))
            raise SceneError(
                f"table={reading.table}: column {reading.columns[idle[0]]} changes nothing, as neither the table nor the files "
                f"say {lacking} of the same frame; add that, or take the column away"
            )
    notes.append(
        f"{reading.table.name} tells {', '.join(sorted(told)) or 'nothing'} of {matched} of {len(frames)} frames"
    )
    return found


def _needed(kind: type[Position | Attitude]) -> set[str]:
    """What cannot be left out of a position or an attitude."""
    return {part.name for part in fields(kind) if part.default is MISSING}


def _check_names(frames: list[ThermalFrame]) -> None:
    twice = [name for name, count in Counter(frame.name for frame in frames).items() if count > 1]
    if twice:
        first, second = [frame.path for frame in frames if frame.name == twice[0]][:2]
        raise SceneError(f"{first} and {second} would both become {twice[0]}.tiff; rename or remove one of them")
