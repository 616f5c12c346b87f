"""The standard strategy: who grows, who goes, when, and never beyond the cap."""

import json

import pytest
import torch

from heatsplat.contracts import Camera, RenderOutput, SceneError
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.budget import Budget
from heatsplat.density.co_support import CoSupport
from heatsplat.density.fixed import Fixed
from heatsplat.density.multiview_gate import MultiviewGate
from heatsplat.density.ops import Cloud
from heatsplat.splats import Splats


def make_cloud(policy: Adaptive, scales: list[float], opacities: list[float]) -> Cloud:
    count = len(scales)
    splats = Splats(
        {
            "means": torch.arange(count * 3, dtype=torch.float32).reshape(count, 3),
            "log_scales": torch.tensor(scales).log()[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            "opacity_logits": torch.logit(torch.tensor(opacities))[:, None],
        }
    )
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names])
    splats["opacity_logits"].grad = torch.zeros(count, 1)  # it is trained
    policy.initial_count = count
    return Cloud(splats, optimizer, policy.initial_state(count, torch.device("cpu")))


def pull(cloud: Cloud, strength: list[float]) -> None:
    cloud.state["gradient"] = torch.tensor(strength)
    cloud.state["seen"] = torch.ones(len(strength))


def refine(policy: Adaptive, cloud: Cloud, step: int):
    return policy.refine(cloud, step, extent=1.0, generator=torch.Generator().manual_seed(0))


def test_small_are_duplicated_large_are_split():
    policy = Adaptive(start=0, stop=100, every=10)
    cloud = make_cloud(policy, [0.005, 0.05, 0.05], [0.5, 0.5, 0.5])
    pull(cloud, [1e-3, 1e-3, 1e-5])
    change = refine(policy, cloud, 9)
    assert (change.added, change.removed, len(cloud)) == (2, 0, 5)
    scales = cloud.splats.scales[:, 0].tolist()
    assert scales.count(pytest.approx(0.005)) == 2  # the duplicate and its origin
    assert scales.count(pytest.approx(0.05 / 1.6)) == 2  # two halves, their parent gone
    assert scales.count(pytest.approx(0.05)) == 1  # the one that did not pull


def test_transparent_are_pruned_and_too_large_after_the_first_reset():
    policy = Adaptive(start=0, stop=1000, every=10, reset_every=100)
    cloud = make_cloud(policy, [0.01, 0.01, 0.5], [0.5, 0.001, 0.5])
    assert refine(policy, cloud, 9).removed == 1
    assert len(cloud) == 2
    assert refine(policy, cloud, 109).removed == 1
    assert len(cloud) == 1


@pytest.mark.parametrize("limit", [{"cap_max": 5}, {"multiple": 1.25}, {"cap_max": 5, "multiple": 3}])
def test_the_cap_holds_and_the_strongest_grow_first(limit):
    policy = Adaptive(start=0, stop=100, every=10, **limit)
    cloud = make_cloud(policy, [0.001] * 4, [0.5] * 4)
    pull(cloud, [1e-3, 5e-3, 2e-3, 3e-3])
    refine(policy, cloud, 9)
    assert len(cloud) == 5
    assert torch.equal(cloud.splats["means"][4], cloud.splats["means"][1])


def test_what_pulls_is_the_mean_over_the_views_that_saw_it():
    policy = Adaptive(start=0, stop=100, every=10, grad_threshold=2e-4)
    cloud = make_cloud(policy, [0.001] * 3, [0.5] * 3)
    pull(cloud, [3e-4, 3e-4, 0.0])
    cloud.state["seen"] = torch.tensor([1.0, 2.0, 0.0])
    assert refine(policy, cloud, 9).added == 1
    assert torch.equal(cloud.splats["means"][3], cloud.splats["means"][0])


def test_opacity_reset_happens_on_time_and_not_after_stop():
    policy = Adaptive(start=0, stop=250, every=1000, reset_every=100)
    cloud = make_cloud(policy, [0.01] * 2, [0.9, 0.005])
    assert refine(policy, cloud, 98) is None
    assert refine(policy, cloud, 99).opacity_reset
    assert cloud.splats.opacities[0].tolist() == pytest.approx([0.01, 0.005], rel=1e-4)
    assert refine(policy, cloud, 299) is None


def test_opacities_that_a_stage_holds_still_are_not_reset_nor_where_it_begins_before_they_are_back():
    policy = Adaptive(start=0, stop=250, every=5, reset_every=100)
    cloud = make_cloud(policy, [0.01] * 2, [0.9, 0.9])
    cloud.splats["opacity_logits"].grad = None
    assert not refine(policy, cloud, 99).opacity_reset and cloud.splats.opacities.min() > 0.89
    cloud.splats["opacity_logits"].grad = torch.zeros(2, 1)
    for until, reset in ((249, False), (250, True)):  # ten refinements take 50 steps
        policy.opacities_until = until
        assert refine(policy, cloud, 199).opacity_reset == reset
        assert policy.settled(199) != reset and not policy.settled(149 - 1)
    assert cloud.splats.opacities.max() < 0.011


def test_large_gaussians_stay_where_no_reset_comes():
    policy = Adaptive(start=0, stop=1000, every=10, reset_every=100)
    policy.opacities_until = 150
    cloud = make_cloud(policy, [0.01, 0.5], [0.5, 0.5])
    assert refine(policy, cloud, 109).removed == 0


def test_opacities_settle_ten_refinements_after_a_reset():
    policy = Adaptive(start=0, stop=250, every=5, reset_every=100)
    settled = [step + 1 for step in range(400) if not policy.settled(step)]
    assert settled == [*range(100, 150), *range(200, 250)]
    assert Adaptive(reset_every=None).settled(2999) and Fixed().settled(2999)


def test_without_resets_opacities_and_large_gaussians_stay():
    policy = Adaptive(start=0, stop=1000, every=10, reset_every=None)
    cloud = make_cloud(policy, [0.01, 5.0], [0.9, 0.9])
    for step in range(9, 999, 10):
        refine(policy, cloud, step)
    assert len(cloud) == 2 and cloud.splats.opacities[0].tolist() == pytest.approx([0.9, 0.9])
    with pytest.raises(ValueError, match="reset_every and cap_max must be at least 1"):
        Adaptive(reset_every=0)
    for multiple in (0, float("inf")):
        with pytest.raises(ValueError, match="density.multiple must be above 0 and finite"):
            Adaptive(multiple=multiple)


@pytest.mark.parametrize("wrong", [0, 1, -1])
def test_opacities_are_not_reset_to_none_or_all(wrong):
    """Either has no finite logit."""
    with pytest.raises(ValueError, match=rf"density.reset_opacity must lie in \(0, 1\), got {wrong}"):
        Adaptive(reset_opacity=wrong)


@pytest.mark.parametrize("name", ["start", "stop", "grad_threshold", "duplicate_scale", "prune_opacity", "prune_scale"])
def test_steps_and_thresholds_below_zero_are_refused(name):
    with pytest.raises(ValueError, match=f"density.*{name}.* must not be negative, got .*-0.5"):
        Adaptive(**{name: -0.5})


def test_nothing_before_start_between_refinements_or_after_stop():
    policy = Adaptive(start=50, stop=100, every=10)
    cloud = make_cloud(policy, [0.001] * 3, [0.5] * 3)
    for step in (9, 55, 109):
        pull(cloud, [1.0, 1.0, 1.0])
        assert refine(policy, cloud, step) is None
    assert refine(policy, cloud, 59).added == 3


def test_an_empty_cloud_is_an_error_that_says_why():
    policy = Adaptive(start=0, stop=100, every=10)
    cloud = make_cloud(policy, [0.01] * 2, [0.001] * 2)
    with pytest.raises(SceneError, match="prune all 2 Gaussians at step 9"):
        refine(policy, cloud, 9)
    assert len(cloud) == 2


@pytest.mark.parametrize("kind", [Adaptive, CoSupport])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # of splats that the reference renders
def test_statistics_are_mean_norms_in_normalised_device_coordinates(kind, dtype):
    policy = kind()
    state = policy.initial_state(3, torch.device("cpu"))
    means2d = torch.zeros(3, 2, dtype=dtype, requires_grad=True)
    means2d.grad = torch.tensor([[3.0, 0.0], [0.0, 2.0], [9.0, 9.0]], dtype=dtype)
    output = RenderOutput(
        torch.zeros(2, 2, 1), torch.zeros(1, 2, 2), None, {"means2d": means2d, "visible_ids": torch.tensor([0, 1])}
    )
    camera = Camera(torch.eye(4), torch.eye(3), width=20, height=10)
    policy.observe(state, output, camera, step=0)
    assert state["gradient"].tolist() == [30.0, 10.0, 0.0]
    assert state["seen"].tolist() == [1.0, 1.0, 0.0]


def test_fixed_keeps_no_statistic_and_changes_nothing():
    policy = Fixed()
    assert policy.initial_state(4, torch.device("cpu")) == {}
    cloud = make_cloud(Adaptive(), [0.01] * 2, [0.001] * 2)
    assert policy.refine(cloud, 99, 1.0, torch.Generator()) is None
    assert len(cloud) == 2


@pytest.mark.parametrize(
    ("moves", "resets"),
    [
        ({}, [1000, 2000, 3000]),
        ({1010: 1.2}, [1000, 2198, 3398]),  # not at 1200, shortly after the first
        ({1900: 0.5}, [1000, 1950, 2450, 2950, 3450]),
        ({500: 0.5, 700: 1.3}, [765, 1415, 2065, 2715, 3365]),
    ],
)
def test_resets_of_a_plan_that_is_moved_keep_their_place_in_it(moves, resets):
    density, found = Adaptive(stop=10_000, reset_every=1000), []
    for step in range(3500):
        if step in moves:
            density.retime(step, moves[step])
        if 0 < step + 1 == density._last_reset(step):
            found.append(step + 1)
            assert not density.settled(step)
    assert found == resets
    again = Adaptive(stop=10_000, reset_every=1000)
    again.load_times(json.loads(json.dumps(density.times())))
    assert [again._last_reset(step) for step in range(3500)] == [density._last_reset(step) for step in range(3500)]


@pytest.mark.parametrize(
    ("moves", "events"),
    [
        ({}, [600, 700, 800, 900, 1000, 1100, 1200, 1300]),
        ({1000: 1.12}, [600, 700, 800, 900, 1000, 1112, 1224, 1336]),  # not at 1008, with eight views
        ({1050: 0.5}, [600, 700, 800, 900, 1000, 1075, 1125, 1175]),
        ({650: 0.5, 710: 3.0}, [600, 675, 755, 905, 1055, 1205, 1355, 1505]),
    ],
)
@pytest.mark.parametrize("name", ["adaptive", "budget", "multiview_gate"])
def test_refinements_of_a_plan_that_is_moved_keep_their_place_in_it(name, moves, events):
    density, due = {
        "adaptive": (Adaptive(start=500, every=100, reset_every=None), lambda step: density._comes("every", step)),
        "budget": (Budget(start=500, every=100), lambda step: density._growth_in(step) == 0),
        "multiview_gate": (
            MultiviewGate(start=500, every=100, reset_every=None, views=5),
            lambda step: density._next(step) == step + 1,
        ),
    }[name]
    found = []
    for step in range(510, 2000):
        if step in moves:
            density.retime(step, moves[step])
        if due(step):
            found.append(step + 1)
    assert found[: len(events)] == events


def test_an_event_of_a_plan_that_is_moved_adds_as_much_as_the_one_it_stands_for():
    shares = []
    for factor in (1.0, 0.3, 2.5):
        density = Budget(start=500, stop=3000, every=100, curve="sqrt")
        density.retime(1290, factor)
        at = [step for step in range(1290, 9000) if density._growth_in(step) == 0]
        shares.append([round(density._share(step), 12) for step in at])
    assert len(shares[0]) == 18 and shares[0] == shares[1] == shares[2]


def test_the_rest_of_a_plan_is_moved_and_what_is_past_stays():
    density = Adaptive(start=100, stop=1000, every=100, reset_every=None)
    density.retime(200, 0.5)
    assert (density.start, density.stop, density.every, density.reset_every) == (100, 600, 50, None)
    density.retime(300, 1.01)  # of 600 and 50, not of what was rounded before
    density.retime(300, 1.01)
    assert density.stop == round(300 + 1.01**2 * 300) and density.every == 51
    again = Adaptive(start=100, stop=1000, every=100, reset_every=None)
    again.load_times(json.loads(json.dumps(density.times())))
    assert vars(again) == vars(density)
    removing = Budget(stop=800, remove_at=[100, 800])
    removing.retime(200, 0.5)
    assert removing.remove_at == (100, 500) and Adaptive().times() == {}
    gated = MultiviewGate(views=10, gate_views=2, every=40, late_every=40)
    gated.retime(0, 0.1)
    assert gated.every == gated.late_every == 20  # its views have to fit twice
