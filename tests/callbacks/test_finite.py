"""FiniteGuard: names the tensor and the step, and keeps NaN out of every checkpoint."""

import pytest
import torch
from fake_run import FakeModule, fit, trainer, wall
from pytorch_lightning.callbacks import ModelCheckpoint

from heatsplat.callbacks.finite import FiniteGuard, NotFinite, demand_finite


def test_names_the_loss_term_and_the_step(tmp_path):
    module = FakeModule(wall(), tmp_path, poison={"loss": 4})
    with pytest.raises(NotFinite, match=r"step 5: loss term 'prior' has 1 NaN and 0 infinite values\."):
        fit(module, trainer(tmp_path, [FiniteGuard()], steps=12))


def test_names_the_gradient_before_the_optimiser_uses_it(tmp_path):
    module = FakeModule(wall(), tmp_path, poison={"gradient": 4})
    with pytest.raises(
        NotFinite, match=r"step 5: gradient of splats\.raw\.quats has 1 NaN .* first at \[5, 2\] of \[300, 4\]"
    ):
        fit(module, trainer(tmp_path, [FiniteGuard(every=2)], steps=12))
    assert all(torch.isfinite(p).all() for p in module.parameters())


@pytest.mark.parametrize("every", [4, 1000])
def test_names_the_parameter_in_the_step_in_which_it_breaks(tmp_path, every):
    class Breaks(FakeModule):
        def on_before_zero_grad(self, optimizer):
            if self.global_step == 3:
                self.splats.raw["opacity_logits"].data[7] = float("inf")

    with pytest.raises(NotFinite, match=r"step 4: parameter splats\.raw\.opacity_logits has 0 NaN and 1 infinite"):
        fit(Breaks(wall(), tmp_path), trainer(tmp_path, [FiniteGuard(every=every)], steps=12))


@pytest.mark.parametrize("poison", ["loss", "gradient"])
def test_no_checkpoint_holds_a_nan(tmp_path, poison):
    save = ModelCheckpoint(tmp_path / "c", filename="{step}", every_n_train_steps=1, save_top_k=-1, save_last=True)
    module = FakeModule(wall(), tmp_path, poison={poison: 5})
    with pytest.raises(NotFinite, match="step 6"):
        fit(module, trainer(tmp_path, [FiniteGuard(every=1000), save], steps=12))
    assert any(not torch.isfinite(p).all() for p in module.parameters())  # the run itself is lost
    written = sorted((tmp_path / "c").glob("*.ckpt"))
    assert [p.stem for p in written] == ["last", *(f"step={i}" for i in range(1, 6))]
    for path in written:
        stored = torch.load(path, weights_only=True)
        assert all(torch.isfinite(t).all() for t in stored["state_dict"].values())
        for state in stored["optimizer_states"][0]["state"].values():
            assert all(torch.isfinite(t).all() for t in state.values())


def test_broken_moments_are_no_checkpoint_either(tmp_path):
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [FiniteGuard()], steps=4)
    fit(module, job)
    job.save_checkpoint(tmp_path / "good.ckpt")
    job.optimizers[0].state[module.value]["exp_avg_sq"].fill_(float("inf"))
    with pytest.raises(NotFinite, match="optimiser's exp_avg_sq of value has 0 NaN and 1 infinite"):
        job.save_checkpoint(tmp_path / "bad.ckpt")
    assert (tmp_path / "good.ckpt").exists() and not (tmp_path / "bad.ckpt").exists()


def test_a_broken_parameter_is_no_checkpoint_although_its_moments_are_sound(tmp_path):
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [FiniteGuard()], steps=4)
    fit(module, job)
    module.splats.raw["opacity_logits"].data[7] = float("nan")
    with pytest.raises(NotFinite, match=r"parameter splats\.raw\.opacity_logits has 1 NaN"):
        job.save_checkpoint(tmp_path / "bad.ckpt")
    assert not (tmp_path / "bad.ckpt").exists()


def test_a_sound_run_is_left_alone(tmp_path):
    module = FakeModule(wall(), tmp_path)
    fit(module, trainer(tmp_path, [FiniteGuard(every=1)], steps=6))
    assert module.global_step == 6


def test_large_values_whose_sum_overflows_are_finite():
    demand_finite([("large", torch.full((100,), 1e37)), ("whole", torch.tensor([1, 2]))], step=1)
    with pytest.raises(NotFinite, match=r"large has 0 NaN and 1 infinite values, first at \[3\] of \[100\]"):
        demand_finite([("large", torch.full((100,), 1e37).index_fill(0, torch.tensor([3]), float("inf")))], step=1)
