"""Intrinsics and lens distortion of a stored image, and the maps that take the distortion out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from heatsplat.contracts import SceneError

# COLMAP's camera models: names of the parameters in file order. Both distortion families are OpenCV's polynomials.
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
# What no camera exceeds: pixels of a side, focal length in image sides, and the principal point's way from the centre.
MAX_PIXELS, MAX_FOCAL, MAX_SHIFT = 100_000, 1e4, 10.0


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels of a ``width`` x ``height`` image, and distortion coefficients.

    **Convention:** the principal point counts from the corner of the image, pixel centres lie at +0.5 (as COLMAP's).

    Args:
        fx, fy, cx, cy: focal lengths and principal point.
        width, height: image size these numbers belong to (not always that of the stored file).
        distortion: OpenCV's coefficients: k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4 of the fisheye model; empty for none.
        fisheye: which of the two models the coefficients belong to.
        model: name of the camera model, for the report.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    model: str = "PINHOLE"

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        width, height = self.width, self.height
        if not (0 < width <= MAX_PIXELS and 0 < height <= MAX_PIXELS):
            raise SceneError(
                f"camera {self.model} is {width} x {height}; both must lie between 1 and {MAX_PIXELS} pixels"
            )
        if not all(map(math.isfinite, numbers)) or self.fx <= 0 or self.fy <= 0:
            raise SceneError(
                f"camera {self.model} has impossible parameters: {numbers}; focal lengths must be positive"
            )
        if not (
            1e-2 < self.fx / width < MAX_FOCAL
            and 1e-2 < self.fy / height < MAX_FOCAL
            and abs(self.cx / width - 0.5) < MAX_SHIFT
            and abs(self.cy / height - 0.5) < MAX_SHIFT
        ):
            raise SceneError(
                f"camera {self.model} of {width} x {height} pixels has impossible parameters: {numbers}; focal length and "
                "principal point are pixels of that image"
            )

    @classmethod
    def pinhole(cls, matrix: np.ndarray, width: int, height: int) -> Lens:
        """A lens without distortion from intrinsics [3, 3] in pixels of a ``width`` x ``height`` image."""
        fx, fy, cx, cy = (float(matrix[i][j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return cls(fx, fy, cx, cy, width, height)

    @property
    def is_distorted(self) -> bool:
        """True when pixels do not lie where a pinhole would put them."""
        return self.fisheye or any(self.distortion)

    def matrix(self) -> np.ndarray:
        """Intrinsics [3, 3], float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens over an image of ``width`` x ``height`` pixels; each axis scales by its own pixel count."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )


def lens_of(model: str, params: Sequence[float], width: int, height: int, source: str) -> Lens:
    """The lens of a COLMAP camera. Raises SceneError naming ``source`` for an unsupported model or impossible numbers."""
    if model not in MODELS:
        raise SceneError(
            f"{source}: camera model {model} is not supported; supported are {', '.join(MODELS)}. "
            "Undistort the scene first (colmap image_undistorter), which leaves PINHOLE cameras."
        )
    names = MODELS[model].split()
    if len(params) != len(names):
        raise SceneError(f"{source}: camera model {model} has {len(names)} parameters ({names}), got {len(params)}")
    values = dict(zip(names, map(float, params), strict=True))
    focal = values.get("f")
    fisheye = model.endswith("FISHEYE")
    coefficients = tuple(values.get(key, 0.0) for key in (_FISHEYE if fisheye else _POLYNOMIAL))
    try:
        return Lens(
            fx=values.get("fx", focal),
            fy=values.get("fy", focal),
            cx=values["cx"],
            cy=values["cy"],
            width=width,
            height=height,
            distortion=coefficients if fisheye or any(coefficients) else (),
            fisheye=fisheye,
            model=model,
        )
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from error


@lru_cache(maxsize=2)
def undistortion_maps(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each pixel of the undistorted image lies in the stored one: (x [H, W], y [H, W], valid [H, W]).

    **Convention:** x and y as cv2.remap wants them, pixel centres at integers. The undistorted image keeps size, focal
    length and principal point of the stored one. A pixel is invalid when it lies outside the stored image, or where the
    polynomial folds back on itself and would show the same place twice.
    """
    # cv2 counts from the centre of the first pixel, the lens from its corner.
    matrix = lens.matrix()
    matrix[:2, 2] -= 0.5
    coefficients = np.array(lens.distortion, dtype=np.float64)
    size = (lens.width, lens.height)
    if lens.fisheye:
        x, y = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
    else:
        x, y = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, size, cv2.CV_32FC1)
    valid = (x >= -0.5) & (x <= lens.width - 0.5) & (y >= -0.5) & (y <= lens.height - 0.5)
    if min(size) > 1:
        (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
        valid &= x_right * y_down - x_down * y_right > 0
        # Farther out a polynomial that has passed zero shows the other side of the image, upside down but not as in a mirror.
        middle_x, middle_y = matrix[:2, 2]
        rows, columns = np.mgrid[: lens.height, : lens.width]
        valid &= (x - middle_x) * (columns - middle_x) + (y - middle_y) * (rows - middle_y) >= 0
    return x, y, valid
