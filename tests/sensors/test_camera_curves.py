"""A response that never falls, and histograms that are brought to one and back."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.sensors.histogram_alignment import HistogramAlignment
from heatsplat.sensors.monotone_response import MonotoneResponse

CAMERA = Camera(torch.eye(4), torch.eye(3), 24, 16)
SCENE_IMAGE = torch.rand(16, 24, 1, generator=torch.Generator().manual_seed(0)) ** 1.5


def test_a_new_response_is_the_identity():
    image = torch.linspace(-0.3, 1.3, 384).reshape(16, 24, 1)
    part = MonotoneResponse()
    assert torch.allclose(part(image, Frame("0.png", 0, CAMERA)), image, atol=1e-6)
    assert part.regulariser().item() == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="2 pieces"):
        MonotoneResponse(1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-6, 6), min_size=5, max_size=5))
def test_no_response_falls_or_moves_its_ends(rises):
    part = MonotoneResponse(pieces=5)
    with torch.no_grad():
        part.rises.copy_(torch.tensor(rises))
    image = torch.linspace(-0.5, 1.5, 401)[:, None, None]
    shown = part(image, Frame("0.png", 0, CAMERA))[:, 0, 0]
    assert (shown.diff() >= 0).all()
    assert torch.allclose(shown[[100, 300]], torch.tensor([0.0, 1.0]), atol=1e-6)
    assert torch.allclose(shown[[0, 400]], torch.tensor([-0.5, 1.5]), atol=1e-6)


def gradients_of(part, image):
    image = image.clone().double().requires_grad_()
    part = part.double()
    return torch.autograd.gradcheck(lambda values: part(values, Frame("0.png", 0, CAMERA)), image, eps=1e-7)


def test_gradients_of_the_response_are_those_of_differences():
    part = MonotoneResponse(pieces=4)
    with torch.no_grad():
        part.rises.copy_(torch.tensor([0.3, -0.5, 1.0, 0.0]))
    assert gradients_of(part, torch.tensor([-0.2, 0.11, 0.37, 0.62, 0.93, 1.2])[:, None, None])


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
