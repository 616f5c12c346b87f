"""Baselines on colour and thermal images: one cloud, two rounds on one cloud, and a cloud for each image."""

import json
from itertools import pairwise

import pytest
import torch
from running import TINY, run

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.runs.stepping import Stepper
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.init import ABSENT

SHORT = (
    *TINY,
    "trainer.val_check_interval=20",
    "trainer.limit_val_batches=1",
    "trainer.limit_test_batches=1",
    "callbacks.costs.fps_repeats=1",
)
ROUNDS = (
    *SHORT,
    "method=mftg",
    "max_steps=20",
    "density.start=2",
    "density.every=4",
    "density.stop=7",
    "callbacks.checkpoint.every_n_train_steps=10",
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    plain = compose([*SHORT, "method=msmg"])
    return build(plain["data"]).scene


def stepper(scene, folder, *overrides):
    plain = compose([*SHORT, *overrides])
    return Stepper(build(plain["module"]), scene, step=0, device="cpu")


# One cloud ------------------------------------------------------------------------------------------------------------


def terms_at_start(scene, folder, *overrides):
    module = stepper(scene, folder, *overrides).module
    return {name: term.item() for name, term in module.training_step(scene.train[0], 0)["terms"].items()}


def test_losses_are_those_of_a_model_for_each_image(scene, tmp_path):
    """Before the first step the cloud shows in each image what a cloud of that image alone would show."""
    thermal = terms_at_start(scene, tmp_path, "method=3dgs", "thermal.sh_degree=3")
    colour = ("method=3dgs", "thermal.sh_degree=3", "thermal.modality=rgb", "thermal.channels=3")
    colour = terms_at_start(scene, tmp_path, *colour)
    both = terms_at_start(scene, tmp_path, "method=3dgs_ir")
    halves = terms_at_start(scene, tmp_path, "method=ommg")
    assert set(both) == {"thermal/l1", "thermal/dssim", "rgb/l1", "rgb/dssim"} == set(halves) - {"smoothness"}
    for part in ("l1", "dssim"):
        assert both[f"thermal/{part}"] == pytest.approx(thermal[f"photometric/{part}"], rel=1e-5)
        assert both[f"rgb/{part}"] == pytest.approx(colour[f"photometric/{part}"], rel=1e-5)
        assert halves[f"thermal/{part}"] == pytest.approx(0.5 * both[f"thermal/{part}"], rel=1e-6)
        assert halves[f"rgb/{part}"] == pytest.approx(0.5 * both[f"rgb/{part}"], rel=1e-6)
    module = stepper(scene, tmp_path, "method=ommg").module
    still = module.predict(scene.train.frames[0])[..., 0].double()
    differences = sum(still.diff(dim=axis).abs().sum().item() for axis in (0, 1))
    assert halves["smoothness"] == pytest.approx(0.3 * 2 * differences / still.numel(), rel=1e-3)


def test_a_camera_s_part_of_a_run_on_visible_images_is_prepared_with_those(scene, tmp_path):
    colour = ("method=3dgs", "thermal.modality=rgb", "thermal.channels=3", "sensor=histogram_alignment")
    (part,) = stepper(scene, tmp_path, *colour).module.sensor.parts.values()
    shares = torch.linspace(0.0, 1.0, part.count)
    known = torch.stack([view.rgb.flatten().quantile(shares) for view in scene.train])
    assert torch.allclose(part.shared, known.mean(0), atol=1e-3)


def test_images_that_no_term_compares_are_warned_of(tmp_path, caplog):
    given = (*SHORT, "max_steps=1", "test=false", "trainer.limit_val_batches=0", "loss=photometric")
    run(tmp_path, *given, "method=3dgs_ir")
    assert "no term of loss.terms compares rgb images: they are scored, but not learned" in caplog.text


def test_a_run_scores_both_images(tmp_path, caplog):
    module, _ = run(tmp_path, *SHORT, "method=3dgs_ir", "max_steps=2", "trainer.val_check_interval=2")
    assert "no term of loss.terms" not in caplog.text
    found = json.loads((tmp_path / "metrics.json").read_text())["test"]
    assert found["psnr"] > 5 and found["rgb_psnr"] > 5
    assert module.splats["sh0"].shape[1:] == (1, 4) and module.splats["sh_rest"].shape[1:] == (15, 4)
    assert module.splats.opacities.shape[0] == 1


# Two rounds -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rounds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rounds")
    return *run(folder, *ROUNDS, "test=false"), folder


def test_the_second_round_trains_the_same_gaussians_on_the_other_image(rounds):
    module, trainer, folder = rounds
    middle = load_checkpoint(folder / "checkpoints" / "step_000010.ckpt")
    before, after = middle["state_dict"], module.state_dict()
    moments = middle["optimizer_states"][0]["state"]
    last = trainer.optimizers[0]
    counted = [max(int(entry["step"]) for entry in state.values()) for state in (moments, last.state)]
    assert counted == [10, 10]  # and not 20
    shown = {group["name"]: last.state[group["params"][0]] for group in last.param_groups}
    assert shown["sh0"]["exp_avg"][..., 1:].abs().max() == 0 < shown["sh0"]["exp_avg"][..., 0].abs().max()
    first = moments[[group["name"] for group in middle["optimizer_states"][0]["param_groups"]].index("sh0")]
    assert first["exp_avg"][..., 0].abs().max() == 0 < first["exp_avg"][..., 1:].abs().max()
    # Colours are those of the first round: of every Gaussian that came later, those of its parent.
    known = {tuple(row) for row in before["splats.raw.sh0"][:, 0, 1:].tolist()}
    assert {tuple(row) for row in after["splats.raw.sh0"][:, 0, 1:].tolist()} <= known
    assert len(after["splats.raw.means"]) > len(before["splats.raw.means"]) > 600  # both rounds grew


def test_rates_start_again(rounds):
    module, trainer, _ = rounds
    (config,) = trainer.lr_scheduler_configs
    names = [group["name"] for group in trainer.optimizers[0].param_groups]
    means = config.scheduler.lr_lambdas[names.index("means")]
    assert means(0) == means(10) == 1.0
    assert means(5) == pytest.approx(0.1**0.5) == means(15) and means(20) == pytest.approx(0.1)


def test_a_run_of_two_rounds_resumes_bit_for_bit_where_the_second_begins(rounds, tmp_path):
    module, _, folder = rounds
    half = folder / "checkpoints" / "step_000010.ckpt"
    resumed, _ = run(tmp_path, *ROUNDS, "test=false", f"ckpt={half}")
    wanted = module.state_dict()
    assert [name for name, value in resumed.state_dict().items() if not torch.equal(value, wanted[name])] == []


# A cloud for each image -----------------------------------------------------------------------------------------------


def test_clouds_of_their_own_do_not_see_each_other(scene, tmp_path):
    """Each image is that of its cloud alone, and no image pulls at the cloud of the other."""
    module = stepper(scene, tmp_path, "method=msmg").module
    own = module.splats["opacity_logits"].argmax(1)
    count = len(own) // 2
    assert own.tolist() == [0] * count + [1] * count
    assert torch.equal(module.splats["means"][:count], module.splats["means"][count:])
    frame = scene.train.frames[0]
    alone = terms_at_start(scene, tmp_path, "method=3dgs_ir")
    terms = module.training_step(scene.train[0], 0)["terms"]
    assert terms["thermal/l1"].item() == pytest.approx(0.6 * 0.5 * alone["thermal/l1"], rel=1e-5)
    assert terms["rgb/l1"].item() == pytest.approx(0.3 * 0.5 * alone["rgb/l1"], rel=1e-5)
    image, colour = module.render(frame).features.split((1, 3), dim=-1)
    for part, others in ((image, own == 1), (colour, own == 0)):
        for name in ("means", "log_scales", "opacity_logits", "sh0"):
            (slope,) = torch.autograd.grad(part.sum(), module.splats[name], retain_graph=True)
            assert slope[others].abs().max() == 0 < slope[~others].abs().max(), name


def test_gaussians_stay_with_their_image_through_density_control(tmp_path):
    grow = (
        "density=adaptive",
        "optim.length_power=0",
        "density.start=5",
        "density.every=5",
        "density.stop=18",
        "density.reset_every=10",
        "max_steps=20",
    )
    module, _ = run(tmp_path, *SHORT, "method=msmg", "test=false", *grow, "density.grad_threshold=1e-5")
    logits = module.splats["opacity_logits"].detach()
    absent = logits == ABSENT
    assert (absent.sum(1) == 1).all() and (logits[~absent] > -10).all()
    thermal, colour = (~absent).sum(0).tolist()
    assert thermal + colour == len(logits) > 1300 and thermal != colour


def test_clouds_of_their_own_need_opacities_of_their_own(tmp_path):
    with pytest.raises(SceneError, match=r"init.separate=true .* one opacity for all; .*thermal.shared_opacity=false"):
        run(tmp_path, *SHORT, "method=3dgs", "init=separate", "max_steps=2")


def test_density_control_sees_the_weighted_gradients(scene, tmp_path):
    """Twice the weight of the loss is twice the statistic by which Gaussians are added."""
    seen = []
    for weight in (0.3, 0.6):
        one = stepper(scene, tmp_path, "method=msmg", "density=adaptive", f"loss.terms.rgb.weight={weight}")
        one.step(scene.train[0])
        colour = one.module.splats["opacity_logits"].argmax(1) == 1
        seen.append(one.module._density_state["gradient"][colour].sum().item())
    assert all(after == pytest.approx(2 * before, rel=1e-4) for before, after in pairwise(seen)) and seen[0] > 0
