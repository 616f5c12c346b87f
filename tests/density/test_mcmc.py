"""3DGS-MCMC: Gaussians in one place act as one, numbers are exact, what is copied, where centres wander."""

import math

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.density.mcmc import MCMC, MOST, stacked
from heatsplat.density.ops import Cloud
from heatsplat.renderers.base import rasterization
from heatsplat.splats import Splats


@pytest.mark.parametrize("opacity", [0.006, 0.1, 0.5, 0.9, 0.995])
@pytest.mark.parametrize("count", [1, 2, 5, 51])
def test_stacked_gaussians_hide_in_their_centre_and_in_all_what_the_one_hid(opacity, count):
    each, factor = stacked(torch.tensor([opacity], dtype=torch.float64), torch.tensor([count]))
    assert 1 - (1 - each.item()) ** count == pytest.approx(opacity, rel=1e-12)
    x = torch.linspace(-40, 40, 400_001, dtype=torch.float64)  # in semi-axes of the one
    hidden = 1 - (1 - each * torch.exp(-0.5 * (x / factor).square())) ** count
    assert torch.trapezoid(hidden, x).item() == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-9)


def test_more_than_the_most_are_taken_for_the_most():
    opacities = torch.tensor([0.7], dtype=torch.float64)
    assert all(torch.equal(a, b) for a, b in zip(
        stacked(opacities, torch.tensor([200])), stacked(opacities, torch.tensor([MOST])), strict=True
    ))  # fmt: skip


def cloud_of(opacities: list[float], seed: int = 3) -> Cloud:
    """Gaussians with random shapes and heat, and an optimiser that has stepped once."""
    count, generator = len(opacities), torch.Generator().manual_seed(seed)
    splats = Splats(
        {
            "means": torch.randn(count, 3, generator=generator),
            "log_scales": torch.randn(count, 3, generator=generator) - 3,
            "quats": torch.randn(count, 4, generator=generator),
            "opacity_logits": torch.logit(torch.tensor(opacities, dtype=torch.float64)).float()[:, None],
            "heat": torch.arange(1.0, count + 1)[:, None].repeat(1, 5),
        }
    )
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name, "lr": 0.0} for name in splats.names])
    for name in splats.names:
        splats.raw[name].grad = torch.ones_like(splats[name])
    optimizer.step()
    return Cloud(splats, optimizer, {})


def policy(**options) -> MCMC:
    return MCMC(**{"start": 0, "stop": 100, "every": 10, "noise": 0.0} | options)


def teach(cloud: Cloud) -> None:
    """Gives centres a learning rate."""
    next(group for group in cloud.optimizer.param_groups if group["name"] == "means")["lr"] = 1e-3


def refine(rule: MCMC, cloud: Cloud, step: int = 9, seed: int = 0, extent: float = 1.0):
    return rule.refine(cloud, step, extent, torch.Generator().manual_seed(seed))


def test_the_dead_move_onto_the_living_with_their_heat_and_without_moments():
    cloud = cloud_of([0.9, 0.004, 0.001, 0.003])
    old = {name: cloud.splats[name].detach().clone() for name in cloud.splats.names}
    change = refine(policy(growth=0.0), cloud)
    assert (change.added, change.removed, len(cloud)) == (0, 0, 4)
    for name in ("means", "quats", "heat"):
        assert torch.equal(cloud.splats[name], old[name][:1].expand(4, -1))
    assert (1 - (1 - cloud.splats.opacities[0]).prod()).item() == pytest.approx(0.9, rel=1e-5)
    for name in cloud.splats.names:
        assert not cloud.optimizer.state[cloud.splats[name]]["exp_avg"].any()


def test_those_that_are_not_drawn_stay_as_they_are_with_their_moments():
    cloud = cloud_of([0.5] * 40 + [0.001])
    refine(policy(growth=0.0), cloud)
    moments = cloud.optimizer.state[cloud.splats["heat"]]["exp_avg"]
    assert len(cloud) == 41 and int((moments != 0).all(1).sum()) == 39  # one was drawn


def test_an_image_is_nearly_the_same_after_relocation():
    cloud = cloud_of([0.8, 0.6, 0.4] + [0.001] * 6)
    K, eye = torch.tensor([[60.0, 0, 32], [0, 60.0, 32], [0, 0, 1]]), torch.eye(4)
    eye[2, 3] = 4.0

    def image() -> torch.Tensor:
        splats = cloud.splats
        drawn = rasterization(
            *(tensor.double() for tensor in (splats.means, splats.quats, 3 * splats.scales, splats.opacities)),
            splats["heat"][:, :1].double(), eye, K, 64, 64, backend="reference", depth=False,
        )  # fmt: skip
        return drawn.features.detach()

    before = image()
    refine(policy(growth=0.0), cloud)
    after = image()
    assert len(cloud) == 9
    assert (after - before).abs().mean() < 0.1 * before.mean()
    assert after.sum().item() == pytest.approx(before.sum().item(), rel=0.1)


def test_the_number_grows_by_its_share_to_the_cap_and_never_beyond():
    cloud, rule, counts = cloud_of([0.5] * 97 + [0.001] * 3), policy(cap_max=130), []
    for step in range(9, 100, 10):
        refine(rule, cloud, step)
        counts.append(len(cloud))
    assert counts == [105, 110, 115, 120, 126, 130, 130, 130, 130, 130]
    assert refine(rule, cloud, 50) is None and refine(rule, cloud, 109) is None
    rule.cap_max = 50  # held by a budget: nothing is added, nothing alive is taken away
    refine(rule, cloud, 19)
    assert len(cloud) == 130


def test_an_endless_cap_is_refused():
    with pytest.raises(ValueError, match="density.cap_max, which must be finite: set cap_max"):
        policy(cap_max=float("inf"))


def test_places_are_drawn_in_proportion_to_opacity():
    drawn = torch.zeros(2)
    for seed in range(200):
        cloud = cloud_of([0.6, 0.2, 0.001])
        refine(policy(growth=0.0), cloud, seed=seed)
        drawn += torch.bincount(cloud.splats["heat"][:, 0].long() - 1, minlength=2)[:2] - 1
    assert drawn[0] / drawn.sum() == pytest.approx(0.75, abs=0.1)


def test_the_same_generator_draws_the_same():
    clouds = [cloud_of([0.5] * 20 + [0.001] * 5) for _ in range(3)]
    for cloud, seed in zip(clouds, (1, 1, 2), strict=True):
        refine(policy(), cloud, seed=seed)
    one, same, other = (cloud.splats["heat"] for cloud in clouds)
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_every_modality_is_taken_apart_by_itself():
    cloud = cloud_of([0.001, 0.001])
    cloud.overwrite("opacity_logits", torch.logit(torch.tensor([[0.9], [0.002]])))
    two = torch.logit(torch.tensor([[0.9, 0.3], [0.002, 0.001]]))
    splats = Splats({name: cloud.splats[name].detach() for name in cloud.splats.names} | {"opacity_logits": two})
    cloud = Cloud(splats, None, {})
    refine(policy(growth=0.0), cloud)
    hidden = 1 - (1 - cloud.splats.opacities).prod(dim=1)
    assert hidden.tolist() == pytest.approx([0.9, 0.3], rel=1e-5)


def test_centres_of_the_transparent_wander_along_their_axes():
    cloud = cloud_of([0.001, 0.9])
    teach(cloud)
    with torch.no_grad():
        cloud.splats["log_scales"][:] = torch.tensor([0.02, 1e-4, 1e-4]).log()
        cloud.splats["quats"][:] = torch.tensor([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])  # x becomes y
    before = cloud.splats["means"].detach().clone()
    rule = policy(noise=5e5, start=1000)
    refine(rule, cloud, seed=4, extent=2.0)
    moved = cloud.splats["means"].detach() - before
    draw = torch.randn((1, 3), generator=torch.Generator().manual_seed(4))[0]
    expected = 1e-3 * 5e5 / (1 + math.exp(100 * (0.001 - 0.005))) * (0.02 / 2.0) ** 2 * draw[1]
    assert moved[0, 1].item() == pytest.approx(expected.item(), rel=1e-3)
    assert moved[0, [0, 2]].abs().max() < 1e-3 * moved[0, 1].abs() and not moved[1].any()


def test_frozen_centres_do_not_wander():
    cloud = cloud_of([0.001, 0.9])
    teach(cloud)
    cloud.splats.means.grad = None
    before = cloud.splats["means"].detach().clone()
    refine(policy(noise=5e5), cloud, step=5)
    assert torch.equal(cloud.splats["means"], before)


def test_a_dead_cloud_is_an_error_that_says_why():
    with pytest.raises(SceneError, match="finds all 2 Gaussians dead at step 9"):
        refine(policy(), cloud_of([0.001, 0.002]))
    for name in ("start", "stop", "dead_opacity", "growth", "noise"):
        with pytest.raises(ValueError, match=f"{name}.* at least 0, got .*-0.5"):
            MCMC(**{name: -0.5})
