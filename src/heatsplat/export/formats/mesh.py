"""A mesh, given or made of the splats, with the temperature of its vertices."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, View, check_count, check_numbers, evenly_spread
from heatsplat.export.formats.base import Format, checked_range, optional
from heatsplat.export.made_surface import closest, made_surface
from heatsplat.export.mesh_picture import pictured
from heatsplat.export.moment import Moment
from heatsplat.geometry.coverage import DEPTH_TOLERANCE
from heatsplat.geometry.fusion import Surface
from heatsplat.geometry.looks import Look, values_at
from heatsplat.io.pictures import IMAGE_VALUES, Bar, checked_colormap, colorize, write_png

log = logging.getLogger("heatsplat")


def _looks(moment: Moment, views: Sequence[View], depths: Sequence[Tensor]) -> list[Look]:
    """What the cameras of views see, with depths [H, W] of their own."""
    return [replace(moment.look(view), depth=depth) for view, depth in zip(views, depths, strict=True)]


class Mesh(Format):
    """PLY of a mesh in the coordinates of the data set, with °C and a colour at each vertex; a picture (.png) lies beside it.

    A vertex has the mean of the training views that see it: it lies in their image where that counts, the scene's surface stands
    there in it, and its outward normal points towards them. Those that no view sees have NaN, and grey.

    Args:
        mesh: file that trimesh reads (PLY, OBJ, STL, GLB ...); None makes a mesh of what the splats show the training views
            (``export.made_surface``).
        views: training views that are asked, spread evenly; None takes all.
        colormap: name of a matplotlib map.
        range_c: °C at the ends of the map; None takes the scene's range.
        two_sided: normals are not to be trusted: every camera is before every face. Of a mesh that is given.
        voxel, truncation, smoothing, least_piece: as of ``export.made_surface.made_surface``, of a mesh that is made.
    """

    suffix = ".ply"
    from_origin = False

    def __init__(
        self,
        mesh: str | None = None,
        views: int | None = None,
        colormap: str = "inferno",
        range_c: Sequence[float] | None = None,
        two_sided: bool = False,
        voxel: float | None = None,
        truncation: float | None = None,
        smoothing: int = 50,
        least_piece: float = 0.001,
    ) -> None:
        if views is not None:
            check_count("what.views", views)
        if voxel is not None:
            check_numbers("what.voxel", voxel, error=SceneError, above=0)
        if truncation is not None:
            check_numbers("what.truncation", truncation, error=SceneError)
        check_count("what.smoothing", smoothing, least=0)
        check_numbers("what.least_piece", least_piece, error=SceneError)
        if truncation is not None and truncation < 2:
            raise SceneError(f"what.truncation must be 2 voxels or more, got {truncation:g}")
        if not 0 <= least_piece <= 1:
            raise SceneError(f"what.least_piece must be a share of the area, from 0 to 1, got {least_piece:g}")
        if mesh is None and two_sided:
            raise SceneError(
                "what.two_sided=true is for a mesh that you give (what.mesh=FILE): one that is made has outward normals"
            )
        if mesh is not None and voxel is not None:
            raise SceneError("what.voxel is for a mesh that is made: leave out what.mesh, or what.voxel")
        self.mesh, self.views, self.two_sided = None if mesh is None else Path(mesh).expanduser(), views, two_sided
        self.voxel, self.truncation = voxel, truncation
        self.smoothing, self.least_piece = smoothing, least_piece
        self.colormap, self.range_c = checked_colormap("what.colormap", colormap), checked_range(range_c)
        self.of_gaussians = mesh is None

    def write(self, moment: Moment, path: Path) -> None:
        scene = moment.module.scene
        views = [scene.train[i] for i in evenly_spread(len(scene.train), self.views or len(scene.train))]
        if self.mesh is None:
            surface, depths = made_surface(moment, views, self.voxel, self.truncation, self.smoothing, self.least_piece)
            normals = surface.normals()
            values = values_at(_looks(moment, views, depths), surface.vertices, normals)
        else:
            surface, normals = self._given(scene)
            values = self._of_given(moment, views, surface.vertices, None if self.two_sided else normals)
        self._say_seen(values, len(views))
        low, high = self.range_c or moment.seen.limits
        colours = colorize(values[:, None], low, high, self.colormap)[:, 0]
        name = f"{moment.quantity}_c" if moment.seen.unit else moment.quantity
        kinds = [(axis, "f8") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")] + [(name, "f4")]
        vertices = np.empty(len(values), dtype=kinds)
        places = surface.vertices + scene.origin
        for column, content in zip(vertices.dtype.names, (*places.T, *colours.T, values), strict=True):
            vertices[column] = content
        faces = np.empty(len(surface.faces), dtype=[("vertex_indices", "i4", (3,))])
        faces["vertex_indices"] = surface.faces
        elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(elements, byte_order="<").write(str(path))
        bar = Bar(low, high, moment.seen.unit or IMAGE_VALUES, colormap=self.colormap)
        write_png(path.with_suffix(".png"), pictured(surface, values, scene, bar))

    def _given(self, scene: SceneData) -> tuple[Surface, Tensor]:
        """The mesh that is given, in the world, and normals [V, 3]. Raises SceneError where it cannot be read."""
        trimesh = optional("trimesh", "mesh")
        try:
            given = trimesh.load(str(self.mesh), force="mesh", process=False)
        except Exception as error:  # every reader of trimesh raises its own
            raise SceneError(f"what.mesh={self.mesh} cannot be read as a mesh: {error}") from error
        if not len(given.faces):
            raise SceneError(
                f"what.mesh={self.mesh} has no faces: a mesh is made of triangles. For points with temperatures of their own see "
                "what=las"
            )
        points, normals, faces = (
            torch.from_numpy(np.array(part)) for part in (given.vertices, given.vertex_normals, given.faces)
        )
        return Surface(points.double() - scene.origin, faces.long()), normals

    def _of_given(self, moment: Moment, views: Sequence[View], points: Tensor, normals: Tensor | None) -> Tensor:
        """Values [V] of points of a mesh that is given.

        The mean depth tells which views see one. Opacity before or behind a surface moves it off, so that no view may: then the
        depth where opacity lies closest does. Where the mean depth tells, values are a little better by it: 0.39 instead of
        0.44 °C on "static", 0.224 instead of 0.227 on "cooling" (1,000 steps).
        """
        values = values_at([moment.look(view) for view in views], points, normals)
        left = ~values.isfinite()
        if left.any():
            able = [view for view in views if view.camera.inside(*view.camera.project(points[left])).any()]
            looks = _looks(moment, able, [closest(moment, view)[0] for view in able])
            values[left] = values_at(looks, points[left], None if normals is None else normals[left])
        return values

    def _say_seen(self, values: Tensor, views: int) -> None:
        """Logs how many vertices have a value. Raises SceneError where none has."""
        count, of = int(values.isfinite().sum()), f"what.mesh={self.mesh}: " if self.mesh else ""
        if not count:
            raise SceneError(
                f"{of}no training view sees any of its {len(values)} vertices. Is it in the coordinates of the scene, and do its "
                "normals point outward (what.two_sided=true takes them as they are)?"
                if self.mesh
                else "the images of the training views count nowhere on the mesh (their masks leave it out)"
            )
        log.info("%d of %d vertices are seen by %d views", count, len(values), views)
        if count < len(values) / 2:
            log.warning(
                "%smost vertices have no temperature, as no view has them within %.0f %% of the distance at which "
                "the splats show a surface%s", of, 100 * DEPTH_TOLERANCE,
                "" if self.two_sided or not self.mesh else ", on the side of their normals (what.two_sided=true takes both)",
            )  # fmt: skip
