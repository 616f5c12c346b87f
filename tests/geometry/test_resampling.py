"""Resampling: against two other implementations, half pixels, masks, gradients, scale of grids."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch.nn import functional

from heatsplat.geometry.resampling import (
    KERNELS,
    ends_on,
    resampled,
    scale_between,
    valid_after,
    weights,
    with_what_lies_beyond,
)


def noise(height, width, channels=1, seed=0):
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    "mode, size",
    [(mode, size) for mode in ("bicubic", "bilinear", "area") for size in ((12, 20), (24, 40))]
    + [("bicubic", (7, 11)), ("bilinear", (7, 11))],  # torch's area average snaps to whole pixels there
)
def test_shrinking_is_that_of_torch(mode, size):
    image = noise(48, 80, 2)
    options = {} if mode == "area" else {"antialias": True}
    expected = functional.interpolate(image.permute(2, 0, 1)[None], size, mode=mode, **options)[0].permute(1, 2, 0)
    assert torch.allclose(resampled(image, *size, mode), expected, atol=2e-6)


@pytest.mark.parametrize("kernel, filter", [("lanczos", Image.LANCZOS), ("bicubic", Image.BICUBIC)])
@pytest.mark.parametrize("size", [(12, 20), (192, 320), (50, 81)])
def test_lanczos_and_bicubic_are_those_of_pillow(kernel, filter, size):
    image = noise(48, 80)
    expected = np.asarray(Image.fromarray(image[..., 0].numpy(), "F").resize(size[::-1], filter))
    assert np.allclose(resampled(image, *size, kernel)[..., 0].numpy(), expected, atol=2e-5)


def test_enlarging_by_bilinear_is_that_of_torch():
    image = noise(9, 13)
    expected = functional.interpolate(image.permute(2, 0, 1)[None], (36, 52), mode="bilinear")[0].permute(1, 2, 0)
    assert torch.allclose(resampled(image, 36, 52, "bilinear"), expected, atol=1e-6)


@pytest.mark.parametrize("kernel", sorted(KERNELS))
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_a_plane_keeps_its_place_when_it_shrinks(kernel, factor):
    """A shift by a fraction of a pixel would change a slope's values; the border renormalises and is left out."""

    def plane(scale):
        v, u = (
            scale * (torch.arange(n, dtype=torch.float64) + 0.5) for n in (24 * factor // scale, 30 * factor // scale)
        )
        return (0.3 + 0.01 * u - 0.02 * v[:, None])[..., None]

    inside = (slice(3, -3), slice(3, -3))
    assert torch.allclose(resampled(plane(1), 24, 30, kernel)[inside], plane(factor)[inside], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from(sorted(KERNELS)))
def test_rows_sum_to_one_and_a_constant_stays(count, new_count, kernel):
    matrix = weights(count, new_count, kernel)
    assert matrix.shape == (new_count, count)
    assert torch.allclose(matrix.sum(1), torch.ones(new_count, dtype=torch.float64), atol=1e-12)


def test_the_same_size_is_the_same_tensor():
    image = noise(8, 8)
    assert resampled(image, 8, 8, "lanczos") is image


def test_gradients_are_those_of_the_matrix():
    image = noise(8, 12).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: resampled(x, 4, 6, "bicubic"), (image,))


def test_weights_that_were_made_without_gradients_pass_them():
    weights.cache_clear()
    image = noise(9, 12).double()
    with torch.inference_mode():  # as a test renders
        shown = resampled(image, 5, 7, "area")
    image.requires_grad_()
    again = resampled(image, 5, 7, "area")
    again.sum().backward()
    assert torch.equal(again, shown) and float(image.grad.min()) > 0


def test_what_is_masked_never_reaches_a_valid_pixel():
    mask = torch.ones(32, 40, dtype=torch.bool)
    mask[14, 21] = False
    clean, spoiled = noise(32, 40), noise(32, 40)
    spoiled[14, 21] = 1e6
    for kernel in KERNELS:
        valid = valid_after(mask, 8, 10, kernel)
        change = (resampled(clean, 8, 10, kernel) - resampled(spoiled, 8, 10, kernel)).abs()[..., 0]
        assert change[valid].max() == 0
        assert change[~valid].min() > 0.01  # and no pixel is given away
    assert (~valid_after(mask, 8, 10, "area")).sum() == 1


@pytest.mark.parametrize(
    "fine, coarse, factor",
    [((48, 64), (12, 16), 4), ((12, 16), (12, 16), 1), ((12, 16), (48, 64), None), ((50, 64), (12, 16), None)],
)
def test_scale_between_grids(fine, coarse, factor):
    assert scale_between(fine, coarse) == factor


def test_errors():
    with pytest.raises(ValueError, match="unknown resampling kernel 'cubic'; there are area, bilinear"):
        resampled(noise(4, 4), 2, 2, "cubic")
    with pytest.raises(ValueError, match="a line of 4 pixels cannot become one of 0"):
        resampled(noise(4, 4), 0, 2)


def test_a_coarse_pixel_was_cut_off_where_one_below_it_was():
    ends = torch.zeros(4, 6, dtype=torch.int8)
    ends[0, 0], ends[1, 2], ends[2, 4], ends[3, 5] = 1, -1, 1, -1
    assert ends_on(ends, 2, 3).tolist() == [[1, -1, 0], [0, 0, 0]]  # the last has both
    assert ends_on(ends, 4, 6) is ends and ends_on(None, 2, 3) is None
    barely = torch.zeros(64, 64, dtype=torch.int8)
    barely[0, 0] = 1
    assert ends_on(barely, 1, 1).tolist() == [[0]] and ends_on(barely[:32, :31], 1, 1).tolist() == [[1]]
    assert torch.equal(ends_on(ends, 8, 12), ends.repeat_interleave(2, 0).repeat_interleave(2, 1))


@pytest.mark.parametrize("finer", [1, 2])
def test_beyond_what_was_cut_off_a_prediction_is_right_and_has_no_gradient(finer):
    target = torch.full((2, 3, 1), 0.5)
    ends = torch.tensor([[1, 1, 0], [-1, -1, 0]], dtype=torch.int8)
    values = torch.tensor([[0.7, 0.3, 0.7], [0.3, 0.7, 0.3]])[..., None]
    prediction = values.repeat_interleave(finer, 0).repeat_interleave(finer, 1).requires_grad_()
    told = with_what_lies_beyond(target, ends, prediction)
    expected = torch.tensor([[0.7, 0.5, 0.5], [0.3, 0.5, 0.5]])[..., None]
    assert torch.allclose(told, expected) and not told.requires_grad
    (resampled(prediction, 2, 3, "area") - told).abs().sum().backward()
    moved = resampled(prediction.grad, 2, 3, "area")[..., 0] != 0
    assert moved.tolist() == [[False, True, True], [False, True, True]]
    assert with_what_lies_beyond(target, None, prediction) is target
