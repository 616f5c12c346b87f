"""MAE in °C, Otsu's threshold and both regions of interest, against OpenCV, kornia, torchmetrics and by hand."""

import math

import cv2
import pytest
import torch
from torchmetrics.functional.regression import mean_absolute_error

from heatsplat.contracts import ThermalRange
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.metrics.mae import mae_c
from heatsplat.metrics.mae_roi import mae_roi_image_c, mae_roi_scene_c, scene_threshold
from heatsplat.metrics.otsu import otsu_level
from heatsplat.metrics.scores import Scorer, mean_of_images
from heatsplat.training.rng import generator_for

RANGE = ThermalRange(10.0, 50.0)


def scene(seed=0, height=36, width=48):
    """A warm disc on a cool ground in 8-bit steps, as both papers' data are."""
    generator = generator_for(seed, 0, "disc")
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    warm = (x - 20 - 3 * seed) ** 2 + (y - 15) ** 2 < 90
    image = torch.where(warm, 0.8, 0.25) + 0.08 * torch.randn(height, width, generator=generator)
    return ((image.clamp(0, 1) * 255).round() / 255)[..., None]


def test_mae_agrees_with_torchmetrics():
    target, prediction = scene(0), scene(1)
    expected = 40.0 * mean_absolute_error(prediction, target).item()
    assert mae_c(prediction, target, RANGE) == pytest.approx(expected, rel=1e-5)


def test_outlier_rule_by_hand():
    target = torch.zeros(1, 4, 1)
    prediction = torch.tensor([0.1, 0.2, 0.25, 0.5])[None, :, None]  # errors of 4, 8, 10 and 20 °C
    assert mae_c(prediction, target, RANGE) == pytest.approx(42 / 4, rel=1e-6)
    assert mae_c(prediction, target, RANGE, outlier_c=10.0) == pytest.approx(22 / 3, rel=1e-6)
    assert mae_c(prediction, target, RANGE, outlier_c=1.0) is None
    mask = torch.tensor([[True, False, False, True]])
    assert mae_c(prediction, target, RANGE, mask) == pytest.approx(12.0, rel=1e-6)


def test_pseudo_colour_is_no_temperature():
    image = torch.zeros(4, 4, 3)
    with pytest.raises(ValueError, match="pseudo-colour has no temperature"):
        mae_c(image, image, RANGE)


@pytest.mark.parametrize("seed", range(4))
def test_otsu_agrees_with_opencv_and_kornia(seed):
    from kornia.filters import otsu_threshold as kornia_otsu  # here: every test process would load it

    target = scene(seed)
    levels = (target[..., 0] * 255).round().to(torch.uint8)
    expected, _ = cv2.threshold(levels.numpy(), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    level = otsu_level(target)
    assert level == expected
    warm, _ = kornia_otsu(levels[None, None].float(), nbins=256)
    # kornia puts the threshold elsewhere in the gap between the classes; the classes must be nearly the same.
    assert ((warm[0, 0] > 0) != (levels > level)).float().mean() < 0.01


def test_otsu_of_a_masked_part_is_otsu_of_that_part():
    target = scene(2)
    mask = torch.zeros(target.shape[:2], dtype=torch.bool)
    mask[:, :30] = True
    spoiled = torch.where(mask[..., None], target, 1.0)
    assert otsu_level(spoiled, mask) == otsu_level(target[:, :30])
    spoiled = torch.where(mask[..., None], target, float("nan"))
    assert otsu_level(spoiled) == otsu_level(target[:, :30])


def test_a_constant_image_has_no_region_of_interest():
    flat = torch.full((12, 12, 1), 0.4)
    assert otsu_level(flat) is None
    assert mae_roi_image_c(flat, flat, RANGE) is None
    assert otsu_level(scene(), torch.zeros(36, 48, dtype=torch.bool)) is None
    assert scene_threshold([(flat, None)]) is None
    rows = [{"mae_roi_c": None}, {"mae_roi_c": 2.0}, {"mae_roi_c": 4.0}]
    assert mean_of_images(rows, "mae_roi_c") == 3.0
    assert mean_of_images(rows[:1], "mae_roi_c") is None


def test_roi_of_supirgs_by_hand():
    target = torch.tensor([0.2, 0.2, 0.2, 0.8, 0.8, 0.8])[None, :, None]
    prediction = target + torch.tensor([0.9, -0.1, 0.3, 0.1, -0.1, -0.4])[None, :, None]
    assert mae_roi_image_c(prediction, target, RANGE) == pytest.approx(40 * 0.6 / 3, rel=1e-5)
    assert mae_roi_image_c(prediction, target, RANGE, outlier_c=10.0) == pytest.approx(4.0, rel=1e-5)
    mask = torch.tensor([[True, True, True, True, False, True]])
    assert mae_roi_image_c(prediction, target, RANGE, mask) == pytest.approx(40 * 0.5 / 2, rel=1e-5)


def test_roi_of_thermonerf_uses_one_threshold_for_the_scene():
    targets = [scene(seed) for seed in range(3)]
    levels = [cv2.threshold((t[..., 0] * 255).round().byte().numpy(), 0, 255, cv2.THRESH_OTSU)[0] for t in targets]
    threshold = scene_threshold([(t, None) for t in targets] + [(torch.full((5, 5, 1), 0.1), None)])
    assert threshold == pytest.approx(sum(levels) / 3 / 255, abs=1e-12)
    prediction = scene(7)
    difference = (prediction - targets[0]).abs() * 40
    warm = targets[0] > threshold
    value = mae_roi_scene_c(prediction, targets[0], RANGE, threshold)
    assert value == pytest.approx(difference[warm].mean().item(), rel=1e-5)
    cold = mae_roi_scene_c(prediction, targets[0], RANGE, threshold, cold=True)
    assert cold == pytest.approx(difference[targets[0] < threshold].mean().item(), rel=1e-5)
    assert value != pytest.approx(cold, rel=0.05)
    assert mae_roi_scene_c(prediction, targets[0], RANGE, threshold=1.0) is None  # nothing lies above


def test_scorer_gives_every_score_or_none():
    target, prediction = scene(0), scene(1)
    scores = Scorer(RANGE, threshold=0.5)(prediction, target)
    assert list(scores) == [*DEFINITIONS, "counted", "saturated"]
    assert [name for name, value in scores.items() if value is None] == ["lpips"]
    assert scores["mae_c"] == mae_c(prediction, target, RANGE)
    assert scores["mae_roi_inlier_c"] == mae_roi_image_c(prediction, target, RANGE, outlier_c=10.0)
    assert scores["mae_roi_scene_c"] == mae_roi_scene_c(prediction, target, RANGE, 0.5)
    assert scores["counted"] == 1.0
    assert scores["mae_inlier_c"] < scores["mae_c"]
    bare = Scorer()(prediction, target)
    assert {name for name, value in bare.items() if value is None} == {
        n for n in DEFINITIONS if n not in ("psnr", "ssim")
    }


def test_scorer_of_a_masked_image_with_nan():
    target, prediction = scene(0), scene(1)
    mask = torch.ones(target.shape[:2], dtype=torch.bool)
    mask[:, 40:] = False
    target[0, 0] = float("nan")
    scores = Scorer(RANGE, threshold=0.5)(prediction, target, mask)
    assert all(math.isfinite(value) for name, value in scores.items() if name != "lpips")
    assert scores["counted"] == pytest.approx((40 * 36 - 1) / (48 * 36))
