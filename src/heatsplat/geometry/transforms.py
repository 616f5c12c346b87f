"""Cameras in nerfstudio's transforms.json, which most programs of the field read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from heatsplat.contracts import Camera

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # from camera axes of OpenCV to those of OpenGL and back


def camera_entry(camera: Camera, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """What a frame of transforms.json says of its camera: w, h, fl_x, fl_y, cx and cy in pixels, and transform_matrix, from
    the camera to the world in OpenGL axes (x right, y up, z back).

    Args:
        camera: without distortion, as all are here.
        origin: what was taken off the coordinates of the data set, and is added again.
    """
    K, to_world = camera.K, np.linalg.inv(camera.viewmat.detach().numpy())
    to_world[:3, 3] += origin
    return {
        "w": camera.width, "h": camera.height, "fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": K[0, 2].item(),
        "cy": K[1, 2].item(), "transform_matrix": (to_world @ OPENGL_AXES).tolist(),
    }  # fmt: skip
