"""A picture of a mesh from above and aside: its temperatures, and its shape."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Camera, SceneData, quantile
from heatsplat.export.place import place_of
from heatsplat.geometry.fusion import Surface
from heatsplat.geometry.projection import look_at, to_camera
from heatsplat.geometry.shown_faces import shown_faces
from heatsplat.io.pictures import Bar, Panel, colorize, compose

LONGEST = 900  # pixels of a panel's longer side
ASLANT_DEG = 40.0  # of the line of sight below the horizon
AWAY = 4.0  # half diagonals of the mesh between it and the eye
WHOLE = 0.002, 0.998  # quantiles of the vertices that lie in the picture
MARGIN = 0.03  # of the longer side
DARK = 0.25  # of surfaces that are seen from their side
ASIDE = 0.3  # length across the vertical of the mean way to the cameras, of length 1, from which they stand on one side


def pictured(surface: Surface, values: Tensor, scene: SceneData, bar: Bar) -> np.ndarray:
    """Values of a mesh in the colours of a bar, and its shape in grey beside it, uint8 RGB: from the side where the cameras
    stand, else from the south. Triangles that are seen from inside, such as near walls of a room, are left out.

    Args:
        surface: in the world.
        values: [V] of its vertices; NaN is hatched.
        scene: whose cameras and directions these are.
    """
    camera = _aslant(surface, scene)
    shown = shown_faces(camera, surface)
    crosses = torch.nn.functional.normalize(surface.crosses(), dim=1)
    facing = -(crosses @ camera.viewmat[2, :3])  # a headlight
    empty = (shown < 0).numpy()
    of_faces = torch.nanmean(values[surface.faces], dim=1)
    temperature = colorize(of_faces[shown], bar.low, bar.high, bar.colormap)
    light = (DARK + (1 - DARK) * facing.clamp(0, 1))[shown].numpy()
    shape = np.repeat((230 * light).astype(np.uint8)[..., None], 3, axis=2)
    for image in (temperature, shape):
        image[empty] = 255
    return compose(
        [
            Panel(temperature, "temperature" if bar.unit == "°C" else "value", bar.of(values.numpy())),
            Panel(shape, "shape"),
        ]
    )


def _aslant(surface: Surface, scene: SceneData) -> Camera:
    """A camera of long focal length whose image the mesh fills."""
    east, north, up = place_of(scene).similarity.rotation
    low, high = (quantile(surface.vertices, share) for share in WHOLE)
    middle = 0.5 * (low + high)
    radius = max(float((high - low).norm()) / 2, 1e-12)
    ways = torch.stack([frame.camera.center for frame in scene.train.frames]) - middle
    mean = torch.nn.functional.normalize(ways, dim=1).mean(0)
    across = mean - (mean @ up) * up
    aside = across / across.norm() if across.norm() > ASIDE else -north
    aslant = math.radians(ASLANT_DEG)
    eye = middle + AWAY * radius * (math.cos(aslant) * aside + math.sin(aslant) * up)
    viewmat = look_at(eye, middle, up)
    local = to_camera(surface.vertices, viewmat)
    places = local[:, :2] / local[:, 2:].clamp(min=1e-3 * radius)
    first, last = (quantile(places, share) for share in WHOLE)
    span = (last - first).clamp(min=1e-9)
    focal = LONGEST * (1 - 2 * MARGIN) / float(span.max())
    width, height = (max(64, round(focal * float(side) + 2 * MARGIN * LONGEST)) for side in span)
    centre = torch.tensor([width, height]) / 2 - focal * (first + last) / 2
    K = torch.tensor([[focal, 0, float(centre[0])], [0, focal, float(centre[1])], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)
