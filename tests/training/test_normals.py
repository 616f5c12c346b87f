"""Normals of surfaces against truth on yard and room: which side area faces, and what keeps them up to date."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from heatsplat.contracts import ViewSet
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.renderers.settings import Renderer
from heatsplat.training.normals import Normals

YARD, ROOM = "outdoor", "cooling"


@cache
def world(name: str):
    return OutdoorScene(OUTDOOR[name]) if name in OUTDOOR else Scene(PRESETS[name])


@cache
def data(name: str, size: str = "tiny"):
    return Synthetic(scene=name, size=size).scene


@cache
def looked(name: str):
    """Normals of the scene's points, and true ones."""
    scene, normals = data(name), Normals()
    found = normals.prepare(scene, Renderer("cpu"), scene.points)
    on, which = world(name).nearest(scene.points)
    return normals, found, world(name).normals(on, which).float()


@pytest.mark.parametrize("name", [YARD, ROOM])
def test_points_face_the_side_from_which_they_are_seen(name):
    _, found, truth = looked(name)
    assert torch.allclose(found.norm(dim=1), torch.ones(len(found)), atol=1e-5)
    cosines = (found * truth).sum(1)
    assert (cosines < 0).float().mean() < 0.02
    assert cosines.median() > 0.95


def test_walls_of_a_house_inside_an_orbit_do_not_face_inwards():
    """By the mean of the cameras, which stands in the middle of the house, all of them do."""
    _, found, truth = looked(YARD)
    scene = data(YARD)
    walls = truth[:, 2].abs() < 0.3
    middle = torch.stack([frame.camera.center for frame in scene.train.frames]).mean(0).float()
    turned = ((middle - scene.points) * truth).sum(1) < 0
    assert walls.sum() > 30 and turned[walls].float().mean() > 0.3
    assert ((found * truth).sum(1)[walls & turned] < 0).float().mean() < 0.05


def test_a_gaussian_faces_as_what_it_depicts_wherever_it_lies_along_the_line_of_sight():
    """Half way to the only camera, and half as large, the Gaussians show the very same picture."""
    scene = data(YARD)
    normals = Normals(views=1)
    found = normals.prepare(scene, Renderer("cpu"), scene.points)
    centre = scene.train.frames[0].camera.center.float()

    def shown(share: float):
        means = centre + share * (scene.points - centre)
        shapes = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1), torch.full((len(means), 3), 0.15 * share)

        def show(frame, values, depth=False, ratio=1.0, camera=None):
            opacities = torch.full((1, len(means)), 0.9)
            return Renderer("cpu")(
                means, *shapes, opacities, values, frame.camera, None, (values.shape[1],), depth=depth, ratio=ratio
            )

        return normals.look(show, found)

    far, near = shown(1.0), shown(0.5)
    assert (far * near).sum(1).min() > 0.99
    assert (far - found).norm(dim=1).max() > 0.1  # it is not simply what they had before


def test_what_no_view_shows_keeps_its_normal():
    scene = data(ROOM)
    normals, found, _ = looked(ROOM)

    def hidden(frame, values, depth=False, ratio=1.0, camera=None):
        means = scene.points + 1e3
        shapes = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1), torch.full((len(means), 3), 0.01)
        opacities = torch.full((1, len(means)), 0.9)
        return Renderer("cpu")(
            means, *shapes, opacities, values, frame.camera, None, (values.shape[1],), depth=depth, ratio=ratio
        )

    assert torch.equal(normals.look(hidden, found), found)


@pytest.mark.parametrize("options", [{"views": 0}, {"side": 0}, {"neighbours": 2}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ValueError, match=r"normals\.views"):
        Normals(**options)


def test_images_of_a_few_rows_are_looked_at_too():
    scene = data(ROOM)
    frames = [replace(frame, camera=frame.camera.resized(4 * frame.camera.width, 1)) for frame in scene.train.frames]
    wide = replace(scene, train=ViewSet(frames, scene.train.__getitem__))
    assert Normals(side=64).prepare(wide, Renderer("cpu"), scene.points).isfinite().all()
