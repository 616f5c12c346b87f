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
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image)):
        raise OSError(f"cannot write {path}")


def read_temperature(path: str | Path) -> np.ndarray:
    """Temperatures of a file that ``write_temperature`` wrote, [H, W] float32 in °C.

    Raises:
        ValueError: the file is missing, no image, or not one channel of float32.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} cannot be read as an image")
    if image.dtype != np.float32 or image.ndim != 2:
        raise ValueError(f"{path} holds {image.dtype} {list(image.shape)}, not float32 temperatures [H, W]")
    return image
