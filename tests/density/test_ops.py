"""Surgery on Gaussians keeps parameters, Adam moments and statistics in step."""

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.splats import Splats


def make_cloud(count: int = 6) -> Cloud:
    generator = torch.Generator().manual_seed(3)
    shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (2,), "heat": (5,)}
    splats = Splats({name: torch.randn(count, *shape, generator=generator) for name, shape in shapes.items()})
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names], lr=0.1)
    sum(splats[name].square().sum() for name in splats.names).backward()
    optimizer.step()
    return Cloud(splats, optimizer, {"seen": torch.arange(count, dtype=torch.float32)})


def moments(cloud: Cloud, name: str) -> torch.Tensor:
    return cloud.optimizer.state[cloud.splats[name]]["exp_avg"]


def test_keep_takes_the_same_rows_everywhere():
    cloud = make_cloud()
    before = {name: cloud.splats[name].detach().clone() for name in cloud.splats.names}
    before_moments = {name: moments(cloud, name).clone() for name in cloud.splats.names}
    mask = torch.tensor([True, False, True, True, False, False])
    cloud.keep(mask)
    assert len(cloud) == 3
    for name in cloud.splats.names:
        assert torch.equal(cloud.splats[name], before[name][mask])
        assert torch.equal(moments(cloud, name), before_moments[name][mask])
    assert torch.equal(cloud.state["seen"], torch.tensor([0.0, 2.0, 3.0]))


@pytest.mark.parametrize("mask", [torch.tensor([0, 2, 3]), torch.ones(5, dtype=torch.bool)])
def test_keep_refuses_what_is_no_mask_of_its_gaussians(mask):
    cloud = make_cloud()
    with pytest.raises(ValueError, match=r"cloud.keep takes a mask \[6\] bool of the Gaussians that stay, got torch\."):
        cloud.keep(mask)
    assert len(cloud) == 6


def test_prune_tells_how_many_went_and_refuses_to_remove_all():
    cloud = make_cloud()
    assert cloud.prune(torch.tensor([True, False, True, True, False, True]), "none is left") == 2
    assert len(cloud) == 4 and cloud.state["seen"].tolist() == [0.0, 2.0, 3.0, 5.0]
    kept = cloud.splats["means"]
    assert cloud.prune(torch.ones(4, dtype=torch.bool), "none is left") == 0 and cloud.splats["means"] is kept
    with pytest.raises(SceneError, match="none is left"):
        cloud.prune(torch.zeros(4, dtype=torch.bool), "none is left")
    assert len(cloud) == 4


def test_append_starts_moments_and_statistics_at_zero():
    cloud = make_cloud()
    rows = cloud.rows(torch.tensor([1, 4]))
    rows["heat"] += 1
    expected = torch.cat([cloud.splats["heat"].detach(), rows["heat"]])
    cloud.append(rows)
    assert len(cloud) == 8
    assert torch.equal(cloud.splats["heat"], expected)
    assert (moments(cloud, "heat")[6:] == 0).all() and (moments(cloud, "heat")[:6] != 0).all()
    assert torch.equal(cloud.state["seen"][6:], torch.zeros(2))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"heat": None}, "adds Gaussians without heat: begin with cloud.rows"),
        ({"quats": torch.ones(1, 3)}, r"adds 'quats' \[1, 3\], \[1, 4\] is needed"),
        ({"heat": torch.full((1, 5), float("nan"))}, "adds Gaussians whose 'heat' is NaN"),
    ],
)
def test_append_refuses_rows_that_are_none(changed, told):
    cloud = make_cloud()
    rows = {name: tensor for name, tensor in (cloud.rows(torch.tensor([2])) | changed).items() if tensor is not None}
    with pytest.raises(ValueError, match=told):
        cloud.append(rows)
    assert len(cloud) == 6


def test_tensors_that_are_not_there_are_named_with_those_that_are():
    with pytest.raises(
        KeyError, match="splats have no tensor 'level', only heat, log_scales, means, opacity_logits, quats"
    ):
        make_cloud().splats["level"]


def test_overwrite_forgets_moments_of_that_tensor_only():
    cloud = make_cloud()
    cloud.overwrite("opacity_logits", torch.full((6, 2), -2.0))
    assert (cloud.splats["opacity_logits"] == -2).all()
    assert (moments(cloud, "opacity_logits") == 0).all()
    assert (moments(cloud, "means") != 0).all()


def test_a_gradient_that_waits_for_more_views_follows_its_gaussians():
    cloud = make_cloud()
    before = {name: cloud.splats[name].grad.clone() for name in cloud.splats.names}
    mask = torch.tensor([True, False, True, True, False, True])
    cloud.keep(mask)
    cloud.append(cloud.rows(torch.tensor([1])))
    for name in cloud.splats.names:
        found = cloud.splats[name].grad
        assert torch.equal(found[:4], before[name][mask]) and (found[4] == 0).all()
    cloud.split(torch.tensor([2]), LongAxisSplit())
    found = cloud.splats["heat"].grad
    assert torch.equal(found[:2], before["heat"][[0, 2]]) and (found[[2, 4, 5]] == 0).all()
    assert torch.equal(found[3], before["heat"][5])
    cloud.overwrite("opacity_logits", torch.full((6, 2), -2.0))
    assert (cloud.splats["opacity_logits"].grad == 0).all()


def test_training_goes_on_after_surgery():
    cloud = make_cloud()
    cloud.keep(torch.arange(6) < 4)
    cloud.append(cloud.rows(torch.tensor([0])))
    before = cloud.splats["means"].detach().clone()
    cloud.optimizer.zero_grad()
    cloud.splats["means"].square().sum().backward()
    cloud.optimizer.step()
    assert (cloud.splats["means"] != before).all()


def test_splats_name_what_is_missing_or_uneven():
    with pytest.raises(ValueError, match="missing: opacity_logits"):
        Splats({"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "quats": torch.zeros(2, 4)})
    with pytest.raises(ValueError, match="one row per Gaussian"):
        Splats({"means": torch.zeros(2, 3), "log_scales": torch.zeros(3, 3), "quats": torch.zeros(2, 4),
                "opacity_logits": torch.zeros(2, 1)})  # fmt: skip
