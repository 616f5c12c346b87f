"""PSNR, SSIM and which pixels count, against skimage, torchmetrics and kornia."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from heatsplat.metrics.psnr import psnr
from heatsplat.metrics.ssim import ssim
from heatsplat.metrics.valid import saturated_fraction, valid_pixels
from heatsplat.training.rng import generator_for


def pair(height=40, width=56, channels=1, noise=0.05):
    generator = generator_for(0, 0, "images")
    y, x = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 9, width), indexing="ij")
    target = (0.5 + 0.3 * torch.sin(x) * torch.cos(y))[..., None].repeat(1, 1, channels)
    target = target + 0.02 * torch.rand(height, width, channels, generator=generator)
    return (target + noise * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


@pytest.mark.parametrize("channels", [1, 3])
def test_psnr_agrees_with_skimage_and_kornia(channels):
    from kornia.metrics import psnr as kornia_psnr  # here: every test process would load it

    prediction, target = pair(channels=channels)
    expected = peak_signal_noise_ratio(target.double().numpy(), prediction.double().numpy(), data_range=1.0)
    assert psnr(prediction, target) == pytest.approx(expected, abs=1e-9)
    assert psnr(prediction, target) == pytest.approx(kornia_psnr(prediction, target, 1.0).item(), abs=1e-4)


def test_psnr_of_a_known_error():
    target = torch.full((8, 9, 1), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_ssim_agrees_with_skimage_and_torchmetrics(channels):
    prediction, target = pair(channels=channels)
    value = ssim(prediction, target)
    _, full = structural_similarity(
        target.double().numpy(),
        prediction.double().numpy(),
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=-1,
        full=True,
    )
    assert value == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-9)
    images = [x.permute(2, 0, 1)[None] for x in (prediction, target)]
    _, mirrored = structural_similarity_index_measure(*images, data_range=1.0, return_full_image=True)
    assert value == pytest.approx(mirrored[..., 5:-5, 5:-5].mean().item(), abs=2e-5)


def test_images_that_are_the_same_have_a_psnr_of_100_and_ssim_one():
    _, target = pair()
    assert psnr(target, target) == psnr(target, target + 1e-6) == 100.0
    assert psnr(target, target.double() + 2e-5) == pytest.approx(93.98, abs=0.01)
    assert ssim(target, target) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_ssim_of_constant_images_is_finite(level):
    flat = torch.full((32, 32, 1), level)
    assert ssim(flat, flat) == pytest.approx(1.0, abs=1e-9)
    # Only the luminance term is left: (2ab + C1) / (a² + b² + C1).
    other = torch.full((32, 32, 1), 0.5)
    a, b = level, 0.5
    assert ssim(flat, other) == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-6)


def test_masked_and_nan_pixels_do_not_count():
    prediction, target = pair()
    mask = torch.ones(target.shape[:2], dtype=torch.bool)
    mask[:, 30:] = False
    spoiled = target.clone()
    spoiled[:, 30:] = 7.0
    assert psnr(prediction, spoiled, mask) == pytest.approx(psnr(prediction[:, :30], target[:, :30]), abs=1e-9)
    assert ssim(prediction, spoiled, mask) == pytest.approx(ssim(prediction[:, :30], target[:, :30]), abs=1e-9)
    spoiled[:, 30:] = float("nan")
    assert psnr(prediction, spoiled) == pytest.approx(psnr(prediction[:, :30], target[:, :30]), abs=1e-9)
    assert ssim(prediction, spoiled) == pytest.approx(ssim(prediction[:, :30], target[:, :30]), abs=1e-9)


def test_a_score_without_pixels_is_none():
    prediction, target = pair()
    nothing = torch.zeros(target.shape[:2], dtype=torch.bool)
    assert psnr(prediction, target, nothing) is None
    assert ssim(prediction, target, nothing) is None
    assert ssim(prediction[:10], target[:10]) is None  # smaller than the window
    sparse = torch.ones_like(nothing)
    sparse[::5, ::5] = False
    assert ssim(prediction, target, sparse) is None  # every window touches a hole


def test_a_broken_prediction_is_an_error_and_not_a_score():
    prediction, target = pair()
    prediction[3, 4] = float("nan")
    with pytest.raises(ValueError, match="1 pixels that are NaN or infinite"):
        psnr(prediction, target)
    mask = torch.ones(target.shape[:2], dtype=torch.bool)
    mask[3, 4] = False
    assert psnr(prediction, target, mask) is not None


def test_shapes_are_checked():
    _, target = pair()
    with pytest.raises(ValueError, match="of one shape"):
        valid_pixels(target[:-1], target)
    with pytest.raises(ValueError, match=r"mask must be \[H, W\]"):
        valid_pixels(target, target, torch.ones(3, 3, dtype=torch.bool))


def test_saturated_pixels_are_counted():
    target = torch.tensor([[0.0, 0.5], [1.0, 0.25]])[..., None]
    valid = torch.tensor([[True, True], [True, False]])
    assert saturated_fraction(target, valid) == pytest.approx(2 / 3)
    assert saturated_fraction(target, torch.zeros_like(valid)) is None
    assert np.isclose(saturated_fraction(target, torch.ones_like(valid)), 0.5)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_ssim_equals_kornias_under_a_mask_with_gaps(channels):
    from kornia.metrics import ssim as ssim_map

    generator = torch.Generator().manual_seed(channels)
    target = torch.rand(37, 52, channels, generator=generator)
    prediction = (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    mask = torch.ones(37, 52, dtype=torch.bool)
    mask[20:23, 30:31] = False
    planes = [
        torch.where(mask[..., None], image.double(), 0.0).permute(2, 0, 1)[None] for image in (prediction, target)
    ]
    scores = ssim_map(*planes, window_size=11, eps=0.0, padding="valid")[0]
    whole = -torch.nn.functional.max_pool2d(-mask[None].double(), 11, stride=1)[0] > 0.5
    assert 0 < whole.sum() < whole.numel()
    prediction[20, 30] = torch.nan  # hidden
    assert ssim(prediction, target, mask) == pytest.approx(scores[:, whole].mean().item(), abs=1e-12)
