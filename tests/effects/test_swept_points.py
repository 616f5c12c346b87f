"""Scenes without points of their own: what their images show takes the place of random points."""

from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.datamodules.points import random_points, told_random
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.effects import swept_points as module
from heatsplat.effects.base import Verdict
from heatsplat.effects.catalogue import CATALOGUE, decide
from heatsplat.effects.swept_points import swept_points, with_swept_points


def without_points(name: str) -> SceneData:
    scene = Synthetic(scene=name, size="tiny").scene
    points = random_points([frame.camera.viewmat.double().numpy() for frame in scene.train.frames], 5000, 0)
    notes = scene.notes | told_random(len(points), "")
    return replace(scene, points=torch.from_numpy(points).float(), point_colors=None, notes=notes)


@pytest.fixture(scope="module")
def cooling() -> SceneData:
    return without_points("cooling")


@pytest.fixture(scope="module")
def swept(cooling) -> torch.Tensor:
    return swept_points(cooling)


def test_points_lie_on_surfaces_of_a_scene_that_cools_meanwhile(swept):
    points = swept
    on_surface, _ = Scene(PRESETS["cooling"]).nearest(points)
    away = (on_surface - points).norm(dim=1)  # in metres, from 2.2 m and at 64 pixels a pixel is 3 cm
    assert len(points) > 300 and away.median() < 0.03 and away.quantile(0.8) < 0.06


def test_a_view_of_which_little_counts_takes_no_point_away(cooling, swept):
    """Of nine tenths of its pixels nothing is known; the noise of the scene is that of the other views."""
    few = torch.zeros(52, 64, dtype=torch.bool)
    few[:5] = True
    train = cooling.train
    masked = ViewSet(train.frames, lambda i: replace(train[i], mask=few) if i == 0 else train[i])
    assert len(swept_points(replace(cooling, train=masked))) > 0.7 * len(swept)


def test_images_are_not_swept_where_nothing_is_asked_of_them(cooling, monkeypatch):
    def swept(scene):
        raise AssertionError("a sweep takes longer than most else before training")

    monkeypatch.setattr(module, "swept_points", swept)
    verdicts = decide(cooling, {effect.name: "off" for effect in CATALOGUE if effect.name != "pixel_area"})
    assert not any(verdict.on for verdict in verdicts.values())


def test_pixels_that_no_block_of_the_smaller_images_holds_move_no_point(monkeypatch):
    """Images of 239 pixels become 23 of ten each; the rest is left out, and what is left lies where it did."""
    monkeypatch.setattr(module, "WIDEST", 25)
    monkeypatch.setattr(module, "REFERENCES", 2)
    K = torch.tensor([[200.0, 0.0, 119.5], [0.0, 200.0, 99.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(199) + 0.5, torch.arange(239) + 0.5, indexing="ij")
    views = []
    for i, (right, down) in enumerate([(0.0, 0.0), (0.5, 0.1), (-0.5, 0.2), (0.1, 0.5), (-0.2, -0.5), (0.4, -0.4)]):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.tensor([-right, -down, 4.0])
        across, along = (x - 119.5) / 50.0 + right, (y - 99.5) / 50.0 + down  # on a wall in z = 0, 4 away
        image = 0.5 + 0.2 * torch.sin(3.1 * across + 1.7 * along) + 0.2 * torch.sin(4.3 * along - 2.2 * across + 1.0)
        views.append(View(Frame(f"{i}.png", i, Camera(viewmat, K, 239, 199)), image.float()[..., None]))
    train = ViewSet([view.frame for view in views], views.__getitem__)
    points = swept_points(SceneData("wall", train, train, train, torch.zeros(4, 3)))
    assert len(points) > 100 and abs(points[:, 2].median().item()) < 0.04


def test_a_scene_with_points_keeps_them():
    scene = Synthetic(scene="static", size="tiny").scene
    assert with_swept_points(scene) is scene


def test_effects_are_told_as_with_points_of_the_scene(cooling, swept, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "swept_points", lambda scene: asked.append(scene) or swept)
    assert told(decide(cooling)) == {"relaxation"}
    assert asked == [cooling]  # swept again, the same would be found


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effects"), [("static", set()), ("drifting", {"frame_offset"})])
def test_effects_of_other_scenes_are_told_as_with_points(name, effects):
    assert told(decide(without_points(name))) == effects


def told(verdicts: dict[str, Verdict]) -> set[str]:
    """The effects that are on, each of which the images have to tell."""
    assert all(verdict.told for verdict in verdicts.values() if verdict.on)
    return {effect for effect, verdict in verdicts.items() if verdict.on}


def test_nothing_is_told_where_images_show_no_texture(cooling):
    scene = cooling

    def flat(views: ViewSet) -> ViewSet:
        def decode(position: int) -> View:
            return replace(views[position], thermal=torch.full_like(views[position].thermal, 0.5))

        return ViewSet(views.frames, decode)

    bare = replace(scene, train=flat(scene.train))
    assert len(swept_points(bare)) == 0
    verdicts = decide(bare)
    assert not any(verdict.on for verdict in verdicts.values())
    for effect in ("relaxation", "frame_offset", "vignetting"):
        assert not verdicts[effect].told and "too little texture" in verdicts[effect].reason
