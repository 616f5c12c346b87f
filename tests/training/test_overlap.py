"""Short lists of Gaussians: the entropy against brute force, resets, and that nothing is done where nothing is wanted."""

import pytest
import torch

from heatsplat.density.ops import Cloud
from heatsplat.renderers.base import rasterization
from heatsplat.splats import GEOMETRY, Splats
from heatsplat.training.overlap import Overlap, ShortLists
from heatsplat.training.schedule import Schedule

COUNT, SIDE = 12, 16
ALWAYS = {"entropy_start": 0, "entropy_stop": 10**6, "entropy_every": 1}


def scene(opacity: torch.Tensor | None = None):
    generator = torch.Generator().manual_seed(5)
    means = torch.rand(COUNT, 3, generator=generator, dtype=torch.float64) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    quats = torch.randn(COUNT, 4, generator=generator, dtype=torch.float64)
    scales = 0.1 + 0.2 * torch.rand(COUNT, 3, generator=generator, dtype=torch.float64)
    opacities = 0.2 + 0.7 * torch.rand(COUNT, generator=generator, dtype=torch.float64) if opacity is None else opacity
    K = torch.tensor([[16.0, 0, SIDE / 2], [0, 16.0, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    return means, quats, scales, opacities, K


def drawn(features, opacity=None, signs=None, dtype=torch.float64, backend="reference"):
    means, quats, scales, opacities, K = (tensor.to(dtype) for tensor in scene(opacity))
    eye = torch.eye(4, dtype=dtype)
    return rasterization(
        means,
        quats,
        scales,
        opacities,
        features.to(dtype),
        eye,
        K,
        SIDE,
        SIDE,
        backend=backend,
        depth=False,
        signs=signs,
    )


def brute_force(opacity=None) -> torch.Tensor:
    """Mean over pixels of 1 - Σ w² - T², from the weights of every Gaussian in every pixel."""
    output = drawn(torch.eye(COUNT, dtype=torch.float64), opacity)
    left = 1 - output.alpha[0]
    return (1 - output.features.square().sum(-1) - left.square()).mean()


def test_the_entropy_is_that_of_brute_force_in_the_mean_over_signs_and_so_is_its_gradient():
    rule = ShortLists(entropy=1.0, **ALWAYS)
    opacity = scene()[3].requires_grad_()
    brute_force(opacity).backward()
    expected, slope = float(brute_force()), opacity.grad.clone()
    found, slopes = 0.0, torch.zeros(COUNT, dtype=torch.float64)
    every = 2 ** (COUNT - 1)  # all pairs of signs: one half of them is the other turned around
    for code in range(0, every, 7):
        signs = torch.tensor([1.0] + [2.0 * ((code >> bit) & 1) - 1 for bit in range(COUNT - 1)])
        opacity = scene()[3].requires_grad_()
        value = rule.entropy(drawn(torch.zeros(COUNT, 1), opacity, signs))
        value.backward()
        found, slopes = found + value.item(), slopes + opacity.grad
    draws = len(range(0, every, 7))
    assert found / draws == pytest.approx(expected, rel=0.02)
    torch.testing.assert_close(slopes / draws, slope, rtol=0.15, atol=0.02 * slope.abs().max().item())


def test_signs_are_an_image_beside_the_features_on_the_fast_renderer_too():
    signs = ShortLists(**ALWAYS).signs_at(3, COUNT, seed=0)
    features = torch.rand(COUNT, 2, generator=torch.Generator().manual_seed(1))
    plain = drawn(features, dtype=torch.float32, backend="cpu")
    output = drawn(features, signs=signs, dtype=torch.float32, backend="cpu")
    assert plain.signed is None and torch.equal(plain.features, output.features)
    expected = drawn(signs[:, None].double()).features[..., 0]
    torch.testing.assert_close(output.signed.double(), expected, rtol=1e-4, atol=1e-5)


def test_signs_are_even_repeatable_and_new_at_every_step():
    rule = ShortLists(entropy_start=10, entropy_stop=20, entropy_every=3)
    signs = rule.signs_at(12, 10_000, seed=1)
    assert set(signs.tolist()) == {-1.0, 1.0} and abs(signs.mean()) < 0.05
    assert torch.equal(signs, rule.signs_at(12, 10_000, seed=1))
    assert not torch.equal(signs, rule.signs_at(15, 10_000, seed=1))
    asked = [step for step in range(30) if rule.signs_at(step, 4, seed=0) is not None]
    assert asked == [12, 15, 18]
    assert ShortLists(entropy=0.0).signs_at(9000, 4, seed=0) is None and Overlap().signs_at(9000, 4, seed=0) is None


def test_a_reset_shrinks_all_and_forgets_all_moments():
    splats = Splats(
        {"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "quats": torch.ones(2, 4),
         "opacity_logits": torch.zeros(2, 1)}
    )  # fmt: skip
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names], lr=0.0)
    sum(splats[name].sum() for name in splats.names).backward()
    rule = ShortLists(reset_factor=0.2, reset_every=10, reset_start=20, reset_stop=45)
    cloud, sizes = Cloud(splats, optimizer, {}), []
    for step in range(60):
        optimizer.step()
        rule.shrink(cloud, step)
        sizes.append(splats.scales.max().item())
        if step + 1 in (20, 30, 40):
            assert not optimizer.state
    assert sizes[18:20] == pytest.approx([1.0, 0.2]) and sizes[38:40] == pytest.approx([0.04, 0.008])
    assert sizes[-1] == pytest.approx(0.008)
    settled = [rule.settled(step) for step in range(60)]
    assert [step for step in range(60) if not settled[step]] == [*range(19, 24), *range(29, 34), *range(39, 44)]


@pytest.mark.parametrize(
    ("moved", "resets"), [({}, [20, 30, 40]), ({12: 36}, [16, 21, 26]), ({12: 36, 20: 65, 30: 45}, [16, 23, 33])]
)
def test_resets_and_entropy_follow_an_end_that_moves(moved, resets):
    schedule = Schedule(60)
    rule = ShortLists(reset_every=10, reset_start=20, reset_stop=45, entropy_start=30, entropy_stop=50, entropy_every=1)
    rule.planned = schedule.planned
    splats = Splats({name: torch.zeros(2, 3) for name in GEOMETRY})
    found, asked, step = [], [], 0
    while step < schedule.end:
        if rule.signs_at(step, 2, seed=0) is not None:
            asked.append(schedule.progress(step))
        splats["log_scales"].grad = torch.zeros(2, 3)
        if rule.shrink(Cloud(splats, None, {}), step):
            found.append(step + 1)
            assert not rule.settled(step)
        step += 1
        if step in moved:
            schedule.end_at(step, moved[step])
    assert found == resets and rule.settled(step - 1)
    assert min(asked) == pytest.approx(0.5, abs=0.05) and max(asked) == pytest.approx(49 / 60, abs=0.05)


def test_sizes_that_a_stage_holds_still_are_not_reset():
    splats = Splats(
        {"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "quats": torch.ones(2, 4),
         "opacity_logits": torch.zeros(2, 1)}
    )  # fmt: skip
    ShortLists(reset_every=10, reset_start=0, reset_stop=45).shrink(Cloud(splats, None, {}), 19)
    assert not splats["log_scales"].any()


def test_options_out_of_range_are_refused():
    with pytest.raises(ValueError, match="reset_factor lies in"):
        ShortLists(reset_factor=0.0)
