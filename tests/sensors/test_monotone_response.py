"""A response that never falls and keeps its ends: against differences, for any of its curves."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Camera, Frame
from heatsplat.sensors.monotone_response import MonotoneResponse

CAMERA = Camera(torch.eye(4), torch.eye(3), 24, 16)


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


def test_gradients_are_the_same_bits_with_any_number_of_threads():
    """Sums over 80,000 pixels, which plain torch shares among threads as they come."""
    generator = torch.Generator().manual_seed(0)
    image, pull = (torch.rand(256, 320, 1, generator=generator) for _ in range(2))
    found, threads = [], torch.get_num_threads()
    try:
        for count in (1, 2, 4, 4, 4):
            torch.set_num_threads(count)
            part, leaf = MonotoneResponse(), image.clone().requires_grad_()
            (part(leaf, Frame("0.png", 0, CAMERA)) * pull).sum().backward()
            found.append((part.rises.grad, leaf.grad))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(other, found[0], strict=True))


def test_channels_are_bent_one_by_one():
    part, colours = MonotoneResponse(pieces=3), torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        part.rises.copy_(torch.tensor([1.0, -1.0, 0.5]))
    frame = Frame("0.png", 0, CAMERA)
    assert torch.equal(part(colours, frame), torch.cat([part(colours[..., i : i + 1], frame) for i in range(3)], 2))


def test_a_piece_that_is_all_but_level_is_pulled_back():
    """Its slope underflows; the logarithm is that of the free numbers, -150 and what the others sum up to."""
    part = MonotoneResponse(pieces=4, weight=1.0)
    rises = torch.tensor([0.0, -60.0, -150.0, 3.0])
    with torch.no_grad():
        part.rises.copy_(rises)
    logarithms = rises.double() - rises.double().logsumexp(0) + math.log(4)
    assert part.regulariser().item() == pytest.approx(logarithms.square().mean().item(), rel=1e-6)
    part.regulariser().backward()
    assert part.rises.grad.isfinite().all() and part.rises.grad[2] < 0
