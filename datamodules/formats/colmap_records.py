"""Whether the files of a COLMAP model are complete: their records are counted before COLMAP's own reader believes them.

That reader does not look for the end of a file: behind it, it takes whatever is in memory for counts and coordinates.
The layouts are those of COLMAP's ``src/colmap/scene/reconstruction_io_binary.cc`` and ``reconstruction_io_text.cc``.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from struct import Struct, error

from heatsplat.contracts import SceneError, number_in
from heatsplat.datamodules.formats.colmap_library import pycolmap

PARTS = ("cameras", "images", "points3D", "rigs", "frames")
REMEDY = "copy the model or export it from COLMAP again"
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_NUMBER, _COUNT, _POSE = Struct("<I"), Struct("<Q"), 7 * 8  # a pose is a quaternion and a translation
_PARAMS: dict[int, int] = {
    kind.value: len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 2, 2).params)
    for kind in pycolmap.CameraModelId.__members__.values()
    if kind.value >= 0
}


def check_records(folder: Path, suffix: str) -> None:
    """Nothing, for a model whose files ("bin" or "txt") hold as many whole records as they say, and no more.

    points3D.txt may be empty where no image refers to a point: so COLMAP's own guide has models of known cameras written.

    Raises:
        SceneError: one does not, or a needed file is missing; the message names the file and the record or line.
    """
    points_told = False
    for part in PARTS:
        file = folder / f"{part}.{suffix}"
        if not file.is_file():
            if part in ("rigs", "frames"):  # older models have none
                continue
            raise SceneError(f"sparse model {folder} has no {file.name}; {REMEDY}")
        if suffix == "bin":
            _check_binary(file, _BINARY[part])
        elif part == "images":
            points_told = _check_text(file, _TEXT[part], paired=True)
        else:
            _check_text(file, _TEXT[part], may_be_empty=part == "points3D" and not points_told)


def announced_images(folder: Path) -> int:
    """How many images the model in a folder says that it has, by the first lines of its files; 0 where none says it."""
    binary, text = folder / "images.bin", folder / "images.txt"
    try:
        if binary.is_file():
            with binary.open("rb") as file:
                return _COUNT.unpack(file.read(_COUNT.size))[0]
        counts = (_announced(line) for line in takewhile(lambda line: line.startswith("#"), text_of(text).splitlines()))
        return next((count for count in counts if count is not None), 0)
    except (OSError, error):
        return 0


def text_of(file: Path) -> str:
    """Content of a text file, which is UTF-8, or what its byte order mark says; what is none becomes U+FFFD."""
    data = file.read_bytes()
    return data.decode("utf-16" if data[:2] in _UTF_16 else "utf-8-sig", errors="replace")


def plain_text(folder: Path, into: Path) -> Path:
    """The folder of a text model that COLMAP's reader understands: the same, or ``into`` with the files of this one without what
    editors leave in them or take away. That reader takes a byte order mark for a number, knows no line ends of a bare carriage
    return, and leaves out the last image where its line of points, which may be empty, does not end."""
    files = {part: folder / f"{part}.txt" for part in PARTS}
    found = {part: (file.read_bytes(), text_of(file)) for part, file in files.items() if file.is_file()}
    as_written = all(data == text.encode() and "\r" not in text.replace("\r\n", "") for data, text in found.values())
    if as_written and not _ends_with_image(found["images"][1]):
        return folder
    for part, (_, text) in found.items():
        lines = text.splitlines()
        (into / f"{part}.txt").write_bytes("\n".join([*lines, "", ""]).encode())
    return into


def _ends_with_image(text: str) -> bool:
    """Whether the last line is that of an image, and no line of its points comes after it."""
    lines, number = text.splitlines(), 0
    while number < len(lines):
        record = lines[number].strip()
        number += 2 if record and not record.startswith("#") else 1
    return number > len(lines)


def names_in_text(file: Path) -> dict[int, str]:
    """Name of every image in an images.txt that is whole, by its number: COLMAP's own reader ends one at its first space."""
    lines = iter(text_of(file).splitlines())
    names = {}
    for line in map(str.strip, lines):
        if line and not line.startswith("#"):
            number, *_, name = line.split(maxsplit=9)
            names[int(number)] = name
            next(lines, None)  # its points
    return names


def point_ids_in(folder: Path) -> list[int]:
    """Numbers of the points of a whole model, in the order of its file."""
    binary = folder / "points3D.bin"
    if not binary.is_file():
        lines = map(str.strip, text_of(folder / "points3D.txt").splitlines())
        return [int(line.split(maxsplit=1)[0]) for line in lines if line and not line.startswith("#")]
    data = binary.read_bytes()
    at, ids = _COUNT.size, []
    while at < len(data):
        ids.append(_COUNT.unpack_from(data, at)[0])
        at = _point(data, at)
    return ids


def _announced(line: str) -> int | None:
    """The number of records that a comment in a text file tells, or None."""
    word = line.partition(":")[2].partition(",")[0].strip()
    return int(word) if line.startswith("# Number of ") and word.isdigit() else None


def _check_binary(file: Path, end_of: Callable[[bytes, int], int]) -> None:
    data = file.read_bytes()
    if len(data) < _COUNT.size:
        raise SceneError(f"sparse model {file} is {'cut short' if data else 'empty'} ({len(data)} bytes); {REMEDY}")
    count, at, number = _COUNT.unpack_from(data)[0], _COUNT.size, 0
    try:
        while number < count and at <= len(data):
            number += 1
            at = end_of(data, at)
    except SceneError:
        raise
    except (error, ValueError):  # the length of the next record lies behind the end
        at = len(data) + 1
    if at > len(data):
        raise SceneError(
            f"sparse model {file} is cut short or damaged: it announces {count} records, and its {len(data)} bytes end "
            f"before number {number} is complete; {REMEDY}"
        )
    if at < len(data):
        raise SceneError(
            f"sparse model {file} is damaged: its {count} records are {at} bytes, the file has {len(data)}; {REMEDY}"
        )


def _camera(data: bytes, at: int) -> int:
    kind = _NUMBER.unpack_from(data, at + 4)[0]
    if kind not in _PARAMS:
        raise SceneError(
            f"sparse model, cameras.bin: number {kind} is no camera model that COLMAP knows; {REMEDY}, or undistort the "
            "scene first (colmap image_undistorter), which leaves PINHOLE cameras"
        )
    return at + 24 + 8 * _PARAMS[kind]


def _image(data: bytes, at: int) -> int:
    name_at = at + 4 + _POSE + 4
    end_of_name = data.index(b"\0", name_at) + 1
    _check_name(data[name_at : end_of_name - 1].decode("utf-8", "replace"))
    return end_of_name + 8 + 24 * _COUNT.unpack_from(data, end_of_name)[0]


def _check_name(name: str) -> None:
    if "\ufffd" in name:
        raise SceneError(f"sparse model, images: {name!r} is no file name in UTF-8; {REMEDY}, with plain file names")


def _point(data: bytes, at: int) -> int:
    return at + 51 + 8 * _COUNT.unpack_from(data, at + 43)[0]


def _rig(data: bytes, at: int) -> int:
    sensors = _NUMBER.unpack_from(data, at + 4)[0]
    at += 8 + (8 if sensors else 0)
    for _ in range(sensors - 1):
        at += 9 + (_POSE if data[at + 8 : at + 9] > b"\0" else 0)
        if at > len(data):
            break
    return at


def _frame(data: bytes, at: int) -> int:
    return at + 12 + _POSE + 16 * _NUMBER.unpack_from(data, at + 8 + _POSE)[0]


_BINARY = {"cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}


def _check_text(
    file: Path, wrong: Callable[[list[str]], str | None], paired: bool = False, may_be_empty: bool = False
) -> bool:
    """Whether a line of points refers to one.

    Args:
        file: of one part of a model.
        wrong: says of the words of a record what is missing, or None.
        paired: records have a line of points each, as those of images.
        may_be_empty: a file without anything is whole.

    Raises:
        SceneError: a record or line is not whole, or there are not as many as the file says.
    """
    text = text_of(file)
    if not text.strip():
        if may_be_empty:
            return False
        raise SceneError(f"sparse model {file} is empty; {REMEDY}")
    lines = text.splitlines()
    announced, found, number, points_told = None, 0, 0, False
    while number < len(lines):
        line, number = lines[number].strip(), number + 1
        if line.startswith("# Number of "):
            announced = _announced(line)
        if not line or line.startswith("#"):
            continue
        found += 1
        if says := wrong(line.split()):
            raise SceneError(f"sparse model {file}, line {number}: {says}; {REMEDY}")
        if paired:
            number += 1
            points = lines[number - 1].split() if number <= len(lines) else []
            if len(points) % 3 or not _numbers(points):
                raise SceneError(
                    f"sparse model {file}, line {number}: points of an image are numbers X Y POINT3D_ID; {REMEDY}"
                )
            points_told |= any(word != "-1" for word in points[2::3])
    if announced is not None and (announced != found or not text.endswith("\n")):
        raise SceneError(
            f"sparse model {file} announces {announced} records and has {found}"
            + ("" if text.endswith("\n") else f", the last without the end of its line ({len(lines)})")
            + f"; {REMEDY}"
        )
    return points_told


def _numbers(words: list[str]) -> bool:
    try:
        return all(abs(number_in(word)) < float("inf") for word in words)
    except ValueError:
        return False


def _text_camera(words: list[str]) -> str | None:
    known = len(words) > 4 and words[1] in pycolmap.CameraModelId.__members__
    if known and len(words) - 4 != _PARAMS.get(pycolmap.CameraModelId.__members__[words[1]].value):
        return f"camera model {words[1]} with {len(words) - 4} parameters"
    good = len(words) > 4 and _numbers([words[0], *words[2:]])
    return None if good else "a camera is CAMERA_ID MODEL WIDTH HEIGHT PARAMS"


def _text_image(words: list[str]) -> str | None:
    good = len(words) >= 10 and _numbers(words[:9])
    _check_name(" ".join(words[9:]))
    return None if good else "an image is IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of its points"


def _text_point(words: list[str]) -> str | None:
    good = len(words) >= 8 and len(words) % 2 == 0 and _numbers(words)
    return None if good else "a point is POINT3D_ID X Y Z R G B ERROR and pairs IMAGE_ID POINT2D_IDX"


def _text_rig(words: list[str]) -> str | None:
    return None if len(words) >= 2 and _numbers(words[:2]) else "a rig is RIG_ID NUM_SENSORS and its sensors"


def _text_frame(words: list[str]) -> str | None:
    good = len(words) >= 10 and _numbers(words[:10]) and len(words) == 10 + 3 * int(float(words[9]))
    return (
        None if good else "a frame is FRAME_ID RIG_ID, a pose, NUM_DATA_IDS and triples SENSOR_TYPE SENSOR_ID DATA_ID"
    )


_TEXT = {
    "cameras": _text_camera, "images": _text_image, "points3D": _text_point, "rigs": _text_rig, "frames": _text_frame
}  # fmt: skip
