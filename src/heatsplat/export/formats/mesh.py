"""A mesh that is given, with the temperature of its vertices."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from heatsplat.contracts import SceneError, check_count, evenly_spread
from heatsplat.export.formats.base import Format, checked_range, optional
from heatsplat.export.moment import Moment
from heatsplat.geometry.coverage import DEPTH_TOLERANCE
from heatsplat.geometry.looks import values_at
from heatsplat.io.pictures import checked_colormap, colorize

log = logging.getLogger("heatsplat")


class Mesh(Format):
    """PLY of a mesh in the coordinates of the scene, with °C and a colour at each vertex.

    A vertex has the mean of the training views that see it: it lies in their image where that counts, before it stands nothing
    of the scene, and its outward normal points towards them. Those that no view sees have NaN, and grey.

    Args:
        mesh: file that trimesh reads (PLY, OBJ, STL, GLB ...).
        views: training views that are asked, spread evenly; None takes all.
        colormap: name of a matplotlib map.
        range_c: °C at the ends of the map; None takes the scene's range.
        two_sided: normals are not to be trusted: every camera is before every face.
    """

    suffix = ".ply"
    from_origin = False
    of_gaussians = False

    def __init__(
        self,
        mesh: str | None = None,
        views: int | None = None,
        colormap: str = "inferno",
        range_c: Sequence[float] | None = None,
        two_sided: bool = False,
    ) -> None:
        if mesh is None:
            raise SceneError(
                "which mesh? Give what.mesh=FILE, in the coordinates of the scene. Programs such as OpenMVS or Metashape make "
                "one of the same images and cameras, Open3D or MeshLab one of the points of what=las (Poisson)"
            )
        if views is not None:
            check_count("what.views", views)
        self.mesh, self.views, self.two_sided = Path(mesh).expanduser(), views, two_sided
        self.colormap, self.range_c = checked_colormap("what.colormap", colormap), checked_range(range_c)

    def write(self, moment: Moment, path: Path) -> None:
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
        points, normals = (torch.from_numpy(np.array(part)) for part in (given.vertices, given.vertex_normals))
        scene = moment.module.scene
        chosen = evenly_spread(len(scene.train), len(scene.train) if self.views is None else self.views)
        looks = [moment.look(scene.train[i]) for i in chosen]
        values = values_at(looks, points - scene.origin, None if self.two_sided else normals)
        if not values.isfinite().any():
            raise SceneError(
                f"what.mesh={self.mesh}: no training view sees any of its {len(points)} vertices. Is it in the coordinates of "
                "the scene, and do its normals point outward (what.two_sided=true takes them as they are)?"
            )
        count = int(values.isfinite().sum())
        log.info("%d of %d vertices are seen by %d views", count, len(points), len(looks))
        if count < len(points) / 2:
            log.warning(
                "what.mesh=%s: most vertices have no temperature, as no view has them within %.0f %% of the distance at which "
                "the splats show a surface%s", self.mesh, 100 * DEPTH_TOLERANCE,
                "" if self.two_sided else ", on the side of their normals (what.two_sided=true takes both)",
            )  # fmt: skip
        colours = colorize(values[:, None], *(self.range_c or moment.seen.limits), self.colormap)[:, 0]
        name = f"{moment.quantity}_c" if moment.seen.unit else moment.quantity
        kinds = [(axis, "f8") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")] + [(name, "f4")]
        vertices = np.empty(len(points), dtype=kinds)
        for column, content in zip(vertices.dtype.names, (*points.T, *colours.T, values), strict=True):
            vertices[column] = content
        faces = np.empty(len(given.faces), dtype=[("vertex_indices", "i4", (3,))])
        faces["vertex_indices"] = given.faces
        elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
        PlyData(elements, byte_order="<").write(str(path))
