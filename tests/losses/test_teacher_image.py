"""SRGS's loss: both halves against plain torch, what is left out at the ends of w, masks, and a short run."""

import pytest
import torch
from running import TINY, run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.nn import functional

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, View
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import l1, ssim_map
from heatsplat.losses.teacher import Interpolation
from heatsplat.losses.teacher_image import TeacherAndTarget

HEIGHT, WIDTH, FACTOR = 12, 16, 4
FRAME = Frame("0.png", 0, Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT))


def noise(height, width, seed=0):
    return torch.rand(height, width, 1, generator=torch.Generator().manual_seed(seed))


def shrunk(image):
    """Averages over 4 x 4 pixels, by torch."""
    return functional.avg_pool2d(image.permute(2, 0, 1)[None], FACTOR)[0].permute(1, 2, 0)


def inputs(prediction, target, mask=None):
    return LossInputs(prediction, target, mask, View(FRAME, target, mask=mask), splats=None)


class Given:
    """A teacher whose answer is known."""

    description = "given"

    def __init__(self, fine):
        self.fine, self.asked = fine.half().float(), 0  # answers are kept in half precision

    def check(self, frame, factor):
        return

    def __call__(self, image, frame, factor):
        self.asked += 1
        return self.fine


FINE, COARSE, TAUGHT = (
    noise(FACTOR * HEIGHT, FACTOR * WIDTH),
    noise(HEIGHT, WIDTH, 1),
    noise(FACTOR * HEIGHT, FACTOR * WIDTH, 2),
)


def photometric(prediction, target):
    """(L1, 1 - SSIM) in double precision."""
    prediction, target = prediction.double(), target.double()
    return l1(prediction, target).mean().item(), 1 - ssim_map(prediction, target).mean().item()


@pytest.mark.parametrize("target_weight", [0.6, 0.25])
def test_both_halves_are_shares_of_the_loss_of_3dgs(target_weight):
    teacher = Given(TAUGHT)
    got = TeacherAndTarget(lambda: teacher, FACTOR, target_weight)(inputs(FINE, COARSE))
    by_teacher, by_target = photometric(FINE, teacher.fine), photometric(shrunk(FINE), COARSE)
    assert {name: value.item() for name, value in got.items()} == pytest.approx(
        {
            "teacher/l1": (1 - target_weight) * 0.8 * by_teacher[0],
            "teacher/dssim": (1 - target_weight) * 0.2 * by_teacher[1],
            "target/l1": target_weight * 0.8 * by_target[0],
            "target/dssim": target_weight * 0.2 * by_target[1],
        },
        rel=1e-5,
    )


def test_at_its_ends_a_half_is_absent_and_the_teacher_is_not_even_asked():
    teacher = Given(TAUGHT)
    alone = TeacherAndTarget(lambda: teacher, FACTOR, 0.6, sr_only=True)(inputs(FINE, COARSE))
    assert set(alone) == {"teacher/l1", "teacher/dssim"} and teacher.asked == 1
    assert alone["teacher/l1"].item() == pytest.approx(0.8 * photometric(FINE, teacher.fine)[0], rel=1e-5)
    without = TeacherAndTarget(lambda: pytest.fail("asked"), FACTOR, 1.0)
    assert set(without(inputs(FINE, COARSE))) == {"target/l1", "target/dssim"}
    assert without.prepare(None, "thermal") == {}


def test_the_image_that_teacher_and_target_agree_on_costs_nothing():
    teacher = Given(TAUGHT)
    terms = TeacherAndTarget(lambda: teacher, FACTOR)(inputs(teacher.fine, shrunk(teacher.fine)))
    assert sum(terms.values()).item() == pytest.approx(0.0, abs=1e-6)


def test_masked_pixels_pull_at_nothing_and_their_neighbours_at_the_target_alone():
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[5, 6] = False
    target = COARSE.clone()
    target[5, 6] = float("nan")
    fine = FINE.clone().requires_grad_()
    terms = TeacherAndTarget(lambda: Interpolation("lanczos"), FACTOR)(inputs(fine, target, mask))
    taught = sum(value for name, value in terms.items() if name.startswith("teacher/"))
    (of_teacher,) = torch.autograd.grad(taught, fine, retain_graph=True)
    assert of_teacher[16:28, 20:32].abs().max() == 0 and of_teacher[:16].abs().max() > 0
    (of_all,) = torch.autograd.grad(sum(terms.values()), fine)
    assert of_all[20:24, 24:28].abs().max() == 0 and of_all[16:20, 24:28].abs().min() > 0
    assert of_all.isfinite().all()


@pytest.mark.parametrize("kernel", ["lanczos", "bicubic"])
def test_a_hole_in_the_image_does_not_ring_in_what_is_taught_beside_it(kernel):
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[5:8, 6:8] = False
    flat = torch.full_like(FINE, 0.8)
    terms = TeacherAndTarget(lambda: Interpolation(kernel), FACTOR)(inputs(flat, torch.full_like(COARSE, 0.8), mask))
    assert sum(terms.values()).item() == pytest.approx(0.0, abs=1e-3)


def test_what_cannot_be_is_named():
    with pytest.raises(ValueError, match=r"target_weight is a share of the loss in \[0, 1\] .* got 1.5, 4"):
        TeacherAndTarget(lambda: Given(TAUGHT), target_weight=1.5)
    with pytest.raises(ValueError, match="4 times as fine as the training image, the loss expects 2; set both by"):
        TeacherAndTarget(lambda: Given(TAUGHT), factor=2)(inputs(FINE, COARSE))


def test_a_run_renders_finely_and_learns_from_both(tmp_path):
    short = ("max_steps=8", "callbacks.statistics.every=1", "trainer.limit_test_batches=2")
    module, _ = run(tmp_path, *TINY, "method=srgs", "trainer.val_check_interval=8", *short)
    target, test = (views.frames[0].camera for views in (module.scene.train, module.scene.test))
    assert (test.width, test.height) == (4 * target.width, 4 * target.height)
    scalars = EventAccumulator(str(tmp_path / "tb")).Reload().Tags()["scalars"]
    halves = {f"loss/photometric/{half}/{part}" for half in ("teacher", "target") for part in ("l1", "dssim")}
    assert halves <= set(scalars) and "lanczos" in (tmp_path / "report.md").read_text()


def test_what_the_published_code_optimises_is_one_word(tmp_path):
    config = compose(["method=srgs", "sr_only=true"])
    (term,) = build(config["loss"]).terms.values()
    assert term.target_weight == 0.0
