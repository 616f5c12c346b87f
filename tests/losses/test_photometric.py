"""The photometric loss: against other libraries, against float64 autograd, and on images that break naive forms."""

import numba
import pytest
import torch
from torch.nn import functional

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import Photometric, l1, ssim_map


def images(height, width, channels, seed=0, dtype=torch.float64):
    """A smooth target and a prediction near it, both in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(2, channels, height, width, generator=generator, dtype=torch.float64)
    target = functional.avg_pool2d(noise[:1], 3, stride=1, padding=1)[0]
    prediction = (target + 0.2 * (noise[1] - 0.5)).clamp(0, 1)
    return prediction.permute(1, 2, 0).to(dtype).contiguous(), target.permute(1, 2, 0).to(dtype).contiguous()


def inputs(prediction, target, mask=None):
    return LossInputs(prediction, target, mask, view=None, splats=None)


def loss_and_gradient(photometric, prediction, target, mask=None):
    prediction = prediction.clone().requires_grad_()
    terms = photometric(inputs(prediction, target, mask))
    sum(terms.values()).backward()
    return {name: value.item() for name, value in terms.items()}, prediction.grad


def relative(value, reference):
    return ((value.double() - reference).norm() / reference.norm()).item()


@pytest.mark.parametrize("channels", [1, 3])
def test_ssim_equals_torchmetrics_where_the_window_is_inside(channels):
    from torchmetrics.functional.image import structural_similarity_index_measure

    prediction, target = images(40, 50, channels)
    # torchmetrics mirrors the image at its border, which no pixel further than 5 from it notices
    _, expected = structural_similarity_index_measure(
        prediction.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], data_range=1.0, return_full_image=True
    )
    expected = expected[0].permute(1, 2, 0)
    similarity = ssim_map(prediction, target)
    assert torch.allclose(similarity[5:-5, 5:-5], expected[5:-5, 5:-5], atol=1e-7)
    assert not torch.allclose(similarity, expected, atol=1e-2)


def test_ssim_equals_kornia_on_images_padded_with_zeros():
    from kornia.metrics import ssim

    prediction, target = images(30, 41, 2)
    padded = [functional.pad(image.permute(2, 0, 1)[None], (9,) * 4) for image in (prediction, target)]
    expected = ssim(*padded, window_size=11)[0, :, 9:-9, 9:-9].permute(1, 2, 0)
    assert torch.allclose(ssim_map(prediction, target), expected, atol=1e-7)


def test_ssim_of_equal_images_is_one_and_of_anything_at_most_one():
    prediction, target = images(20, 20, 1)
    assert torch.allclose(ssim_map(target, target), torch.ones_like(target), atol=1e-12)
    assert ssim_map(1 - target, target).max() <= 1.0


def test_l1_is_unreduced():
    assert torch.equal(l1(torch.tensor([[[0.25]]]), torch.tensor([[[1.0]]])), torch.tensor([[[0.75]]]))


def test_the_twin_passes_gradcheck():
    prediction, target = images(4, 6, 2)
    mask = torch.rand(4, 6, generator=torch.Generator().manual_seed(1)) > 0.3
    prediction.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: ssim_map(p, target, mask)[mask], prediction, atol=1e-6)


@pytest.mark.parametrize("half, factor", [(False, 1.0), (True, 0.5)])
def test_terms_are_the_weighted_formula(half, factor):
    prediction, target = images(24, 30, 1)
    terms = Photometric(0.2, half)(inputs(prediction, target))
    assert terms["l1"].item() == pytest.approx(0.8 * (prediction - target).abs().mean().item(), rel=1e-6)
    assert terms["dssim"].item() == pytest.approx(
        0.2 * factor * (1 - ssim_map(prediction, target).mean().item()), rel=1e-6
    )


@pytest.mark.parametrize("shape", [(33, 47, 1), (410, 64, 1), (64, 410, 3), (16, 16, 4), (12, 11, 2)])
@pytest.mark.parametrize("masked", [False, True])
def test_float32_agrees_with_float64(shape, masked):
    prediction, target = images(*shape)
    mask = torch.rand(shape[:2], generator=torch.Generator().manual_seed(2)) > 0.2 if masked else None
    loss = Photometric(0.2)
    expected, gradient = loss_and_gradient(loss, prediction, target, mask)
    got, got_gradient = loss_and_gradient(loss, prediction.float(), target.float(), mask)
    assert got == pytest.approx(expected, rel=2e-6)
    # signs of differences that round to zero in float32 may flip: compare where the images differ
    apart = (prediction - target).abs() > 1e-6
    assert relative(got_gradient[apart], gradient[apart]) < 2e-5


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_constant_images_are_exact_in_float32(level, offset):
    """E[x²] - E[x]² of a bright constant image is rounding of either sign; the shift makes it zero."""
    target = torch.full((30, 40, 1), level)
    prediction = target + offset
    similarity = ssim_map(prediction, target)
    expected = ssim_map(prediction.double(), target.double())
    assert torch.allclose(similarity.double(), expected, atol=2e-7, rtol=0)
    value, gradient = loss_and_gradient(Photometric(1.0), prediction, target)
    reference_value, reference = loss_and_gradient(Photometric(1.0), prediction.double(), target.double())
    assert value["dssim"] == pytest.approx(reference_value["dssim"], abs=2e-7)
    assert torch.allclose(gradient.double(), reference, atol=1e-3 * max(reference.abs().max().item(), 1e-6))


def test_faint_contrast_on_a_bright_image_keeps_its_gradient():
    """Low-contrast thermal images: 1e-3 of contrast at level 0.9."""
    prediction, target = images(40, 40, 1)
    prediction, target = 0.9 + 1e-3 * (prediction - 0.5), 0.9 + 1e-3 * (target - 0.5)
    prediction, target = prediction.float(), target.float()
    _, expected = loss_and_gradient(Photometric(1.0), prediction.double(), target.double())
    _, gradient = loss_and_gradient(Photometric(1.0), prediction, target)
    assert relative(gradient, expected) < 1e-3


@pytest.mark.parametrize("off", [1.0, -10.0, 40.0, 1000.0])
@pytest.mark.parametrize("masked", [False, True])
def test_a_prediction_that_is_far_off_keeps_its_gradient(off, masked):
    """As at the start of a run, or where a sensor adds a level: the pull back must have the right direction."""
    prediction, target = images(90, 110, 1)
    prediction, target = (prediction + off).float(), target.float()
    mask = torch.rand(90, 110, generator=torch.Generator().manual_seed(2)) > 0.02 if masked else None
    expected_value, expected = loss_and_gradient(Photometric(1.0), prediction.double(), target.double(), mask)
    value, gradient = loss_and_gradient(Photometric(1.0), prediction, target, mask)
    assert value["dssim"] == pytest.approx(expected_value["dssim"], abs=1e-6)
    assert relative(gradient, expected) < 2e-5
    seen = prediction.clone().requires_grad_()
    counts = torch.ones(90, 110, dtype=torch.bool) if mask is None else mask
    (1 - ssim_map(seen, target, mask)[counts]).mean().backward()
    assert relative(seen.grad, expected) < 2e-5


def test_a_variance_that_rounding_makes_negative_counts_as_none():
    """Flat parts far from the mean of their image: rounding outweighs the stabiliser, which a denominator must not fall below."""
    target = torch.zeros(60, 60, 1)
    prediction = target.clone()
    prediction[:, 30:] = 2000.0
    value, gradient = loss_and_gradient(Photometric(1.0), prediction, target)
    similarity = ssim_map(prediction, target)
    for found in (1 - value["dssim"], similarity.min(), similarity.max()):
        assert -1.001 <= float(found) <= 1.001
    assert gradient.isfinite().all() and gradient.abs().max() < 1.0


def test_saturated_and_out_of_range_predictions_stay_finite():
    _, target = images(20, 20, 1, dtype=torch.float32)
    for level in (-1e3, 0.0, 1.0, 1e3):
        value, gradient = loss_and_gradient(Photometric(0.2), torch.full_like(target, level), target)
        assert all(map(torch.isfinite, map(torch.tensor, value.values())))
        assert gradient.isfinite().all()


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 7, 1), (5, 3, 2), (10, 2, 1)])
def test_images_smaller_than_the_window(shape):
    prediction, target = images(*shape)
    expected, gradient = loss_and_gradient(Photometric(0.2), prediction, target)
    got, got_gradient = loss_and_gradient(Photometric(0.2), prediction.float(), target.float())
    assert got == pytest.approx(expected, rel=1e-5)
    assert relative(got_gradient, gradient) < 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_masking_a_margin_is_cropping_it(dtype):
    prediction, target = images(40, 50, 2, dtype=dtype)
    mask = torch.zeros(40, 50, dtype=torch.bool)
    mask[7:30, 4:44] = True
    masked, gradient = loss_and_gradient(Photometric(0.2), prediction, target, mask)
    cropped, crop_gradient = loss_and_gradient(Photometric(0.2), prediction[7:30, 4:44], target[7:30, 4:44])
    assert masked == pytest.approx(cropped, rel=1e-5)
    assert torch.allclose(gradient[7:30, 4:44], crop_gradient, atol=1e-4 * crop_gradient.abs().max().item())
    assert gradient[~mask].abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_masked_pixels_leak_nothing_even_if_nan(dtype):
    prediction, target = images(30, 30, 1, dtype=dtype)
    mask = torch.ones(30, 30, dtype=torch.bool)
    mask[10:14, 5:20] = False
    clean, clean_gradient = loss_and_gradient(Photometric(0.2), prediction, target, mask)
    prediction[~mask], target[~mask] = torch.inf, torch.nan
    dirty, gradient = loss_and_gradient(Photometric(0.2), prediction, target, mask)
    assert dirty == clean
    assert torch.equal(gradient, clean_gradient)
    assert gradient[~mask].abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_empty_mask_is_a_loss_of_zero(dtype):
    prediction, target = images(12, 12, 1, dtype=dtype)
    target[:] = torch.nan
    value, gradient = loss_and_gradient(Photometric(0.2), prediction, target, torch.zeros(12, 12, dtype=torch.bool))
    assert value == {"l1": 0.0, "dssim": 0.0}
    assert gradient.abs().max() == 0


def test_weight_zero_leaves_ssim_out(monkeypatch):
    prediction, target = images(12, 12, 1, dtype=torch.float32)
    for name in ("ssim_map", "_Fused.apply", "_padded"):
        monkeypatch.setattr(f"heatsplat.losses.photometric.{name}", lambda *_: pytest.fail("SSIM was computed"))
    value, gradient = loss_and_gradient(Photometric(0.0), prediction, target)
    assert value == {"l1": pytest.approx((prediction - target).abs().mean().item(), rel=1e-6)}
    assert torch.allclose(gradient, (prediction - target).sign() / prediction.numel())


def test_the_number_of_threads_changes_no_bit():
    prediction, target = images(67, 45, 3, dtype=torch.float32)
    mask = torch.rand(67, 45, generator=torch.Generator().manual_seed(3)) > 0.1
    before, results = numba.get_num_threads(), []
    try:
        for threads in {1, min(2, numba.config.NUMBA_NUM_THREADS)}:
            numba.set_num_threads(threads)
            results.append(loss_and_gradient(Photometric(0.2), prediction, target, mask))
    finally:
        numba.set_num_threads(before)
    assert results[0][0] == results[-1][0]
    assert torch.equal(results[0][1], results[-1][1])


def test_each_term_has_its_own_gradient():
    """The kernel gets the upstream gradients of the two terms, which a schedule may scale apart."""
    prediction, target = images(21, 18, 1)

    def gradient(dtype):
        image = prediction.to(dtype).requires_grad_()
        terms = Photometric(0.4)(inputs(image, target.to(dtype)))
        (3.0 * terms["dssim"] - 0.5 * terms["l1"]).backward()
        return image.grad

    assert relative(gradient(torch.float32), gradient(torch.float64)) < 1e-4


def test_images_need_not_be_contiguous():
    prediction, target = images(18, 21, 2, dtype=torch.float32)
    turned = [image.transpose(0, 1).contiguous().transpose(0, 1) for image in (prediction, target)]
    expected = loss_and_gradient(Photometric(0.2), prediction, target)
    got = loss_and_gradient(Photometric(0.2), *turned)
    assert got[0] == expected[0] and torch.equal(got[1], expected[1])


def test_errors_name_what_does_not_fit():
    prediction, target = images(12, 10, 1)
    with pytest.raises(ValueError, match=r"dssim_weight.*1\.5"):
        Photometric(1.5)
    with pytest.raises(ValueError, match=r"\[12, 10, 1\] and \[12, 9, 1\]"):
        Photometric()(inputs(prediction, target[:, :9]))
    with pytest.raises(ValueError, match=r"mask must be \[12, 10\].*got \[10, 12\]"):
        Photometric()(inputs(prediction, target, torch.ones(10, 12, dtype=torch.bool)))
