"""Stored images: reading them by content, and resampling them without leaving their integer type."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import Lens, undistortion_maps

# What is wrong with a file is said by the exceptions below; OpenCV would add lines of its own, even for unknown TIFF tags.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")

# Mean difference between the largest and smallest channel of a pixel, in 8-bit grey levels. Greys stored as RGB have 0,
# after JPEG compression below 2; colour maps have 50 and more.
PSEUDO_COLOUR_LEVELS = 4.0


def read_image(path: Path) -> np.ndarray:
    """The pixels of an image file as they are stored: [H, W] or [H, W, C], C = 3 (RGB) or 4 (RGBA).

    The format is taken from the content, not from the extension. uint8 and uint16 stay, floating point becomes float32.

    Raises:
        SceneError: the file is missing, empty, truncated, no image, or of another pixel type.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error
    if not data:
        raise SceneError(f"image {path} is empty (0 bytes); copy it again or remove it from the scene")
    if data[:2] == b"\xff\xd8" and _is_truncated_jpeg(data):
        raise SceneError(f"image {path} is corrupt: the JPEG ends early; copy it again or remove it from the scene")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
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


def _is_truncated_jpeg(data: bytes) -> bool:
    """True when no end marker follows the scan of the main image (decoders fill the rest with grey, silently)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == 0xDA:
            return data.find(b"\xff\xd9", at) < 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return True


def list_images(folder: Path) -> list[str]:
    """Paths of all image files below ``folder``, relative to it with forward slashes, sorted."""
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)


class ImageIndex:
    """Finds the file of an image name, whatever its extension and upper or lower case.

    Args:
        folder: folder that names are relative to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = list_images(folder) if folder.is_dir() else []
        self._exact = set(self.names)
        self._by_stem = {name.rsplit(".", 1)[0].lower(): name for name in reversed(self.names)}

    def find(self, name: str) -> str | None:
        """The stored name that matches ``name`` exactly or up to extension and case, or None."""
        if name in self._exact:
            return name
        head, _, tail = name.rpartition(".")
        stem = head if f".{tail.lower()}" in SUFFIXES else name
        return self._by_stem.get(stem.lower())

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
    return float((pixels.max(axis=2).astype(np.float64) - pixels.min(axis=2)).mean() * full)


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
