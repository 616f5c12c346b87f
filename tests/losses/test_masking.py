"""Masked pixels: whatever stands there neither counts nor learns, and no pixel beside them counts where windows reach them."""

import pytest
import torch

from heatsplat.losses.masking import cleared, eroded, filled, masked_mean


def test_masked_pixels_are_zero_and_get_no_gradient():
    image = torch.tensor([[[1.0], [torch.nan]], [[torch.inf], [2.0]]], requires_grad=True)
    mask = torch.tensor([[True, False], [False, True]])
    found = cleared(image, mask)
    assert found.flatten().tolist() == [1.0, 0.0, 0.0, 2.0]
    found.square().sum().backward()
    assert image.grad.flatten().tolist() == [2.0, 0.0, 0.0, 4.0]
    assert cleared(image, None) is image


def test_holes_are_filled_by_the_nearest_pixel_that_counts():
    image = torch.arange(24.0).reshape(3, 4, 2)
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[:, 2:], mask[2, 3] = False, True
    broken = image.masked_fill(~mask[..., None], torch.nan)
    found = filled(broken, mask)
    assert torch.equal(found[mask], image[mask]) and torch.equal(found[:2, 2], image[:2, 1])
    assert torch.equal(found[1, 3], image[2, 3])
    assert filled(image, None) is image and filled(broken, mask & False).abs().max() == 0


def test_means_run_over_the_pixels_that_count_and_their_channels():
    values = torch.arange(12.0).reshape(2, 3, 2)
    mask = torch.tensor([[True, False, False], [False, False, True]])
    assert masked_mean(values, mask).item() == pytest.approx((0 + 1 + 10 + 11) / 4)
    assert masked_mean(values, None).item() == pytest.approx(5.5) == masked_mean(values, mask | True).item()
    assert masked_mean(values, mask & False) == 0
    assert masked_mean(values.masked_fill(~mask[..., None], torch.nan), mask).isfinite()


def test_erosion_leaves_what_counts_with_its_eight_neighbours():
    mask = torch.ones(12, 17, dtype=torch.bool)
    mask[4:6, 8] = False
    assert (~eroded(mask)).nonzero().tolist() == [[v, u] for v in range(3, 7) for u in range(7, 10)]
    mask[0, 0] = False  # in the corner of the image
    assert (~eroded(mask)).nonzero().tolist()[:4] == [[0, 0], [0, 1], [1, 0], [1, 1]]
