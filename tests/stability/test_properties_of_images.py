"""Losses, metrics and the sensor on constant, saturated, broken and empty images, and at the bounds of their settings."""

import math

import pytest
import torch
from draws import generator, logarithmic, seeds
from extreme_inputs import camera
from hypothesis import example, given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Frame, ThermalRange
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.edge import Edge, EdgeEnhanced
from heatsplat.losses.gradients import GradientConsistency
from heatsplat.losses.low_resolution import Curriculum, OnTargetGrid
from heatsplat.losses.photometric import Photometric, ssim_map
from heatsplat.metrics.mae import mae_c
from heatsplat.metrics.mae_roi import scene_threshold
from heatsplat.metrics.otsu import otsu_level
from heatsplat.metrics.psnr import psnr
from heatsplat.metrics.scores import Scorer
from heatsplat.metrics.ssim import ssim
from heatsplat.sensors.agc import GainControl
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.calibration import Calibration
from heatsplat.sensors.tone import Tone

SIZE = (14, 12)
RANGE = ThermalRange(10.0, 30.0)
LOSSES = {
    "photometric": Photometric(0.2), "edge": Edge(), "edge enhanced": EdgeEnhanced(),
    "gradients": GradientConsistency(), "curriculum": OnTargetGrid(Curriculum(0.2)),
}  # fmt: skip
levels = st.one_of(st.sampled_from([0.0, 1.0, 0.5, 1e-8, 1 - 1e-7]), st.floats(0, 1))
contrasts = logarithmic(1e-8, 1.0, 0.0)


def image(seed: int, level: float, contrast: float, channels: int = 1) -> torch.Tensor:
    """An image of one level with noise of a contrast, kept in [0, 1]."""
    noise = torch.rand(*SIZE, channels, generator=generator(seed)) - 0.5
    return (level + contrast * noise).clamp(0, 1)


def given_to_losses(prediction, target, mask=None) -> LossInputs:
    return LossInputs(prediction, target, mask, None, None)


def total(value) -> torch.Tensor:
    return sum(value.values()) if isinstance(value, dict) else value


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@settings(max_examples=25)
@given(seeds(), levels, levels, contrasts, contrasts, st.sampled_from([1, 3]))
@example(0, 1.0, 1.0, 0.0, 0.0, 1)
@example(0, 0.0, 1.0, 0.0, 0.0, 3)
def test_losses_and_their_gradients_are_finite_and_not_negative(name, dtype, seed, a, b, rough, smooth, channels):
    prediction = image(seed, a, rough, channels).to(dtype).requires_grad_()
    target = image(seed + 1, b, smooth, channels).to(dtype)
    value = total(LOSSES[name](given_to_losses(prediction, target)))
    value.backward()
    assert -1e-6 <= value.item() < 1e3
    assert prediction.grad.isfinite().all()
    same = total(LOSSES[name](given_to_losses(target.clone(), target))).item()
    assert abs(same) < 1e-6


@pytest.mark.parametrize("name", LOSSES)
@settings(max_examples=10)
@given(seeds(), st.sampled_from([math.nan, math.inf, -math.inf, 1e38]), st.booleans())
def test_what_is_masked_is_never_seen(name, seed, broken, everything):
    mask = torch.rand(SIZE, generator=generator(seed)) > 0.2
    mask &= not everything
    prediction, target = image(seed, 0.5, 0.5).requires_grad_(), image(seed + 1, 0.5, 0.5)
    target = torch.where(mask[..., None], target, broken)
    value = total(LOSSES[name](given_to_losses(prediction, target, mask)))
    value.backward()
    assert value.isfinite() and prediction.grad.isfinite().all()
    assert (prediction.grad[~mask] == 0).all()
    if everything:
        assert value == 0


@settings(max_examples=25)
@given(seeds(), levels, levels, contrasts, contrasts)
def test_similarity_lies_between_minus_one_and_one(seed, a, b, rough, smooth):
    prediction, target = image(seed, a, rough), image(seed + 1, b, smooth)
    for found in (ssim_map(prediction, target), ssim_map(prediction.double(), target.double())):
        assert found.max() <= 1 + 1e-5 and found.min() >= -1 - 1e-5
    score = ssim(prediction, target)
    assert -1 <= score <= 1 + 1e-12
    assert abs(ssim(target, target) - 1) < 1e-12
    worst = (ssim_map(prediction, target) - ssim_map(prediction.double(), target.double())).abs().max()
    assert worst < 2e-4


def unfinished(scores: dict) -> list[str]:
    return [name for name, value in scores.items() if value is not None and math.isnan(value)]


@settings(max_examples=40)
@given(seeds(), levels, levels, contrasts, st.floats(0, 1), st.booleans())
@example(0, 1.0, 1.0, 0.0, 0.0, True)
@example(0, 0.0, 0.0, 0.0, 1.0, False)
def test_metrics_are_numbers_or_absent(seed, a, b, contrast, unknown, masked):
    """Constant, saturated and partly unknown images: no score is NaN, and a score without a pixel is None."""
    prediction, target = image(seed, a, contrast), image(seed + 1, b, contrast)
    lost = torch.rand(SIZE, generator=generator(seed)) < unknown
    target[lost] = math.nan
    mask = torch.rand(SIZE, generator=generator(seed + 2)) > 0.5 if masked else None
    threshold = scene_threshold([(target, mask)])
    scores = Scorer(RANGE, threshold)(prediction, target, mask)
    assert unfinished(scores) == []
    counted = ~lost if mask is None else ~lost & mask
    assert scores["counted"] == pytest.approx(counted.double().mean().item())
    for name in ("psnr", "mae_c", "saturated"):
        assert (scores[name] is None) == (not counted.any()), name
    if contrast == 0:
        assert otsu_level(target, mask) is None and scores["mae_roi_c"] is None and threshold is None


def test_identical_images_have_an_infinite_psnr_and_no_error():
    flat = torch.full((*SIZE, 1), 0.3)
    assert psnr(flat, flat) == 100 and mae_c(flat, flat, RANGE) == 0 and ssim(flat, flat) == pytest.approx(1)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_a_broken_prediction_is_never_scored(broken):
    prediction, target = torch.full((*SIZE, 1), 0.3), torch.full((*SIZE, 1), 0.3)
    prediction[3, 4] = broken
    for score in (psnr, ssim, lambda p, t: mae_c(p, t, RANGE)):
        with pytest.raises(ValueError, match="prediction has 1 pixels that are NaN or infinite"):
            score(prediction, target)


# The sensor ----------------------------------------------------------------------------------------------------------

FRAME = Frame("seen.png", 0, camera(0.0))


def chain() -> SensorChain:
    control = GainControl()
    control.frame_ids, control.raw = torch.tensor([0, 1]), torch.nn.Parameter(torch.zeros(2, 2))
    return SensorChain({"calibration": Calibration(grid=4), "tone": Tone(width=8), "agc": control})


@settings(max_examples=40)
@given(seeds(), logarithmic(1e-3, 1e4, 0.0), st.sampled_from([-1.0, 1.0]))
def test_the_sensor_stays_within_its_bounds_wherever_training_takes_it(seed, size, sign):
    """Raw settings of any size: the image stays near what it was, and every gradient is finite."""
    sensor, random = chain(), generator(seed)
    with torch.no_grad():
        for parameter in sensor.parameters():
            parameter.copy_(sign * size * (2 * torch.rand(parameter.shape, generator=random) - 0.5))
    clean = torch.cat([image(seed, 0.5, 1.0), torch.tensor([0.0, 1.0, -0.5, 1.5]).view(1, 4, 1).repeat(1, 3, 1)])
    clean.requires_grad_()
    seen = sensor(clean, FRAME)
    penalty = sum(sensor.regularisers().values())
    (seen.sum() + penalty).backward()
    assert seen.isfinite().all() and clean.grad.isfinite().all() and penalty.isfinite() and penalty >= 0
    assert all(p.grad is None or p.grad.isfinite().all() for p in sensor.parameters())
    assert seen.abs().max() <= 1.5 * (1 + 0.4) * (1 + 0.4) * math.e + 2


def test_the_sensor_at_rest_is_the_identity():
    clean = image(0, 0.5, 1.0)
    torch.testing.assert_close(chain()(clean, FRAME), clean, rtol=0, atol=1e-7)
