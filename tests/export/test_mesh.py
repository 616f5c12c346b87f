"""Temperatures of a mesh's vertices: what stands before them hides them, and another library reads the file."""

import numpy as np
import pytest
import torch
from plyfile import PlyData

from heatsplat.contracts import Camera, SceneError
from heatsplat.export.formats.mesh import Mesh
from heatsplat.geometry.looks import Look, values_at

trimesh = pytest.importorskip("trimesh")


def before_a_wall(x: float) -> Look:
    """A camera at x that looks along z at a wall of 10 °C in z = 4, before whose right half a screen of 30 °C hangs in z = 2."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    K = torch.tensor([[80.0, 0, 80], [0, 80.0, 40], [0, 0, 1]], dtype=torch.float64)
    columns = (torch.arange(160) + 0.5 - 80) / 80
    screen = (x + 2 * columns > 0).expand(80, 160)
    depth = torch.where(screen, 2.0, 4.0).double()
    return Look(Camera(viewmat, K, 160, 80), depth, torch.where(screen, 30.0, 10.0).double())


def test_what_hides_a_point_does_not_colour_it():
    points = torch.tensor([[-1.0, 0, 4], [1.0, 0, 4], [0.5, 0, 2], [0.5, 0, 2], [0, 0, -1]], dtype=torch.float64)
    towards, away = [0.0, 0, -1], [0.0, 0, 1]
    normals = torch.tensor([towards, towards, towards, away, towards], dtype=torch.float64)
    found = values_at([before_a_wall(0.0)], points, normals)
    assert found[0] == 10 and found[2] == 30
    assert found[[1, 3, 4]].isnan().all()  # behind the screen; turned away; behind the camera
    # from the left one looks behind the screen
    assert values_at([before_a_wall(0.0), before_a_wall(-2.0)], points, normals)[1] == 10
    assert values_at([before_a_wall(0.0)], points)[3] == 30


def test_another_library_reads_what_was_written(cooling, tmp_path):
    scene = cooling.module.scene
    centre, size = scene.bulk
    plane = trimesh.creation.icosphere(2, radius=0.3 * float(size))
    plane.apply_translation(centre.numpy())
    plane.export(tmp_path / "given.obj")
    Mesh(f"{tmp_path}/given.obj", views=8, two_sided=True).write(cooling, tmp_path / "a.ply")
    mesh = trimesh.load(str(tmp_path / "a.ply"), process=False)
    given = trimesh.load(str(tmp_path / "given.obj"), process=False)
    assert np.allclose(mesh.vertices, given.vertices) and np.array_equal(mesh.faces, given.faces)
    values = PlyData.read(tmp_path / "a.ply")["vertex"]["temperature_c"]
    known = np.isfinite(values)
    assert 0 < known.sum() < len(values)
    low, high = scene.thermal_range.min_c, scene.thermal_range.max_c
    assert (values[known] >= low - 1).all() and (values[known] <= high + 1).all()
    colours = mesh.visual.vertex_colors[:, :3]
    assert set(map(tuple, colours[~known])) <= {(128, 128, 128), (176, 176, 176)}


def test_what_cannot_be_seen_or_read_is_said(cooling, tmp_path):
    with pytest.raises(SceneError, match=r"Give what.mesh=FILE"):
        Mesh()
    (tmp_path / "no.ply").write_text("nothing")
    with pytest.raises(SceneError, match=r"no.ply cannot be read as a mesh"):
        Mesh(str(tmp_path / "no.ply")).write(cooling, tmp_path / "a.ply")
    far = trimesh.creation.box()
    far.apply_translation([1e4, 0, 0])
    far.export(tmp_path / "far.ply")
    with pytest.raises(SceneError, match=r"no training view sees any of its 8 vertices"):
        Mesh(str(tmp_path / "far.ply"), views=2).write(cooling, tmp_path / "a.ply")
