"""Poses of another convention are told by what images and points show, and right ones raise no alarm."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from materials import clean, findings_of

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import material_of
from heatsplat.doctor.checks import conventions
from heatsplat.doctor.checks.conventions import READINGS
from heatsplat.doctor.examination import examine
from heatsplat.geometry.transforms import OPENGL_AXES

MODEL, JSON, OPENCV = (
    "world-to-camera in OpenCV axes",
    "camera-to-world in OpenGL axes",
    "camera-to-world in OpenCV axes",
)
AXES = torch.from_numpy(OPENGL_AXES)


def matrix(viewmat, convention):
    """What a file of a convention holds for a camera."""
    to_world, opengl = READINGS[convention]
    found = AXES @ viewmat if opengl else viewmat
    return torch.linalg.inv(found) if to_world else found


def read(found, convention):
    """The world-to-camera matrix in OpenCV axes that a loader makes of it."""
    to_world, opengl = READINGS[convention]
    found = torch.linalg.inv(found) if to_world else found
    return AXES @ found if opengl else found


def misread(material, written, given, origin=(0.0, 0.0, 0.0)):
    """The material with poses that were written in one convention and are read in another, after which ``origin`` is subtracted
    from the world."""
    place = torch.eye(4, dtype=torch.float64)
    place[:3, 3] = torch.tensor(origin, dtype=torch.float64)

    def seen(cameras):
        views = [read(matrix(camera.viewmat @ torch.linalg.inv(place), written), given) @ place for camera in cameras]
        return [replace(camera, viewmat=view) for camera, view in zip(cameras, views, strict=True)]

    cameras, all_cameras = seen(material.cameras), seen(material.all_cameras)
    return replace(material, cameras=cameras, all_cameras=all_cameras, poses_are=given, origin=origin)


@pytest.mark.parametrize("with_points", [True, False])
@pytest.mark.parametrize(
    ("written", "given"), [(OPENCV, JSON), (MODEL, JSON), (JSON, OPENCV), (JSON, MODEL), (OPENCV, MODEL)]
)
def test_another_convention_is_told_with_points_and_without(written, given, with_points):
    material = clean() if with_points else replace(clean(), points=None)
    (finding,) = findings_of(misread(material, written, given), "conventions")
    assert f"are read as {given}, but look like {written}: read so" in finding.what
    remedy, done = finding.remedy.rpartition("pose: ")[2], {"numpy": np}
    for camera in clean().cameras[:3]:
        done["M"] = matrix(camera.viewmat, written).numpy().copy()
        exec(remedy, done)
        assert np.allclose(read(torch.from_numpy(done["M"]), given), camera.viewmat)


@pytest.mark.parametrize("written", READINGS)
@pytest.mark.parametrize("scene", ["static", "glass", "facade"])
def test_poses_that_are_read_as_they_were_written_raise_no_alarm(scene, written):
    material = misread(clean(scene), written, written)
    assert findings_of(material, "conventions") == []
    assert findings_of(replace(material, points=None), "conventions") == []


def test_other_readings_are_tried_where_one_could_fit_enough_better_alone(monkeypatch):
    asked, fits = [], conventions._fits

    def told(material):
        fitted = fits(material)
        return lambda name: asked.append(name) or fitted(name)

    monkeypatch.setattr(conventions, "_fits", told)
    assert findings_of(clean(), "conventions") == []
    assert asked == [MODEL, conventions.UNMOVED]
    assert len(findings_of(misread(clean(), OPENCV, JSON), "conventions")) == 1
    assert asked[2:4] == [JSON, conventions.UNMOVED] and {*asked[4:]} == {*READINGS} - {JSON}


def test_points_tell_where_images_show_nothing():
    blank = replace(clean(), images=torch.zeros_like(clean().images))
    (finding,) = findings_of(misread(blank, OPENCV, JSON), "conventions")
    assert "of the points lie in view of cameras instead of 0 %" in finding.what
    assert findings_of(blank, "conventions") == []


def test_neighbours_tell_where_the_camera_did_not_turn():
    """As above fields: the camera flies along its own y axis and looks at a wall that lies across."""
    camera = clean().cameras[0]
    pattern = torch.nn.functional.interpolate(
        torch.rand(1, 1, 20, 8, generator=torch.Generator().manual_seed(0)), (160, camera.width), mode="bicubic"
    )[0, 0]
    steps = range(0, 160 - camera.height, 8)
    cameras = []
    for step in steps:
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[1, 3], viewmat[2, 3] = -step / float(camera.K[1, 1]), 0.0
        cameras.append(replace(camera, viewmat=viewmat))
    images = torch.stack([pattern[step : step + camera.height] for step in steps])
    strip = replace(clean(), images=images, cameras=cameras, all_cameras=cameras, points=None, masks=None, times_s=None)
    assert findings_of(strip, "conventions") == []
    (finding,) = findings_of(misread(strip, OPENCV, JSON), "conventions")
    assert f"look like {OPENCV}" in finding.what


def test_what_was_subtracted_from_the_world_is_part_of_its_matrices():
    far = misread(clean(), MODEL, JSON, origin=(3e5, 5e6, 100.0))
    (finding,) = findings_of(far, "conventions")
    assert f"look like {MODEL}" in finding.what


def test_nothing_else_is_said_of_points_under_misread_poses():
    found = examine(misread(clean(), OPENCV, JSON))
    assert [one.check for one in found] == ["conventions"]


def test_a_scene_says_how_its_poses_are_read():
    scene = Synthetic(scene="static", size="tiny").scene
    assert material_of(scene).poses_are == MODEL
    noted = replace(
        scene, notes={**scene.notes, "cameras": "a.json and b.json, OpenGL axes", "origin": [1.0, 2.0, 3.0]}
    )
    material = material_of(noted)
    assert (material.poses_in, material.poses_are) == ("a.json and b.json", JSON)
    assert list(material.origin) == [1.0, 2.0, 3.0]
