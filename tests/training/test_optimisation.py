"""The optimiser: rates, schedule, penalties inside it, and what makes a run repeatable.

It is torch's Adam with a step of its own on a CPU (tests/kernels/test_adam.py).
"""

import math

import pytest
import torch

from heatsplat import composition
from heatsplat.splats import Splats
from heatsplat.training.optimisation import Optimisation
from heatsplat.training.schedule import Schedule


def splats(count=1001):
    generator = torch.Generator().manual_seed(0)
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
    return Splats({name: torch.randn(count, width, generator=generator) for name, width in widths.items()})


def build(cloud, settings=None, extent=2.0):
    settings = settings or Optimisation()
    return settings.build(settings.geometry_groups(cloud, extent), Schedule(100).round_progress)


def steps(cloud, optimizer, scheduler, first, last):
    """Steps with gradients that depend on the step only."""
    for step in range(first, last):
        generator = torch.Generator().manual_seed(step)
        for parameter in cloud.raw.values():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        optimizer.step()
        scheduler.step()


def test_rates_are_those_of_3dgs_and_only_the_means_slow_down():
    cloud = splats(4)
    optimizer, scheduler = build(cloud)
    rates = {name: [] for name in cloud.names}
    for step in range(101):
        for group in optimizer.param_groups:
            rates[group["name"]].append(group["lr"])
        steps(cloud, optimizer, scheduler, step, step + 1)
    assert rates["means"][0] == pytest.approx(1.6e-4 * 2.0)
    assert rates["means"][50] == pytest.approx(1.6e-5 * 2.0)
    assert rates["means"][100] == pytest.approx(1.6e-6 * 2.0)
    assert set(rates["log_scales"]) == {5e-3}
    assert set(rates["quats"]) == {1e-3}
    assert set(rates["opacity_logits"]) == {5e-2}


def test_it_is_adam_with_the_small_eps_of_3dgs():
    optimizer, _ = build(splats())
    assert isinstance(optimizer, torch.optim.Adam)
    for group in optimizer.param_groups:
        assert group["fused"] and group["betas"] == (0.9, 0.999) and group["eps"] == 1e-15


def test_a_tiny_gradient_still_moves_its_parameter():
    """eps = 1e-15: gradients of a pixel's share are small, and Adam's usual 1e-8 would stop them."""
    cloud = splats(1)
    optimizer, _ = build(cloud)
    before = cloud["quats"].detach().clone()
    cloud.raw["quats"].grad = torch.full((1, 4), 1e-12)
    optimizer.step()
    assert torch.allclose(before - cloud["quats"], torch.full((1, 4), 1e-3), rtol=1e-2)


def test_weight_decay_is_the_gradient_of_the_penalty():
    """PerGaussian.l2 becomes weight_decay = 2 l2, instead of a loss term l2 * sum(x²) and its backward pass."""
    start, l2 = torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), 0.3
    inside, outside = (torch.nn.Parameter(start.clone()) for _ in range(2))
    one, _ = Optimisation().build(
        [{"params": [inside], "name": "x", "lr": 1e-2, "weight_decay": 2 * l2}], lambda step: 0.0
    )
    two, _ = Optimisation().build([{"params": [outside], "name": "x", "lr": 1e-2}], lambda step: 0.0)
    for _ in range(20):
        inside.grad = inside.detach().cos()
        one.step()
        two.zero_grad()
        (outside.sin().sum() + l2 * outside.square().sum()).backward()
        two.step()
    assert torch.allclose(inside, outside, atol=1e-6)
    assert (inside - start).abs().max() > 0.1


def test_the_number_of_threads_changes_no_bit():
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            cloud = splats(33_331)  # odd rows: shares of threads end inside vectors
            steps(cloud, *build(cloud), 0, 10)
            results.append([parameter.detach().clone() for parameter in cloud.raw.values()])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))


def test_a_resumed_optimiser_continues_bit_for_bit(tmp_path):
    whole = splats()
    steps(whole, *build(whole), 0, 20)

    first = splats()
    optimizer, scheduler = build(first)
    steps(first, optimizer, scheduler, 0, 9)
    state = {"splats": first.state_dict(), "optimizer": optimizer.state_dict(), "scheduler": scheduler.state_dict()}
    torch.save(state, tmp_path / "state.pt")

    second = splats()
    optimizer, scheduler = build(second)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    second.load_state_dict(state["splats"])
    optimizer.load_state_dict(state["optimizer"])
    scheduler.load_state_dict(state["scheduler"])
    steps(second, optimizer, scheduler, 9, 20)
    assert all(torch.equal(whole[name], second[name]) for name in whole.names)


@pytest.mark.parametrize(("decay", "end"), [(0.0, 1.0), (0.25, 0.01**0.25), (1.0, 0.01)])
def test_a_run_goes_through_a_share_of_the_decay(decay, end):
    cloud = splats(4)
    optimizer, scheduler = build(cloud, Optimisation(decay=decay))
    steps(cloud, optimizer, scheduler, 0, 100)
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert rates["means"] == pytest.approx(end * 1.6e-4 * 2.0)
    assert rates["quats"] == 1e-3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"decay": -1}, "optim.means_end, decay and length_power must not be negative, got 0.01, -1 and 0.0"),
        ({"means_end": -1}, "optim.means_end, decay and length_power must not be negative, got -1, 1.0 and 0.0"),
        (
            {"length_power": -0.5},
            "optim.means_end, decay and length_power must not be negative, got 0.01, 1.0 and -0.5",
        ),
        ({"accumulate": math.inf}, "optim.accumulate must be a number, got inf"),
        ({"eps": math.inf}, "optim.eps must be a number, got inf"),
        ({"decay": math.nan}, "optim.decay must be a number, got nan"),
        ({"betas": []}, r"optim.betas must be a list of 2 numbers, got \[\]"),
        ({"betas": [0.9, 1.0]}, r"optim.betas must lie in \[0, 1\)"),
        ({"eps": -1}, "optim.eps above 0, got .* and -1"),
        ({"decoupled": -1}, "optim.decoupled must be the settings of optim=adamw, or null, got -1"),
    ],
)
def test_settings_that_no_optimiser_has_are_refused_by_name(options, told):
    with pytest.raises(ValueError, match=told):
        Optimisation(**options)


def test_gradients_of_several_views_wait_for_one_update():
    settings = Optimisation(accumulate=4, accumulate_from=0.5)
    updates = [step for step in range(20) if settings.updates(step, step / 20)]
    assert updates == [*range(10), 11, 15, 19]
    assert all(Optimisation().updates(step, 0.99) for step in range(5))
    with pytest.raises(ValueError, match="at least 1"):
        Optimisation(accumulate=0)


@pytest.mark.parametrize(("steps", "views"), [(20, 1), (1000, 1), (1499, 1), (1500, 2), (30000, 2)])
def test_two_views_share_an_update_in_runs_that_are_not_short(steps, views):
    ours, papers = (composition.compose([f"max_steps={steps}", *recipe]) for recipe in ([], ["recipe=published"]))
    assert composition.build(ours["optim"]).accumulate == views
    assert composition.build(papers["optim"]).accumulate == 1


@pytest.mark.parametrize("length", [1500, 30000])
def test_centres_keep_a_tenth_of_their_rate_and_with_the_papers_settings_a_hundredth(length):
    for recipe, end in (([], 0.1), (["recipe=published"], 0.01)):
        settings = composition.build(composition.compose([f"max_steps={length}", *recipe])["optim"])
        cloud = splats(4)
        optimizer, scheduler = build(cloud, settings)
        means = optimizer.param_groups[0]
        first = means["lr"]
        steps(cloud, optimizer, scheduler, 0, 100)
        assert means["lr"] == pytest.approx(end * first)


def test_shorter_runs_learn_faster_as_a_power_of_their_length():
    cloud = splats(4)
    papers = {group["name"]: group["lr"] for group in Optimisation().geometry_groups(cloud, 2.0)}
    for steps, pace in ((100, 5.0), (1875, 4.0), (7500, 2.0), (30_000, 1.0), (60_000, 1.0)):
        settings = Optimisation(length_power=0.5, steps=steps)
        rates = {group["name"]: group["lr"] for group in settings.geometry_groups(cloud, 2.0)}
        expected = {name: lr * (1.0 if name == "opacity_logits" else pace) for name, lr in papers.items()}
        assert settings.pace == pytest.approx(pace) and rates == pytest.approx(expected)


def test_a_rate_that_is_held_falls_in_the_rest_of_a_short_run_and_from_the_start_on_in_one_as_long_as_the_papers():
    shares = [Optimisation(length_power=0.5, steps=steps).held(0.8) for steps in (1000, 7500, 30_000, 60_000)]
    assert shares == pytest.approx([0.8 * 0.96, 0.8 * 0.75, 0.0, 0.0])
    assert Optimisation(steps=1000).held(0.8) == 0.0  # rates of any length are the papers'
    weights = [torch.nn.Parameter(torch.zeros(2)) for _ in range(2)]
    groups = [
        {"params": [x], "name": str(held), "lr": 1.0, "lr_end": 0.01, "held": held}
        for x, held in zip(weights, (0.0, 0.6), strict=True)
    ]
    optimizer, scheduler = Optimisation().build(groups, Schedule(100).round_progress)
    rates = []
    for _ in range(101):
        rates.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        scheduler.step()
    falls, held = torch.tensor(rates, dtype=torch.float64).T
    torch.testing.assert_close(falls, 0.01 ** (torch.arange(101) / 100).double())
    assert (held[:61] == 1.0).all()
    torch.testing.assert_close(held[60:], 0.01 ** (torch.arange(41) / 40).double())
