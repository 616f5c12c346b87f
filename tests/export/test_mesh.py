"""Temperatures of a mesh's vertices, as another library reads them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData
from test_made_surface import in_fog, on_a_ball

from heatsplat.contracts import SceneError
from heatsplat.export.formats import mesh
from heatsplat.export.formats.mesh import Mesh

trimesh = pytest.importorskip("trimesh")


def test_another_library_reads_what_was_written(cooling, tmp_path):
    scene = cooling.module.scene
    centre, size = scene.bulk
    plane = trimesh.creation.icosphere(2, radius=0.3 * float(size))
    plane.apply_translation(centre.numpy())
    plane.export(tmp_path / "given.obj")
    Mesh(f"{tmp_path}/given.obj", views=8, two_sided=True).write(cooling, tmp_path / "a.ply")
    found = trimesh.load(str(tmp_path / "a.ply"), process=False)
    given = trimesh.load(str(tmp_path / "given.obj"), process=False)
    assert np.allclose(found.vertices, given.vertices) and np.array_equal(found.faces, given.faces)
    values = PlyData.read(tmp_path / "a.ply")["vertex"]["temperature_c"]
    known = np.isfinite(values)
    assert 0 < known.sum() < len(values)
    low, high = scene.thermal_range.min_c, scene.thermal_range.max_c
    assert (values[known] >= low - 1).all() and (values[known] <= high + 1).all()
    colours = found.visual.vertex_colors[:, :3]
    assert set(map(tuple, colours[~known])) <= {(128, 128, 128), (176, 176, 176)}
    with Image.open(tmp_path / "a.png") as picture:
        assert min(picture.size) > 200


def test_a_mesh_is_in_the_coordinates_of_the_data_set(cooling, tmp_path):
    """Where an origin was taken off the scene (UTM, say), the mesh that is given still has it, and so has what is written."""
    scene, origin = cooling.module.scene, np.array([6e5, 5.6e6, 100.0])
    sphere = trimesh.creation.icosphere(2, radius=0.3 * float(scene.bulk[1]))
    sphere.apply_translation(scene.bulk[0].numpy())
    sphere.export(tmp_path / "near.obj", digits=9)
    sphere.apply_translation(origin)
    sphere.export(tmp_path / "far.obj", digits=9)
    moved = SimpleNamespace(
        scene=replace(scene, notes={**scene.notes, "origin": origin.tolist()}), renderer=cooling.module.renderer
    )
    Mesh(f"{tmp_path}/near.obj", views=4, two_sided=True).write(cooling, tmp_path / "a.ply")
    Mesh(f"{tmp_path}/far.obj", views=4, two_sided=True).write(replace(cooling, module=moved), tmp_path / "b.ply")
    near, far = (PlyData.read(tmp_path / name)["vertex"] for name in ("a.ply", "b.ply"))
    assert np.allclose(far["x"] - near["x"], origin[0], atol=1e-6)
    assert np.allclose(near["temperature_c"], far["temperature_c"], atol=0.05, equal_nan=True)


@pytest.mark.parametrize("views", [0, 1.5, "abc"])
def test_what_is_no_number_of_views_is_refused(views):
    with pytest.raises(SceneError, match=f"what.views must be a whole number, 1 or more, got {views}"):
        Mesh("given.obj", views=views)


def test_what_cannot_be_seen_or_read_is_said(cooling, tmp_path):
    (tmp_path / "no.ply").write_text("nothing")
    with pytest.raises(SceneError, match=r"no.ply cannot be read as a mesh"):
        Mesh(str(tmp_path / "no.ply")).write(cooling, tmp_path / "a.ply")
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(SceneError, match=r"points.ply has no faces: a mesh is made of triangles"):
        Mesh(str(tmp_path / "points.ply")).write(cooling, tmp_path / "a.ply")
    far = trimesh.creation.box()
    far.apply_translation([1e4, 0, 0])
    far.export(tmp_path / "far.ply")
    with pytest.raises(SceneError, match=r"no training view sees any of its 8 vertices"):
        Mesh(str(tmp_path / "far.ply"), views=2).write(cooling, tmp_path / "a.ply")


def test_why_most_vertices_have_no_temperature_is_said(cooling, tmp_path, caplog):
    scene = cooling.module.scene
    near = trimesh.creation.icosphere(2, radius=0.3 * float(scene.bulk[1]))
    near.apply_translation(scene.bulk[0].numpy())
    far = trimesh.creation.icosphere(3)
    far.apply_translation([1e4, 0, 0])
    trimesh.util.concatenate([near, far]).export(tmp_path / "both.ply")
    Mesh(str(tmp_path / "both.ply"), views=4, two_sided=True).write(cooling, tmp_path / "a.ply")
    assert "most vertices have no temperature, as no view has them within 5 % of the distance" in caplog.text


def test_vertices_of_a_given_mesh_have_temperatures_through_fog(cooling, tmp_path, monkeypatch):
    """Faint Gaussians before a ball move its mean depth by more than 5 % of the distance, from some cameras on."""
    ball, centre, radius = on_a_ball(cooling)
    foggy = in_fog(ball, centre, radius, opacity=0.06)
    sphere = trimesh.creation.icosphere(3, radius=radius)
    sphere.apply_translation((centre + ball.module.scene.origin).numpy())
    sphere.export(tmp_path / "ball.ply")
    one = replace(foggy, module=SimpleNamespace(scene=_first_view(ball.module.scene), renderer=ball.module.renderer))
    Mesh(str(tmp_path / "ball.ply")).write(one, tmp_path / "a.ply")
    values = PlyData.read(tmp_path / "a.ply")["vertex"]["temperature_c"]
    monkeypatch.setattr(mesh, "closest", lambda moment, view: (torch.zeros_like(moment.look(view).depth), None))
    Mesh(str(tmp_path / "ball.ply")).write(one, tmp_path / "mean.ply")
    by_mean = PlyData.read(tmp_path / "mean.ply")["vertex"]["temperature_c"]
    known, before = np.isfinite(values), np.isfinite(by_mean)
    assert (values[before] == by_mean[before]).all()
    away = (sphere.vertices - (centre + ball.module.scene.origin).numpy())[:, 0] / radius
    truth = ball.of_blended(torch.from_numpy(0.5 + 0.3 * away)).numpy()
    assert known.sum() > 1.5 * before.sum() and np.abs(values - truth)[known].mean() < 0.05 * np.ptp(truth)


def _first_view(scene):
    return replace(scene, train=scene.train.subset([0]))
