"""Comparing on the target's grid, the curriculum of weights, the cosine ramp, and preparing terms."""

from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, View, ViewSet
from heatsplat.geometry.resampling import resampled
from heatsplat.losses.compose import During, Loss, LossInputs, LossTerm, Weighted
from heatsplat.losses.low_resolution import Curriculum, OnTargetGrid, fineness
from heatsplat.losses.modality_balance import ByOthersShare
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.schedules import cosine, linear

FRAME = Frame("0.png", 0, Camera(torch.eye(4), torch.eye(3), 16, 12))


def noise(height, width, seed=0):
    return torch.rand(height, width, 1, generator=torch.Generator().manual_seed(seed))


def inputs(prediction, target, mask=None, step=50):
    return LossInputs(prediction, target, mask, View(FRAME, target), splats=None, step=step, progress=step / 100)


@pytest.mark.parametrize("kernel", ["bicubic", "area"])
def test_a_fine_prediction_is_compared_after_it_shrank(kernel):
    fine, coarse = noise(48, 64).requires_grad_(), noise(12, 16, 1)
    term = OnTargetGrid(Photometric(0.2), kernel)
    got = term(inputs(fine, coarse))
    expected = Photometric(0.2)(inputs(resampled(fine, 12, 16, kernel), coarse))
    assert {name: value.item() for name, value in got.items()} == {name: v.item() for name, v in expected.items()}
    sum(got.values()).backward()
    assert fine.grad.isfinite().all() and fine.grad.abs().max() > 0


@pytest.mark.parametrize(
    ("given", "made_by", "used"), [(None, "bicubic", "bicubic"), (None, None, "area"), ("area", "bicubic", "area")]
)
def test_the_kernel_is_that_of_the_training_images_unless_one_is_given(given, made_by, used):
    fine, coarse = noise(48, 64), noise(12, 16, 1)
    term = OnTargetGrid(Photometric(0.0), given)
    term.prepare(SceneData("room", *[ViewSet([], None)] * 3, torch.zeros(4, 3), reduced_by=made_by), "thermal")
    expected = (resampled(fine, 12, 16, used) - coarse).abs().mean()
    torch.testing.assert_close(term(inputs(fine, coarse))["l1"], expected)


def test_a_companion_shrinks_to_its_own_target():
    fine, coarse, sharp = (
        noise(height, width, 3).expand(-1, -1, 3) for height, width in ((48, 64), (12, 16), (48, 64))
    )
    for target in (coarse, sharp):
        given = replace(inputs(noise(48, 64), noise(12, 16, 1)), companions={"rgb": (fine, target)})
        got = OnTargetGrid(Photometric(0.0, modality="rgb"), "area")(given)
        expected = (resampled(fine, *target.shape[:2], "area") - target).abs().mean()
        torch.testing.assert_close(got["l1"], expected)


def test_an_image_that_would_be_recorded_so_costs_nothing():
    fine = noise(48, 64)
    terms = OnTargetGrid(Photometric(0.2), "bicubic")(inputs(fine, resampled(fine, 12, 16, "bicubic")))
    assert sum(terms.values()).item() == pytest.approx(0.0, abs=1e-6)


def test_the_same_size_is_passed_on_as_it_is():
    seen = []
    prediction = noise(12, 16)
    OnTargetGrid(lambda given: seen.append(given.prediction) or prediction.mean())(inputs(prediction, noise(12, 16, 1)))
    assert seen[0] is prediction


def test_grids_that_do_not_fit_are_named():
    with pytest.raises(
        ValueError, match="prediction has 60 x 48 pixels and the target 16 x 12: the first must be a whole"
    ):
        OnTargetGrid(Photometric())(inputs(noise(48, 60), noise(12, 16)))
    assert fineness(inputs(noise(36, 48), noise(12, 16))) == 3
    with pytest.raises(ValueError, match="kernel must be one of area, .*, got 'nearest'"):
        OnTargetGrid(Photometric(), "nearest")


@pytest.mark.parametrize(
    "step, ssim, boost", [(0, 0.0, 0.0), (10, 0.0, 0.0), (25, 0.5, 0.0), (75, 1.0, 0.5), (99, 1.0, 1.0)]
)
def test_ssim_comes_on_top_of_l1_and_both_follow_their_ramps(step, ssim, boost):
    term = Curriculum(0.2, lambda p: cosine(p, 0.10, 0.40), 0.5, lambda p: cosine(p, 0.55, 0.95))
    given = inputs(noise(12, 16), noise(12, 16, 1), step=step)
    plain = Photometric(0.5)(given)
    got = term(given)
    assert got["l1"].item() == pytest.approx(2 * plain["l1"].item() * (1 + 0.5 * boost), rel=1e-5)
    if ssim == 0:
        assert "dssim" not in got  # absent, not zero
    else:
        assert got["dssim"].item() == pytest.approx(2 * plain["dssim"].item() * 0.2 * ssim, rel=1e-5)


def test_without_schedules_weights_are_constant():
    given = inputs(noise(12, 16), noise(12, 16, 1), step=0)
    plain = Photometric(0.5)(given)
    got = Curriculum(0.3)(given)
    assert got["l1"].item() == pytest.approx(2 * plain["l1"].item(), rel=1e-5)
    assert got["dssim"].item() == pytest.approx(0.6 * plain["dssim"].item(), rel=1e-5)
    with pytest.raises(ValueError, match="must not be negative, got -0.1, 0.0"):
        Curriculum(-0.1)


def test_the_cosine_ramp_is_equation_11():
    assert [cosine(p, 0.65, 0.95) for p in (0.0, 0.65, 0.95, 1.0)] == [0.0, 0.0, 1.0, 1.0]
    assert cosine(0.80, 0.65, 0.95) == pytest.approx(0.5)
    assert cosine(0.725, 0.65, 0.95) == pytest.approx(0.5 * (1 - 2**-0.5))
    assert cosine(0.8, 0.65, 0.95, before=2.0, after=4.0) == pytest.approx(3.0)
    assert cosine(0.5, 0.5, 0.5) == 1.0
    assert cosine(0.66, 0.65, 0.95) < linear(0.66, 0.65, 0.95)  # without a kink
    with pytest.raises(ValueError, match="before it starts"):
        cosine(0.1, 0.9, 0.5)


def test_terms_that_ask_for_it_are_prepared_once_through_everything_around_them():
    class Asking(LossTerm):
        def __init__(self):
            self.asked = []

        def prepare(self, scene, modality):
            self.asked.append((scene, modality))
            return {"teacher": "a kernel"}

        def __call__(self, inputs):
            return inputs.prediction.mean()

    term, shared, idle = Asking(), Asking(), Asking()
    around = {"fine": Weighted(OnTargetGrid(term, "area"), 0.1), "shared": During(ByOthersShare(shared, 0), stop=9)}
    loss = Loss(around | {"off": Weighted(idle, 0.0), "plain": Photometric()})
    assert loss.prepare("scene", "thermal") == {"teacher": "a kernel"}
    assert term.asked == shared.asked == [("scene", "thermal")] and idle.asked == []
