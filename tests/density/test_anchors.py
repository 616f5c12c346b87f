"""Where anchors come and which go, on a few of them whose statistics are known."""

from types import SimpleNamespace

import pytest
import torch

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, RenderOutput, SceneError
from heatsplat.density.anchors import Anchors
from heatsplat.density.ops import Cloud
from heatsplat.splats import Splats

CAMERA = Camera(torch.eye(4), torch.eye(3), 20, 10)


def make(*places, **options):
    """Anchors with two Gaussians each, as large as 1, and the rule with voxels of 1 whose coarsest cubes have 16."""
    means = torch.tensor(places)
    n = len(means)
    tensors = {
        "means": means, "log_scales": torch.zeros(n, 3), "quats": torch.ones(n, 4), "opacity_logits": torch.zeros(n, 1),
        "feature": torch.arange(2.0 * n).view(n, 2), "offsets": torch.zeros(n, 2, 3), "log_reach": torch.zeros(n, 3),
    }  # fmt: skip
    rule = Anchors(
        **{"start": 0, "grow_from": 0, "every": 10, "stop": 100, "voxel": 1.0, "grad_threshold": 1.0} | options
    )
    rule.size = rule.voxel
    state = rule.initial_state(n, torch.device("cpu"))
    state |= {"gradient": torch.zeros(n, 2), "shown": torch.full((n, 2), 10.0)}
    return rule, Cloud(Splats(tensors), None, state)


@pytest.mark.parametrize("init", ["sfm", "random"])
def test_voxels_are_those_of_the_initialisation_and_else_as_far_apart_as_points(init):
    assert compose(["method=scaffold_gs", "init.voxel=0.5"])["density"]["voxel"] == 0.5
    rule = build(compose(["method=scaffold_gs", f"init={init}"])["density"])
    rule.prepare(SimpleNamespace(points=torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]]), name="row"), "thermal")
    assert rule.size == 2.0


def refined(rule, cloud, seed=0):
    return rule.refine(cloud, 9, 1.0, torch.Generator().manual_seed(seed))


def test_a_view_adds_gradients_in_ndc_and_opacities_of_anchors_in_view():
    rule, cloud = make([0.0, 0, 0], [9.0, 0, 0])
    means2d = torch.zeros(4, 2, requires_grad=True)
    means2d.grad = torch.tensor([[0.3, 0.8], [9.0, 9.0], [0.0, 0.2], [0.0, 0.0]])
    told = {"means2d": means2d, "visible_ids": torch.tensor([0, 2]), "rows_in_view": torch.tensor([True, False])}
    told["opacities"] = torch.tensor([[0.25, 0.5, 0.0, 0.0]])
    state = rule.initial_state(2, torch.device("cpu"))
    for _ in range(2):
        rule.observe(state, RenderOutput(torch.zeros(1), torch.zeros(1), None, told), CAMERA, 3)
    assert torch.allclose(state["gradient"], 2 * torch.tensor([[5.0, 0.0], [1.0, 0.0]]))  # (3, 4) and (0, 1)
    assert state["shown"].tolist() == [[2, 0], [2, 0]]
    assert state["views"].tolist() == [2, 0] and state["opacity"].tolist() == [1.5, 0]


def test_gaussians_that_pull_get_anchors_in_free_cubes_of_the_levels_that_hear_them():
    rule, cloud = make([0.0, 0, 0], [33.0, 0, 0])
    with torch.no_grad():
        cloud.splats["offsets"][:, 0, 0] = 6.0  # at 6 and 39
        cloud.splats["offsets"][0, 1, 0] = 13.0
    cloud.state["gradient"][:] = torch.tensor([[30.0, 15.0], [0.0, 0.0]])  # means 3 and 1.5; thresholds are 1, 2, 4
    found = set()
    for seed in range(20):
        rule_, cloud_ = (
            rule,
            Cloud(Splats({k: v.detach() for k, v in cloud.splats.raw.items()}), None, dict(cloud.state)),
        )
        cloud_.state = {name: value.clone() for name, value in cloud.state.items()}
        change = refined(rule_, cloud_, seed)
        new = {tuple(row) for row in cloud_.splats.means[2:].detach().tolist()}
        assert change.added == len(new)
        found |= new
        sizes = cloud_.splats["log_scales"][2:].exp()[:, 0]
        for place, size, feature in zip(cloud_.splats.means[2:], sizes, cloud_.splats["feature"][2:], strict=True):
            assert size.item() == pytest.approx(16.0 if place[0] == 16 else 4.0) and feature.tolist() == [0.0, 1.0]
        assert not cloud_.splats["offsets"][2:].any() and torch.equal(cloud_.splats["log_reach"][2:, 0], sizes.log())
    # 6 lies in the coarse cube of the old anchor; in a cube of 4 voxels about 8 (6 / 4 = 1.5 rounds to 2). 13 lies in the
    # coarse cube about 16, and asks for no finer one.
    assert found == {(8.0, 0.0, 0.0), (16.0, 0.0, 0.0)}


def test_no_more_than_the_cap_and_the_strongest_first():
    places = [[50.0 * i, 0, 0] for i in range(4)]
    rule, cloud = make(*places, cap_max=5, levels=1)
    with torch.no_grad():
        cloud.splats["offsets"][:, :, 0] = 20.0
    cloud.state["gradient"][:] = 10 * torch.tensor([2.0, 3.0, 9.0, 4.0])[:, None]
    for seed in range(6):
        state = {name: value.clone() for name, value in cloud.state.items()}
        small = Cloud(Splats({k: v.detach() for k, v in cloud.splats.raw.items()}), None, state)
        drawn = torch.rand(4, 2, generator=torch.Generator().manual_seed(seed)) > 0.5
        refined(rule, small, seed)
        heard = drawn.any(1).tolist()
        strongest = next((i for i in (2, 3, 1, 0) if heard[i]), None)
        expected = [] if strongest is None else [round((50.0 * strongest + 20) / 16) * 16.0]
        assert small.splats.means[4:, 0].tolist() == expected


def test_anchors_leave_that_were_seen_and_are_transparent():
    rule, cloud = make([0.0, 0, 0], [50.0, 0, 0], [99.0, 0, 0])
    cloud.state["views"][:] = torch.tensor([9.0, 9.0, 5.0])  # 8 of 10 steps are enough to tell
    cloud.state["opacity"][:] = torch.tensor([0.04, 0.05, 0.0])  # 0.005 a view is enough to stay
    change = refined(rule, cloud)
    assert change.removed == 1 and cloud.splats.means[:, 0].tolist() == [50.0, 99.0]
    assert cloud.state["views"].tolist() == [0.0, 5.0]
    assert (
        rule.refine(cloud, 10, 1.0, torch.Generator()) is None
        and rule.refine(cloud, 109, 1.0, torch.Generator()) is None
    )


def test_a_scene_without_any_anchor_left_and_wrong_options_are_refused():
    rule, cloud = make([0.0, 0, 0])
    cloud.state["views"][:] = 9.0
    with pytest.raises(SceneError, match="would prune all 1 anchors at step 9"):
        refined(rule, cloud)
    with pytest.raises(ValueError, match="finer at least 2"):
        Anchors(finer=1)
    for name in ("start", "grow_from", "stop", "seen", "grad_threshold", "prune_opacity"):
        with pytest.raises(ValueError, match=f"density.*{name}.* must not be negative, got .*-0.5"):
            Anchors(**{name: -0.5})
