"""Some pixels of a view in every step, for renderers whose cost is by the pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from heatsplat.contracts import Camera, View
from heatsplat.training.resolution import Resolution
from heatsplat.training.rng import generator_for


class Lattice(Resolution):
    """Every s-th pixel of every s-th row, from a place that is drawn anew for every step.

    What is left of a view is a view of a camera with larger pixels far apart: the lines of sight through their middles are
    those of the pixels that were taken. s is the smallest stride at which no more than ``rays`` pixels are left.

    Args:
        rays: pixels of a step.

    Raises:
        ValueError: there is none.
    """

    whole = False

    def __init__(self, rays: int = 1024) -> None:
        if rays < 1:
            raise ValueError(f"schedule.rays must be at least 1, got {rays}")
        self.rays = rays

    def chosen(self, view: View, step: int, seed: int) -> View:
        camera = view.camera
        stride = max(1, math.ceil(math.sqrt(camera.width * camera.height / self.rays) - 1e-9))
        stride = min(stride, camera.width, camera.height)
        left, top = torch.randint(stride, (2,), generator=generator_for(seed, step, "lattice")).tolist()
        images = {name: getattr(view, name) for name in ("thermal", "rgb", "mask", "clean", "ends")}
        taken = {name: image[top::stride, left::stride] for name, image in images.items() if image is not None}
        return replace(view, frame=replace(view.frame, camera=_sparse(camera, stride, left, top)), **taken)


def _sparse(camera: Camera, stride: int, left: int, top: int) -> Camera:
    """The camera whose pixels have the middles of every ``stride``-th pixel from (left, top) on."""
    K = camera.K.clone()
    K[:2] /= stride
    K[0, 2] = (camera.K[0, 2] - left - 0.5) / stride + 0.5
    K[1, 2] = (camera.K[1, 2] - top - 0.5) / stride + 0.5
    return Camera(camera.viewmat, K, -(-(camera.width - left) // stride), -(-(camera.height - top) // stride))
