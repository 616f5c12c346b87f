"""Runs of Mip-Splatting: the filter follows density control, survives a checkpoint, and is absent elsewhere."""

import pytest
import torch
from running import TINY, run

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.density.ops import Cloud
from heatsplat.geometry.smoothing import sampling_intervals
from heatsplat.renderers.smoothing import SamplingFilter
from heatsplat.splats import Splats
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.session import restore

SHORT = (
    *TINY,
    "method=mip_splatting",
    "density=adaptive",
    "max_steps=30",
    "optim.length_power=0",  # centres move little in six steps
    "density.start=5",
    "density.every=10",
    "density.stop=18",
    "smoothing.every=6",
    "trainer.val_check_interval=30",
    "callbacks.checkpoint.every_n_train_steps=14",
    "test=false",
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mip")
    return *run(folder, *SHORT), folder


def test_the_filter_follows_density_control_and_rests_at_the_end(whole):
    module, _, folder = whole
    widths, cameras = module.smoothing.widths, [frame.camera for frame in module.scene.train.frames]
    assert len(widths) == len(module.splats) > 600
    now = 0.2**0.5 * sampling_intervals(module.splats.means.detach(), cameras)
    assert torch.allclose(widths, now, rtol=0.05) and not torch.equal(widths, now)
    # Those of step 18, not of step 24 or 30: a checkpoint between them has them, too.
    later = load_checkpoint(folder / "checkpoints" / "step_000028.ckpt")["state_dict"]
    assert torch.equal(later["smoothing.widths"], widths)


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(whole, tmp_path):
    module, _, folder = whole
    half = folder / "checkpoints" / "step_000014.ckpt"
    resumed, _ = run(tmp_path, *SHORT, f"ckpt={half}")
    wanted = module.state_dict()
    assert [name for name, value in resumed.state_dict().items() if not torch.equal(value, wanted[name])] == []


def test_a_restored_checkpoint_shows_the_same_image(whole, tmp_path):
    module, _, folder = whole
    plain = compose([*SHORT])
    fresh = build(plain["module"], output_dir=str(tmp_path))
    fresh.config = plain
    restore(fresh, build(plain["data"]), load_checkpoint(folder / "checkpoints" / "last.ckpt"))
    frame = module.scene.test.frames[0]
    assert torch.equal(fresh.predict(frame), module.predict(frame))
    assert torch.equal(fresh.smoothing.widths, module.smoothing.widths)


def test_without_the_filter_there_is_no_tensor_of_it(tmp_path):
    plain = compose([*TINY, "method=3dgs"])
    module = build(plain["module"])
    module.attach(build(plain["data"]).scene)
    assert not [name for name in module.state_dict() if "smoothing" in name]
    scales, opacities = module.splats.scales, module.splats.opacities
    same = module.smoothing(scales, opacities)
    assert same[0] is scales and same[1] is opacities
    assert module.renderer.eps2d == pytest.approx(1 / 12) and module.renderer.antialiased  # of every method


def test_a_scene_nearer_than_the_filter_looks_is_told(tmp_path):
    with pytest.raises(SceneError, match="smoothing.near=1000 does not fit scene .* lower 'near'"):
        run(tmp_path, *SHORT, "smoothing.near=1000")
    with pytest.raises(ValueError, match="smoothing.variance must be positive, every at least 1"):
        SamplingFilter(every=0)


@pytest.mark.parametrize("filtered", [False, True])
def test_a_reset_lowers_opacities_as_they_are_rendered(filtered):
    kept = torch.tensor([1.0, 0.2, 0.005, 0.0])
    tensors = {"means": torch.zeros(4, 3), "log_scales": torch.zeros(4, 3), "quats": torch.ones(4, 4)}
    logits = torch.logit(torch.tensor([[0.9], [0.9], [0.9], [0.004]]))
    cloud = Cloud(Splats(tensors | {"opacity_logits": logits}), None, {}, lambda *_: kept if filtered else None)
    cloud.lower_opacities(0.01)
    expected = [0.01, 0.05, 0.9, 0.004] if filtered else [0.01, 0.01, 0.01, 0.004]
    assert cloud.splats.opacities[0].tolist() == pytest.approx(expected, rel=1e-5)
