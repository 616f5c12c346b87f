"""Double precision of a run: every method, the same first step as in float32 but for rounding."""

import pytest
import torch
from helpers import ALL_METHODS
from running import TINY, run

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.runs.stepping import Stepper

FOUND_OUT = {"auto"}  # its parts depend on the scene
METHODS = sorted(set(ALL_METHODS) - FOUND_OUT)
SHORT = (*TINY, "max_steps=4", "density=fixed", "trainer.val_check_interval=4", "trainer.limit_val_batches=1")


@pytest.mark.parametrize("method", METHODS)
def test_the_first_step_in_float64_is_that_in_float32_but_for_rounding(method, tmp_path):
    plain = compose([*SHORT, f"method={method}"])
    scene, slopes, losses = build(plain["data"]).scene, {}, {}
    for dtype in ("float32", "float64"):
        stepper = Stepper(build(plain["module"] | {"dtype": dtype}), scene, step=0, device="cpu")
        module = stepper.module
        assert {str(parameter.dtype) for parameter in module.parameters()} == {f"torch.{dtype}"}
        losses[dtype] = module.training_step(scene.train[0], 0)["loss"]
        losses[dtype].backward()
        slopes[dtype] = {name: x.grad for name, x in module.named_parameters() if x.grad is not None}
        assert {str(slope.dtype) for slope in slopes[dtype].values()} == {f"torch.{dtype}"}
    assert losses["float64"].dtype == torch.float64
    assert losses["float64"].item() == pytest.approx(losses["float32"].item(), rel=1e-4)
    assert slopes["float32"].keys() == slopes["float64"].keys()
    for name, slope in slopes["float64"].items():
        assert (slope - slopes["float32"][name]).norm() <= 2e-2 * slope.norm() + 1e-8, name


def test_a_run_in_float64_is_evaluated_and_goes_on_in_float64(tmp_path):
    module, _ = run(tmp_path / "first", *SHORT, "method=etgs", "dtype=float64", "test=false")
    assert module.splats["means"].dtype == module.background.dtype == torch.float64
    checkpoint = tmp_path / "first" / "checkpoints" / "last.ckpt"
    again, _ = run(tmp_path / "again", *SHORT, "method=etgs", "dtype=float64", "max_steps=6", f"ckpt={checkpoint}")
    assert again.splats["means"].dtype == torch.float64 and again.results.test["psnr"] > 5


def test_the_reference_renderer_takes_a_run_in_float64_as_it_is(tmp_path):
    kinds = {}
    for backend in ("cpu", "reference"):
        plain = compose([*SHORT, "data.downscale=4", "method=3dgs", "dtype=float64"])
        plain["module"]["renderer"]["backend"] = backend
        scene = build(plain["data"]).scene
        module = build(plain["module"])
        module.attach(scene)
        kinds[backend] = module.predict(scene.train.frames[0])
    assert kinds["cpu"].dtype == kinds["reference"].dtype == torch.float64
    assert torch.equal(kinds["cpu"].float().double(), kinds["cpu"])  # splatted in float32
    assert not torch.equal(kinds["reference"].float().double(), kinds["reference"])
    assert torch.allclose(kinds["cpu"], kinds["reference"], atol=1e-4)


def test_other_precisions_are_refused(tmp_path):
    with pytest.raises(SceneError, match="trainer.precision=bf16-mixed would convert .* dtype=float64"):
        run(tmp_path, *SHORT, "method=3dgs", "+trainer.precision=bf16-mixed")
    with pytest.raises(Exception, match="dtype must be float32 or float64, got 'float16'"):
        run(tmp_path, *SHORT, "method=3dgs", "dtype=float16")
