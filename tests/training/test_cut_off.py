"""Images that were cut off at an end of their span: what lies beyond is right, in a training step and in scores."""

from dataclasses import replace

import pytest
import torch
from running import TINY

from heatsplat.callbacks.metrics import QualityMetrics
from heatsplat.composition import build, compose
from heatsplat.runs.stepping import Stepper


@pytest.mark.parametrize("method", ["3dgs", "etgs"])
def test_beyond_an_end_nothing_is_lost_and_within_it_is(method):
    """An image that is black but for its mark of a bound asks for nothing; without the mark it asks for darkness."""
    plain = compose([*TINY, f"method={method}", "max_steps=4", "density=fixed"])
    scene = build(plain["data"]).scene
    module = Stepper(build(plain["module"]), scene, step=0, device="cpu").module
    view = scene.train[0]
    black, white = torch.zeros_like(view.thermal), torch.full_like(view.thermal, 2.0)
    ends = torch.ones(view.thermal.shape[:2], dtype=torch.int8)

    def lost(image, sign):
        own = None if sign == 0 else sign * ends
        terms = module.training_step(replace(view, thermal=image, ends=own), 0)["terms"]
        return sum(terms[name].item() for name in terms if "l1" in name or "ssim" in name)

    assert lost(black, 0) > 0.05 and lost(white, 0) > 0.05
    assert abs(lost(black, 1)) < 1e-3 and abs(lost(white, -1)) < 1e-3
    assert lost(black, -1) == pytest.approx(lost(black, 0)) and lost(white, 1) == pytest.approx(lost(white, 0))


def test_scores_take_what_lies_beyond_an_end_for_right():
    plain = compose([*TINY, "method=3dgs", "max_steps=4", "density=fixed"])
    scene = build(plain["data"]).scene
    module = Stepper(build(plain["module"]), scene, step=0, device="cpu").module
    view = replace(scene.test[0], clean=None)
    metrics = QualityMetrics(lpips_net=None)
    metrics._begin(module, lpips=False)
    ends = torch.zeros(view.thermal.shape[:2], dtype=torch.int8)
    ends[:4] = 1
    prediction = view.thermal.clone()
    prediction[:4] += 0.1
    for own in (None, ends, -ends):
        metrics._score(module, {"view": replace(view, ends=own), "prediction": prediction, "seconds": 0.0})
    unmarked, above, below = (row["mae_c"] for row in metrics._rows)
    assert above < 1e-6 < unmarked and below == pytest.approx(unmarked)
