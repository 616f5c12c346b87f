"""Temperature images as float32 TIFF in °C, which any image tool with float support can measure in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np


def write_temperature(path: str | Path, celsius: Any) -> None:
    """Writes temperatures bit by bit as they are (NaN included) and makes the folder.

    Args:
        path: ends in .tif or .tiff.
        celsius: [H, W] or [H, W, 1] in °C, tensor or array.

    Raises:
        ValueError: the shape or the file's ending does not fit.
        OSError: the file cannot be written.
    """
    path = Path(path)
    image = np.asarray(celsius, dtype=np.float32)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.ndim != 2:
        raise ValueError(f"a temperature image is [H, W] or [H, W, 1], got {list(image.shape)}")
    if path.suffix.lower() not in (".tif", ".tiff"):
        raise ValueError(f"{path}: temperatures are written as float32 TIFF, name the file .tiff")
    # Python writes the file: OpenCV takes no path that is not UTF-8, and on Windows none beyond the code page.
    done, encoded = cv2.imencode(".tiff", np.ascontiguousarray(image))
    if not done:
        raise OSError(f"cannot write {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded)


def read_temperature(path: str | Path) -> np.ndarray:
    """Temperatures of a file that ``write_temperature`` wrote, [H, W] float32 in °C.

    Raises:
        ValueError: the file is missing, no image, or not one channel of float32.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None:
        raise ValueError(f"{path} cannot be read as an image")
    if image.dtype != np.float32 or image.ndim != 2:
        raise ValueError(f"{path} holds {image.dtype} {list(image.shape)}, not float32 temperatures [H, W]")
    return image
