"""Proximity: the graph, who is a source, where company comes, what it inherits, and every limit."""

import math

import pytest
import torch

from heatsplat.density.adaptive import Adaptive
from heatsplat.density.ops import Cloud
from heatsplat.density.proximity import Proximity
from heatsplat.splats import Splats

ROOT_PI = math.sqrt(math.pi)


def make_cloud(means, opacity=0.5, rest=False):
    means = torch.as_tensor(means, dtype=torch.float32)
    count = len(means)
    generator = torch.Generator().manual_seed(0)
    tensors = {
        "means": means,
        "log_scales": torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "opacity_logits": torch.full((count, 1), torch.logit(torch.tensor(opacity)).item()),
        "sh0": torch.randn(count, 1, 1, generator=generator),
    }
    if rest:
        tensors["sh_rest"] = torch.randn(count, 3, 1, generator=generator)
    splats = Splats(tensors)
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names])
    sum(splats[name].sum() for name in splats.names).backward()
    optimizer.step()  # so that there are moments to be carried
    return Cloud(splats, optimizer, Adaptive().initial_state(count, torch.device("cpu")))


def policy(**options):
    """Insertions every 10 steps, and of adaptive density control nothing unless asked for."""
    inserted = {"insert_stop": 1000, "insert_every": 10, "insert_growth": 1.0}
    return Proximity(**{"radiance": {"sh0": ROOT_PI, "sh_rest": 0.0}, "start": 0, "stop": 0, **inserted} | options)


def refine(control, cloud, step=9, extent=1.0):
    return control.refine(cloud, step, extent, torch.Generator().manual_seed(0))


def line(*positions):
    return [[x, 0.0, 0.0] for x in positions]


CLUSTER = line(0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 5.0)  # the last stands alone


def test_company_comes_halfway_along_the_edges_of_the_one_that_stands_alone():
    cloud = make_cloud(CLUSTER)
    before = cloud.rows(torch.arange(10))
    change = refine(policy(), cloud)
    assert (change.added, change.removed, len(cloud)) == (3, 0, 13)
    expected = before["means"][9] + 0.5 * (before["means"][[8, 7, 6]] - before["means"][9])
    assert torch.allclose(cloud.splats["means"][10:], expected, atol=1e-5)
    for name in ("log_scales", "quats", "opacity_logits"):
        assert torch.equal(cloud.splats[name][10:], before[name][[9, 9, 9]])
    for name in before:
        assert torch.equal(cloud.splats[name][:10], before[name])


def test_radiance_is_weaker_by_the_distance_to_the_source():
    cloud = make_cloud(CLUSTER, rest=True)
    refine(policy(attenuation=0.3), cloud, extent=2.0)
    distance = (cloud.splats["means"][10:] - cloud.splats["means"][9]).norm(dim=1)
    factor = torch.exp(-0.3 * distance / 2.0)
    radiance = 0.28209479177387814 * cloud.splats["sh0"][:, 0, 0] + 0.5
    assert torch.allclose(radiance[10:], factor * radiance[9], atol=1e-6)
    assert torch.allclose(cloud.splats["sh_rest"][10:, :, 0], factor[:, None] * cloud.splats["sh_rest"][9, :, 0])


def test_offsets_of_zero_scale_the_coefficients_as_printed():
    cloud = make_cloud(CLUSTER)
    refine(policy(attenuation=0.3, radiance={"sh0": 0.0}), cloud)
    distance = (cloud.splats["means"][10:] - cloud.splats["means"][9]).norm(dim=1)
    assert torch.allclose(cloud.splats["sh0"][10:, 0, 0], torch.exp(-0.3 * distance) * cloud.splats["sh0"][9, 0, 0])


def test_moments_and_statistics_of_the_new_start_at_zero():
    cloud = make_cloud(CLUSTER)
    cloud.state["gradient"] += 1.0
    refine(policy(), cloud)
    assert cloud.state["gradient"].tolist() == [1.0] * 10 + [0.0] * 3
    moments = cloud.optimizer.state[cloud.splats["means"]]["exp_avg"]
    assert moments[:10].abs().min() > 0 and moments[10:].abs().max() == 0


def test_a_fixed_distance_never_leaves_the_edge():
    near = make_cloud(CLUSTER)
    refine(policy(distance=0.1), near, extent=2.0)
    assert torch.allclose((near.splats["means"][10:] - near.splats["means"][9]).norm(dim=1), torch.full((3,), 0.2))
    far = make_cloud(CLUSTER)
    refine(policy(distance=100.0), far)
    assert torch.allclose(far.splats["means"][10:], far.splats["means"][[8, 7, 6]], atol=1e-5)


def test_an_absolute_threshold_counts_in_extents():
    lengths = (4.2 + 4.3 + 4.4) / 3
    assert refine(policy(threshold=lengths / 2 + 0.01), make_cloud(CLUSTER), extent=2.0) is None
    assert refine(policy(threshold=lengths / 2 - 0.01), make_cloud(CLUSTER), extent=2.0).added == 3


def test_an_edge_that_two_sources_share_is_used_once():
    cloud = make_cloud(line(0.0, 1.0))
    assert refine(policy(threshold=0.5), cloud).added == 1
    assert cloud.splats["means"][2].tolist() == pytest.approx([0.5, 0.0, 0.0], abs=2e-3)


def test_a_uniform_grid_gets_nothing():
    axis = torch.arange(4.0)
    corners = torch.cartesian_prod(axis, axis, axis)  # every point has three neighbours at distance one
    assert refine(policy(quantile=0.5), make_cloud(corners)) is None


@pytest.mark.parametrize("means", [line(0.0), line(1.0, 1.0, 1.0, 1.0), line(0.0, 1.0)])
def test_clouds_without_room_between_are_left_alone(means):
    cloud = make_cloud(means)
    with torch.no_grad():
        cloud.splats.means.copy_(torch.as_tensor(means))
    assert refine(policy(), cloud) is None
    assert len(cloud) == len(means)


def test_growth_and_cap_hold_and_the_loneliest_come_first():
    means = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    means[7] += 20.0
    grown = make_cloud(means)
    assert refine(policy(insert_growth=0.03, quantile=0.5), grown).added == 6
    assert torch.equal(grown.splats["quats"][200], grown.splats["quats"][7])
    capped = make_cloud(means)
    assert refine(policy(cap_max=202), capped).added == 2
    assert refine(policy(cap_max=202), capped) is None
    assert refine(policy(cap_max=100), capped) is None


def test_transparent_gaussians_are_no_sources():
    assert refine(policy(min_opacity=0.05), make_cloud(CLUSTER, opacity=0.04)) is None
    assert refine(policy(min_opacity=0.05), make_cloud(CLUSTER, opacity=0.06)).added == 3


def test_insertions_keep_to_their_schedule_and_see_what_came_before():
    control, cloud = policy(start=20, insert_stop=40), make_cloud(CLUSTER)
    assert [refine(control, cloud, step) is not None for step in (9, 19, 28)] == [False, False, False]
    assert refine(control, cloud, 29).added == 3
    assert refine(control, cloud, 39).added > 0  # the graph of the larger cloud
    assert refine(control, cloud, 49) is None


def test_duplicating_and_splitting_go_on():
    adaptive = {"start": 0, "stop": 100, "every": 10, "absgrad": True}
    control, cloud = policy(**adaptive), make_cloud(CLUSTER)
    assert control.absgrad_at(99) and not control.absgrad_at(100)  # nothing is added any more
    cloud.state["gradient"] += 1.0
    cloud.state["seen"] += 1.0
    alone = make_cloud(CLUSTER)
    alone.state["gradient"] += 1.0
    alone.state["seen"] += 1.0
    by_adaptive = refine(Adaptive(**adaptive), alone).added
    assert by_adaptive == 10
    assert refine(control, cloud).added > by_adaptive
    assert cloud.state["gradient"].abs().max() == 0 and len(cloud.state["gradient"]) == len(cloud)


def test_unknown_radiance_is_an_error_that_lists_what_there_is():
    with pytest.raises(
        ValueError, match="names heat, but the Gaussians have log_scales, means, .*sh0; name the tensors"
    ):
        refine(policy(radiance={"heat": 0.0}), make_cloud(CLUSTER))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"neighbours": 0}, "neighbours and insert_every must be at least 1, got 0"),
        ({"edge_share": 1.0}, r"edge_share in \(0, 1\), got 0.9, 1.0"),
        ({"radiance": {}}, "density.radiance names no tensor"),
        ({"attenuation": -0.1}, "attenuation, .* must not be negative, got -0.1"),
        ({"insert_growth": -0.1}, "insert_growth, .* must not be negative"),
        ({"threshold": -0.1}, "threshold and distance must not be negative"),
        ({"reset_opacity": 0.0}, "density.reset_opacity must lie in"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        policy(**options)
