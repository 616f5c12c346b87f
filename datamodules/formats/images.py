"""Stored images: reading them by content, and resampling them without leaving their integer type."""

from __future__ import annotations

import mmap
import os
import struct
import unicodedata
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from PIL.TiffImagePlugin import IMAGEDESCRIPTION, ImageFileDirectory_v2

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import Lens, undistortion_maps
from heatsplat.geometry.resampling import CUT_SHARE

# What is wrong with a file is said by the exceptions below; OpenCV would add lines of its own, even for unknown TIFF tags.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")

PNG = b"\x89PNG\r\n\x1a\n"  # begins one; size and type follow, and their checksum

# Kind of a page of a TIFF (1: a smaller copy, 4: a mask), its width, height, bits of a sample, samples of a pixel, their type.
PAGE_TAGS = (254, 256, 257, 258, 277, 339)
GDAL_METADATA = 42112  # tag in which GDAL writes the unit of a band
MOST_ENTRIES = 4096  # of a page; more are damage
MOST_MAPPED = 2**31 - 1  # bytes that OpenCV decodes from memory

# Mean difference between the largest and smallest channel of a pixel, in 8-bit grey levels. Greys stored as RGB have 0,
# after JPEG compression below 2; colour maps have 50 and more.
PSEUDO_COLOUR_LEVELS = 4.0


def read_bytes(path: Path) -> bytes:
    """Content of an image file. Raises SceneError when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error


def read_image(path: Path, page: int | None = None) -> np.ndarray:
    """The pixels of an image file as they are stored: [H, W] or [H, W, C], C = 3 (RGB) or 4 (RGBA).

    The format is taken from the content, not from the extension. uint8 and uint16 stay, floating point becomes float32.

    Args:
        path: of the file.
        page: which of several images in a TIFF (``pages_of``); None where it is to hold one.

    Raises:
        SceneError: the file is missing, empty, truncated, no image, of another pixel type, or holds several images.
    """
    try:
        pixels = _only(path) if page is None else _one_of(path, page)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.size == 0:
        raise SceneError(f"image {path} is corrupt or no image; copy it again or remove it from the scene")
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise SceneError(f"image {path} has pixels of type {pixels.dtype}; supported are uint8, uint16 and float32")
    if pixels.ndim == 3:
        pixels = pixels[..., 0] if pixels.shape[2] == 1 else pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
    return np.ascontiguousarray(pixels)


def read_grey(path: Path) -> np.ndarray | None:
    """An image as greys [H, W] of 8 bits, by whatever name (``_in_utf8``); None where there is none."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None


def _in_utf8(path: Path) -> bool:
    """Whether a path is text: one that is not ends Python where OpenCV is given it."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _only(path: Path) -> np.ndarray | None:
    data = read_bytes(path)
    if not data:
        raise SceneError(f"image {path} is empty (0 bytes); copy it again or remove it from the scene")
    if data[:2] == b"\xff\xd8" and _is_truncated_jpeg(data):
        raise SceneError(f"image {path} is corrupt: the JPEG ends early; copy it again or remove it from the scene")
    if data[:8] == PNG and data[29:33] != struct.pack(">I", zlib.crc32(data[12:29])):  # OpenCV seeks pixels for seconds
        return None
    if (count := len(pages_of(path))) > 1:
        raise SceneError(
            f"image {path} is a TIFF of {count} images, and one is expected; write each into a file of its own, or prepare the "
            "file (src/prepare.py), which takes every one"
        )
    _check_channels(path)
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def _check_channels(path: Path) -> None:
    """Raises SceneError for a TIFF with channels that OpenCV does not decode, or of which it leaves the upper eight bits."""
    channels = bits = None
    with path.open("rb") as file, suppress(struct.error, ValueError, OverflowError):
        *_, bits, channels, _ = next(_tiff_pages(file), (0, (None,) * 6))[1]
    if channels not in (None, 1, 3, 4) and (channels, bits) != (2, 8):
        raise SceneError(
            f"image {path} has {channels} channels of more than 8 bits; supported are 1, 3 and 4: write the one with the "
            "temperatures into a file of its own (gdal_translate -b 1 IN.tif OUT.tif)"
        )


def _one_of(path: Path, page: int) -> np.ndarray | None:
    """One page, without reading the others: a recording need not fit into memory.

    OpenCV walks to a later page from the first one, the longer the more there are (800 small ones took 35 s in all, 200 of them
    0.7 s). So a copy of the file's header, of which only what is decoded is ever read, names that page as the first.
    """
    try:
        about = path.stat()
        if (page == 0 or about.st_size > MOST_MAPPED) and _in_utf8(path):
            found = cv2.imreadmulti(str(path), page, 1, flags=cv2.IMREAD_UNCHANGED)[1]
            return found[0] if found else None
        if page == 0:
            return cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        places = _places_of_pages(path, about.st_size, about.st_mtime_ns)
        if page >= len(places):
            return None
        with path.open("rb") as file:
            order, offset = _tiff_layout(file)
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        struct.pack_into(f"{order}{offset}", data, struct.calcsize(offset), places[page])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error


@lru_cache(maxsize=4)
def _places_of_pages(path: Path, size: int, changed_ns: int) -> tuple[int, ...]:
    """Where each page of a TIFF begins, as far as they can be told; of a file of that size that was changed then."""
    places: list[int] = []
    with path.open("rb") as file, suppress(struct.error, ValueError, OverflowError):
        places.extend(at for at, _ in _tiff_pages(file))
    return tuple(places)


def pages_of(path: Path) -> list[int]:
    """The images of a TIFF that have size and type of the first one; [0] for a file of any other kind.

    Previews, overviews and masks, which are pages too, are none of them.

    Raises:
        SceneError: the file cannot be read, or was cut short between two of them.
    """
    found: list[tuple] = []
    try:
        with path.open("rb") as file:
            found.extend(page for _, page in _tiff_pages(file))
    except OSError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error
    except (struct.error, ValueError, OverflowError) as error:
        if len(found) > 1:  # of a damaged file with one image decoding says what it is worth
            raise SceneError(f"image {path} is corrupt after its image {len(found)}; copy it again") from error
    return [i for i, page in enumerate(found) if page == found[0]] or [0]


def tiff_text(path: Path) -> str:
    """What a TIFF says of its first image in words; empty where it says nothing, or is no TIFF that can be read."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
            tags = ImageFileDirectory_v2(head + file.read(8) if head[2:3] == b"+" else head)  # BigTIFF has a longer one
            file.seek(tags.next)
            tags.load(file)
            return "\n".join(str(tags[tag]) for tag in (IMAGEDESCRIPTION, GDAL_METADATA) if tag in tags)
    except Exception:  # Pillow raises whatever a damaged file leads to; decoding says what it is worth
        return ""


def _tiff_layout(file: BinaryIO) -> tuple[str, str] | None:
    """Byte order of a TIFF and the kind of its offsets, as struct has them; None for a file of any other kind."""
    order = {b"II": "<", b"MM": ">"}.get(file.read(2))
    version = struct.unpack(f"{order}H", file.read(2))[0] if order else None
    offset = {42: "I", 43: "Q"}.get(version)  # 43 is BigTIFF, with wider numbers
    return (order, offset) if offset else None


def _tiff_pages(file: BinaryIO) -> Iterator[tuple[int, tuple]]:
    """Where each page of a TIFF begins, and what it is: whether it belongs to another one, its width, height and type."""
    layout = _tiff_layout(file)
    if layout is None:
        return
    order, offset = layout
    count, size = {"I": ("H", 12), "Q": ("Q", 20)}[offset]
    wide = struct.calcsize(f"<{offset}")
    file.seek(wide)
    at, seen = struct.unpack(f"{order}{offset}", file.read(wide))[0], set()
    while at and at not in seen:
        seen.add(at)
        file.seek(at)
        entries = struct.unpack(f"{order}{count}", file.read(struct.calcsize(f"<{count}")))[0]
        table = file.read(size * min(entries, MOST_ENTRIES))
        values = {}
        for start in range(0, len(table), size):
            tag, kind, number = struct.unpack_from(f"{order}HH{offset}", table, start)
            form = {3: "H", 4: "I"}.get(kind)
            if tag in PAGE_TAGS and form and number * struct.calcsize(form) <= wide:  # longer ones stand elsewhere
                values[tag] = struct.unpack_from(f"{order}{form}", table, start + size - wide)[0]
        yield at, (values.get(PAGE_TAGS[0], 0) & 5, *(values.get(tag) for tag in PAGE_TAGS[1:]))
        following = file.read(wide)
        at = struct.unpack(f"{order}{offset}", following)[0] if len(following) == wide else 0


def _is_truncated_jpeg(data: bytes) -> bool:
    """True when no end marker follows the scan of the main image (decoders fill the rest with grey, silently)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xDA:
            return data.find(b"\xff\xd9", at) < 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return True


def list_images(folder: Path) -> list[str]:
    """Paths of all image files below ``folder`` that are not hidden, relative to it with forward slashes, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in shown_files(folder, SUFFIXES))


def shown_files(folder: Path, suffixes: Collection[str], above: frozenset[str] = frozenset()) -> Iterator[Path]:
    """Files below ``folder`` whose names end so, in lower case; none that is hidden (".") or in a hidden folder, such as what
    macOS puts beside each file of a card ("._IMG_0042.jpg") and the thumbnails of other programs.

    Links to folders are followed, as data often lie on another disk.

    Args:
        folder: to look in; nothing comes of one that cannot be read.
        suffixes: with their points.
        above: folders that this one was reached through, which links in it do not lead back into.
    """
    here = os.path.realpath(folder)
    if here in above or not folder.is_dir():
        return
    with suppress(PermissionError), os.scandir(folder) as entries:
        for entry in entries:
            path = folder / entry.name
            if entry.name.startswith("."):
                continue
            if entry.is_dir():
                yield from shown_files(path, suffixes, above | {here})
            elif path.suffix.lower() in suffixes:
                yield path


def _alike(name: str) -> str:
    """What names have in common that differ in case, or in how umlauts are written: macOS takes letters and their marks apart."""
    return unicodedata.normalize("NFC", name).lower()


class ImageIndex:
    """Finds the file of an image name, whatever its extension and upper or lower case.

    Args:
        folder: folder that names are relative to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = list_images(folder) if folder.is_dir() else []
        self._exact = set(self.names)
        self._by_stem = {_alike(name.rsplit(".", 1)[0]): name for name in reversed(self.names)}

    def find(self, name: str) -> str | None:
        """The stored name that matches ``name`` exactly or up to extension and case, or None."""
        if name in self._exact:
            return name
        head, _, tail = name.rpartition(".")
        stem = head if f".{tail.lower()}" in SUFFIXES else name
        return self._by_stem.get(_alike(stem))

    def unused(self, used: Iterable[str]) -> list[str]:
        """Stored names that are not among ``used``."""
        return sorted(self._exact - set(used))


def split_alpha(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour or grey without alpha, and where alpha is at least half [H, W] bool (None without alpha)."""
    if pixels.ndim == 2 or pixels.shape[2] == 3:
        return pixels, None
    half = np.iinfo(pixels.dtype).max / 2 if pixels.dtype.kind == "u" else 0.5
    return pixels[..., :3], pixels[..., 3] >= half


def colour_levels(pixels: np.ndarray) -> float:
    """How far an image [H, W, 3] is from grey: mean spread of its channels in 8-bit levels; 0 for [H, W]."""
    if pixels.ndim == 2:
        return 0.0
    full = 255.0 / np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0
    r, g, b = (pixels[..., channel] for channel in range(3))  # reducing an axis of three is five times slower
    largest, least = np.maximum(np.maximum(r, g), b), np.minimum(np.minimum(r, g), b)
    return float((largest.astype(np.float64) - least).mean() * full)


def to_grey(pixels: np.ndarray) -> np.ndarray:
    """One channel [H, W] in the stored type: luma of RGB, which is the common value where all channels are equal."""
    return pixels if pixels.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY)


def _rounded(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if dtype.kind == "f":
        return values
    return np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)


def undistorted(pixels: np.ndarray, lens: Lens) -> np.ndarray:
    """The image without lens distortion, in the stored type; interpolated linearly in float32 (16 bit stay exact)."""
    x, y, _ = undistortion_maps(lens)
    values = cv2.remap(pixels.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return _rounded(values, pixels.dtype)


def undistorted_mask(mask: np.ndarray | None, lens: Lens) -> np.ndarray:
    """Which pixels of the undistorted image [H, W] rest on valid stored pixels alone."""
    x, y, valid = undistortion_maps(lens)
    if mask is None:
        return valid
    return valid & (cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.999)


def resized(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """The image on ``width`` x ``height`` pixels by area averages in float32, in the stored type."""
    if pixels.shape[:2] == (height, width):
        return pixels
    values = cv2.resize(pixels.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return _rounded(values, pixels.dtype)


def resized_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Which pixels of the resized image rest on valid stored pixels alone."""
    if mask.shape == (height, width):
        return mask
    return cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.999


def undistorted_ends(ends: np.ndarray | None, lens: Lens) -> np.ndarray | None:
    """Where the undistorted image was cut off, [H, W] int8 (``_touched``); None stays."""
    if ends is None:
        return None
    x, y, _ = undistortion_maps(lens)
    return _touched(ends, lambda share: cv2.remap(share, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def resized_ends(ends: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where the resized image was cut off, [height, width] int8 (``_touched``)."""
    if ends.shape == (height, width):
        return ends
    return _touched(ends, lambda share: cv2.resize(share, (width, height), interpolation=cv2.INTER_AREA))


def _touched(ends: np.ndarray, resample: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Which new pixels rest on pixels at an end of the image's span (1: warm, -1: cold), if on none at the other end: the rule of
    ``geometry.resampling.ends_on``."""
    above, below = (resample((ends == sign).astype(np.float32)) > CUT_SHARE for sign in (1, -1))
    return above.astype(np.int8) - below.astype(np.int8)
