"""The conduction residual: the identity at first, its formula, its bound, and that it learns a step of the heat equation."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from heatsplat.contracts import Camera, Frame
from heatsplat.sensors.conduction_residual import NORMS, ConductionResidual, curvature

FRAME = Frame("a.png", 0, Camera(torch.eye(4), torch.eye(3), 9, 7))


def noise(height=7, width=9, channels=1, seed=0, dtype=torch.float32):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def disturbed(scale=0.3, **options):
    part = ConductionResidual(**options)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in part.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return part


def test_curvature_is_second_differences_with_no_flow_across_the_border():
    image = noise(dtype=torch.float64)[..., 0]
    expected = sum(
        np.abs(ndimage.convolve1d(image.numpy(), [1.0, -2.0, 1.0], axis=axis, mode="nearest")) for axis in (0, 1)
    )
    assert np.allclose(curvature(image).numpy(), expected, atol=1e-14)
    assert curvature(torch.full((1, 1), 0.3)).item() == 0


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("width", [1, 4])
def test_a_new_part_is_exactly_the_identity_and_every_unit_learns(norm, width):
    part = ConductionResidual(width=width, norm=norm)
    image = noise()
    assert torch.equal(part(image, FRAME), image)
    (part(image, FRAME) - noise(seed=1)).square().sum().backward()
    assert (part.last.weight.grad.abs() > 1e-4).all()  # no unit is dead
    with torch.no_grad():
        part.last.weight.fill_(0.01)
    part.zero_grad()
    (part(image, FRAME) - noise(seed=1)).square().sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in part.parameters())


@pytest.mark.parametrize("norm", NORMS)
def test_the_correction_is_the_formula_in_double_precision(norm):
    part, image = disturbed(norm=norm), noise(channels=3)
    x = image.double().mean(2)
    h = np.stack((x.numpy(), curvature(x).numpy()))
    for layer in part.layers:
        weight, bias = (parameter.detach().double().numpy() for parameter in (layer.weight, layer.bias))
        h = np.einsum("oi,ihw->ohw", weight, h) + bias[:, None, None]
        if norm == "image":
            h = h / np.sqrt((h**2).mean((1, 2), keepdims=True))
        elif norm == "columns":
            h = h / np.linalg.norm(h, axis=1, keepdims=True)
        h = np.maximum(h, 0)
    raw = np.einsum("i,ihw->hw", part.last.weight[0].detach().double().numpy(), h) + part.last.bias.item()
    expected = image.double().numpy() + 0.1 * np.tanh(raw / 0.1)[..., None]
    assert np.abs(raw).max() > 0.05
    assert np.allclose(part(image, FRAME).detach().numpy(), expected, atol=1e-5)


def test_gradients_agree_with_differences():
    part = disturbed(width=2).double()
    image = noise(4, 5, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda image: part(image, FRAME), (image,), atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-1e6, 1e6),
    st.sampled_from([0.0, 1e-12, 1.0, 1e18]),
    st.sampled_from(NORMS),
    st.sampled_from([(1, 1), (1, 5), (7, 9)]),
)
def test_the_correction_is_bounded_and_slopes_are_finite_whatever_the_image(level, contrast, norm, size):
    part = disturbed(3.0, norm=norm)
    image = (level + contrast * noise(*size)).requires_grad_()
    correction = part(image, FRAME) - image
    correction.sum().backward()
    rounding = 1e-6 * image.detach().abs().max()
    assert (correction.abs() <= 0.1 + rounding).all() and image.grad.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in part.parameters())


def test_it_learns_the_rise_of_brightness_where_a_cold_image_bends():
    part = ConductionResidual(norm="none")
    optimiser = torch.optim.Adam(part.parameters(), lr=3e-3)
    image = torch.zeros(7, 9, 1)
    image[3, 4] = 0.4
    spread = image.clone()
    for row, column in ((2, 4), (4, 4), (3, 3), (3, 5)):
        spread[row, column] += 0.04  # one step of the heat equation with κ = 0.1
    spread[3, 4] -= 0.16
    before = (image - spread).square().sum().item()
    for _ in range(300):
        optimiser.zero_grad()
        loss = (part(image, FRAME) - spread).square().sum()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.35 * before  # 0.11 is due to the bound alone


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "batch"}, "norm must be one of image, columns, none, got 'batch'"),
        ({"width": 0}, "must be positive, got 0, 2, 0.1"),
        ({"bound": 0.0}, "must be positive, got 4, 2, 0.0"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ConductionResidual(**options)
