"""The loss at corners: the response against scikit-image and OpenCV, weights, masks, extremes, the schedule of the recipe."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from running import compose_run
from skimage.feature import corner_harris

from heatsplat.composition import build
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.corner import Corner, harris_response
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.sobel import sobel


def noise(height=24, width=31, channels=1, seed=0, dtype=torch.float32):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def square(level=0.2, contrast=0.5, dtype=torch.float32):
    """A bright square on a flat ground: four corners, four edges."""
    image = torch.full((24, 31, 1), level, dtype=dtype)
    image[8:17, 10:22] += contrast
    return image


def inputs(prediction, target, mask=None, step=0, max_steps=1):
    return LossInputs(prediction, target, mask, view=None, splats=None, step=step, progress=min(step / max_steps, 1.0))


def weights(target, **options):
    """What a pixel counts: the loss's slope by a prediction that is darker everywhere."""
    prediction = (target - 0.1).requires_grad_()
    Corner(**options)(inputs(prediction, target)).backward()
    return -prediction.grad[..., 0] * target.numel()


def test_the_response_is_that_of_scikit_image():
    image = noise(channels=2, dtype=torch.float64)
    for channel in range(2):
        expected = corner_harris(image[..., channel].numpy(), method="k", k=0.04, sigma=1)
        inner = slice(6, -6)  # images go on differently beyond their borders
        found = harris_response(*sobel(image))[..., channel].numpy()
        assert np.allclose(found[inner, inner], expected[inner, inner], rtol=1e-9, atol=1e-9)


def test_the_strongest_corners_are_those_of_opencv():
    image = square()
    theirs = cv2.cornerHarris(image[..., 0].numpy(), blockSize=3, ksize=3, k=0.04)
    ours = harris_response(*sobel(image))[..., 0]
    peaks = {tuple(index) for index in np.argwhere(ours.numpy() > 0.9 * ours.max().item())}
    highest = {tuple(index) for index in np.argwhere(theirs > 0.9 * theirs.max())}
    assert peaks and all(any(abs(a - c) + abs(b - d) <= 2 for c, d in highest) for a, b in peaks)
    quadrants = {(row > 12, column > 15) for row, column in peaks}
    assert len(quadrants) == 4


def test_corners_count_fully_and_flat_places_and_edges_the_least():
    found = weights(square())
    assert found.max().item() == pytest.approx(1.0, rel=1e-5)
    assert found[2, 2].item() == pytest.approx(0.01) == found[12, 15].item()  # ground and middle
    assert found[8, 16].item() == pytest.approx(0.01)  # middle of an edge
    assert found[8, 10] > 0.5


def test_the_published_weight_is_one_where_the_image_is_flat_and_nothing_at_edges():
    found = weights(square(), weight="published")
    assert found[2, 2] == 1 == found[12, 15] and found[8, 16] == 0 == found[8, 10]


def test_the_loss_is_the_weighted_mean_of_scikit_images_response():
    target, prediction = noise(dtype=torch.float64), noise(seed=1, dtype=torch.float64)
    target[:8], target[-8:], target[:, :8], target[:, -8:] = 0.0, 0.0, 0.0, 0.0  # so that borders do not matter
    response = corner_harris(target[..., 0].numpy(), method="k", k=0.04, sigma=1)
    weight = np.maximum(response / response.max(), 0.01)
    expected = (weight * (target - prediction)[..., 0].abs().numpy()).mean()
    assert Corner()(inputs(prediction, target)).item() == pytest.approx(expected, rel=1e-9)


def test_weights_do_not_depend_on_level_and_contrast():
    assert torch.allclose(weights(square()), weights(square(0.7, 1e-3)), atol=2e-3)
    faint = weights(square(0.0, 1e-12))  # R of such an image is 1e-46
    assert torch.allclose(weights(square(0.0, 0.5)), faint, atol=1e-4)


def test_gradients_agree_with_differences_and_none_passes_through_the_weight():
    target = noise(9, 8, dtype=torch.float64)
    prediction = noise(9, 8, seed=1, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: Corner()(inputs(x, target)), (prediction,))
    (slope,) = torch.autograd.grad(Corner("published")(inputs(prediction, target)), prediction)
    assert (slope.sign() == (prediction - target).sign()).logical_or(slope == 0).all()


def test_masked_pixels_do_not_count_whatever_stands_there():
    target, prediction, mask = square(), noise(), torch.ones(24, 31, dtype=torch.bool)
    mask[:5] = False
    broken = target.clone()
    broken[:5] = torch.nan
    prediction.requires_grad_()
    loss = Corner()(inputs(prediction, broken, mask))
    loss.backward()
    assert loss.isfinite() and prediction.grad.isfinite().all() and (prediction.grad[:5] == 0).all()
    cropped = Corner()(inputs(prediction.detach()[5:], target[5:]))
    assert loss.item() == pytest.approx(cropped.item(), rel=1e-4)  # the edge of the mask is no corner
    nothing = Corner()(inputs(prediction, broken, torch.zeros_like(mask)))
    assert nothing.item() == 0


@settings(max_examples=30, deadline=None)
@given(
    st.floats(-3.0, 3.0),
    st.sampled_from([0.0, 1e-30, 1.0, 1e15]),
    st.sampled_from(["corners", "published"]),
    st.sampled_from([(1, 1), (1, 5), (9, 7)]),
)
def test_loss_and_gradient_are_finite_whatever_the_images(level, contrast, weight, size):
    prediction = (level + contrast * noise(*size)).requires_grad_()
    loss = Corner(weight)(inputs(prediction, level + contrast * noise(*size, seed=1)))
    loss.backward()
    assert loss.isfinite() and loss >= 0 and prediction.grad.isfinite().all()


def test_the_recipe_is_the_published_sum_and_its_ramp_ends_after_a_sixth_of_the_run():
    plain = OmegaConf.to_container(compose_run("method=thermal3dgs").loss, resolve=True)
    loss, target, prediction = build(plain), noise(), noise(seed=1)
    full = Photometric(1.0)(inputs(prediction, target))["dssim"].item()
    for step, share in ((0, 1.0), (2500, 0.5), (4999, 0.0002), (5002, None)):
        terms = loss(inputs(prediction, target, step=step, max_steps=30000))
        assert terms["photometric/l1"].item() == pytest.approx(
            0.6 * (prediction - target).abs().mean().item(), rel=1e-5
        )
        assert terms["photometric/dssim"].item() == pytest.approx(0.2 * full, rel=1e-5)
        if share is None:
            assert "corner" not in terms
        else:
            corner = Corner()(inputs(prediction, target)).item()
            assert terms["corner"].item() == pytest.approx(0.2 * share * corner, abs=1e-4 * corner)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="weight must be one of corners, published, got 'edges'"):
        Corner("edges")
    with pytest.raises(ValueError, match=r"floor is a weight in \[0, 1\], got 2.0"):
        Corner(floor=2.0)
    with pytest.raises(ValueError, match=r"must have one shape, got \[24, 31, 1\] and \[4, 4, 1\]"):
        Corner()(inputs(noise(), noise(4, 4)))
