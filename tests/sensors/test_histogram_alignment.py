"""Histograms that are brought to one and back: exact for a camera that drifts, reversible where an image is flat."""

from dataclasses import replace

import pytest
import torch
from few_sorted import with_few_sorted

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, View, ViewSet
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.histogram_alignment import HistogramAlignment

CAMERA = Camera(torch.eye(4), torch.eye(3), 24, 16)
SCENE_IMAGE = torch.rand(16, 24, 1, generator=torch.Generator().manual_seed(0)) ** 1.5


def drifted(count=5, gain=0.1):
    """A scene whose camera shows g v + o of the same surfaces, another g and o in every image."""
    frames = [Frame(f"{i}.png", i, CAMERA, float(i)) for i in range(count)]
    images = [(1 - gain * i) * SCENE_IMAGE + 0.05 * i for i in range(count)]
    views = ViewSet(frames, lambda i: View(frames[i], images[i]))
    held = [Frame("between.png", 99, CAMERA, 1.5)]
    test = ViewSet(held, lambda i: View(held[i], (images[1] + images[2]) / 2))
    return SceneData("flight", views, test, test, torch.zeros(4, 3)), images


def test_what_one_image_shows_of_another_s_clean_picture_is_that_image():
    scene, images = drifted()
    part = HistogramAlignment(quantiles=17)
    part.prepare(scene)
    clean = torch.stack(images).mean(0)  # the same surfaces with the mean histogram
    for frame, image in zip(scene.train.frames, images, strict=True):
        assert torch.allclose(part(clean, frame), image, atol=1e-5)
    between = scene.test[0]
    assert torch.allclose(part(clean, between.frame), between.thermal, atol=1e-5)
    assert list(part.parameters()) == [] and part.regulariser() is None


def test_no_strength_is_no_change_and_flat_images_stay_reversible():
    scene, images = drifted()
    part = HistogramAlignment(strength=0.0)
    part.prepare(scene)
    assert torch.allclose(part(images[0], scene.train.frames[3]), images[0], atol=1e-6)
    flat = ViewSet(scene.train.frames, lambda i: View(scene.train.frames[i], torch.full((16, 24, 1), 0.1 * i)))
    part = HistogramAlignment()
    part.prepare(SceneData("wall", flat, flat, flat, torch.zeros(4, 3)))
    shown = part(torch.linspace(0, 1, 50)[:, None, None], scene.train.frames[2])
    assert (shown.diff(dim=0) > 0).all()
    with pytest.raises(ValueError, match="strength"):
        HistogramAlignment(strength=2.0)


def test_large_images_have_histograms(monkeypatch):
    scene, images = drifted()
    known = HistogramAlignment()
    known.prepare(scene)
    with_few_sorted(monkeypatch, 100)
    part = HistogramAlignment()
    part.prepare(scene)
    assert torch.allclose(part.own, known.own) and torch.allclose(part.shared, known.shared)


def test_an_image_that_its_mask_hides_has_the_histogram_of_all():
    scene, images = drifted()
    hidden = torch.zeros(16, 24, dtype=torch.bool)
    views = ViewSet(
        scene.train.frames, lambda i: View(scene.train.frames[i], images[i], mask=hidden if i == 2 else None)
    )
    part = HistogramAlignment()
    part.prepare(replace(scene, train=views))
    assert torch.allclose(part(images[0], scene.train.frames[2]), images[0], atol=1e-5)
    assert not torch.allclose(part(images[0], scene.train.frames[4]), images[0], atol=1e-2)
    views = ViewSet(scene.train.frames, lambda i: View(scene.train.frames[i], images[i], mask=hidden))
    with pytest.raises(SceneError, match="masks leave no pixel of the training images of scene 'flight'"):
        HistogramAlignment().prepare(replace(scene, train=views))


def test_of_two_kinds_of_images_those_are_aligned_that_it_makes():
    scene, images = drifted()
    photos = [torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(1)) * (1 - 0.1 * i) for i in range(5)]
    frames = scene.train.frames
    part = HistogramAlignment(quantiles=17)
    SensorChain({"alignment": part}).prepare(
        replace(scene, train=ViewSet(frames, lambda i: View(frames[i], images[i], rgb=photos[i]))), "rgb"
    )
    own, alone = part.own.clone(), HistogramAlignment(quantiles=17)
    views = ViewSet(frames, lambda i: View(frames[i], None, rgb=photos[i]))
    alone.prepare(replace(scene, train=views), "rgb")
    assert torch.equal(own, alone.own)
    mean = torch.stack([photo.flatten().quantile(torch.linspace(0, 1, 17)) for photo in photos]).mean(0)
    assert torch.allclose(part.shared, mean, atol=1e-6)
    with pytest.raises(SceneError, match="view 0.png has no thermal image; choose a method or data set that fits"):
        HistogramAlignment().prepare(replace(scene, train=views))
