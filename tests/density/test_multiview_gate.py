"""The gate: what several views show wrong may grow, what one shows or noise does not; late pruning; views that are asked."""

from types import SimpleNamespace

import pytest
import torch
from few_sorted import with_few_sorted

from heatsplat.contracts import Camera, SceneError
from heatsplat.density.multiview_gate import MultiviewGate
from heatsplat.density.ops import Cloud
from heatsplat.renderers.settings import Renderer
from heatsplat.splats import Splats

SIDE = 48
BEHIND = torch.tensor([0.5])
CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, SIDE / 2], [0, 40.0, SIDE / 2], [0, 0, 1]]), SIDE, SIDE)


def control(**options) -> MultiviewGate:
    policy = MultiviewGate(**{"start": 0, "stop": 100, "every": 20, "reset_every": None, "late_every": 20} | options)
    policy.noise = 1e-5  # more than what rounding leaves
    return policy


def wall(policy: MultiviewGate, side: int = 8) -> Cloud:
    """A wall of opaque Gaussians, in a grid that fills the image."""
    count = side * side
    grid = (torch.arange(side) + 0.5) * (2.4 / side) - 1.2
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    tensors = {
        "means": torch.stack([x.flatten(), y.flatten(), torch.full((count,), 2.0)], 1),
        "log_scales": torch.full((count, 3), 0.1).log(),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "opacity_logits": torch.full((count, 1), 3.0),
        "heat": torch.full((count, 1), 0.5),
    }
    return Cloud(Splats(tensors), None, policy.initial_state(count, torch.device("cpu")))


def look(policy: MultiviewGate, cloud: Cloud, target: torch.Tensor, step: int, pull: torch.Tensor | None = None):
    """One training step: the wall is seen, compared with ``target`` [H, W], and density control looks at it."""
    splats = cloud.splats
    maps = policy.maps_at(step)
    output = Renderer(backend="cpu")(
        splats.means, splats.quats, splats.scales, splats.opacities, lambda ids: splats["heat"][ids], CAMERA, BEHIND, (1,),
        absgrad=True, maps=maps,
    )  # fmt: skip
    error = (output.features[..., 0] - target).abs()
    loss = error.sum()
    if maps:
        loss = loss + (output.weighted.image * policy.pixel_maps(error.detach(), target[..., None], step)).sum()
    loss.backward()
    policy.observe(cloud.state, output, CAMERA, step)


def blob(where: tuple[int, int] = (12, 36)) -> torch.Tensor:
    """An even image with one hot spot of 5 x 5 pixels."""
    image = torch.full((SIDE, SIDE), 0.5)
    image[where[0] - 2 : where[0] + 3, where[1] - 2 : where[1] + 3] = 0.9
    return image


def passing(policy: MultiviewGate, images: list[torch.Tensor]) -> tuple[torch.Tensor, Cloud]:
    cloud = wall(policy)
    for step, image in enumerate(images, start=20 - len(images)):
        look(policy, cloud, image, step)
    return policy._passes(cloud.state), cloud


def test_a_blob_that_all_views_show_wrong_opens_the_gate_to_those_that_cover_it():
    passed, cloud = passing(control(gate_pixels=1.0), [blob()] * 10)
    assert 1 <= passed.sum() <= 6
    x, y = (CAMERA.project(cloud.splats.means.detach())[0][passed] - torch.tensor([36.5, 12.5])).abs().T
    assert (x < 8).all() and (y < 8).all()


def test_what_one_view_of_ten_shows_wrong_does_not_grow():
    flat = torch.full((SIDE, SIDE), 0.5)
    hot = torch.full((SIDE, SIDE), 0.5)
    hot[4:24, 20:44] = 0.9  # large enough that its mean over ten views passes
    passed, cloud = passing(control(), [flat] * 4 + [hot] + [flat] * 5)
    assert cloud.state["wrong"].max() > 20 and not passed.any()
    passed, _ = passing(control(gate_views=1), [flat] * 4 + [hot] + [flat] * 5)
    assert passed.any()


def test_pixels_that_do_not_count_neither_are_the_largest_errors_nor_hide_them():
    policy, step = control(), 19
    error, target = torch.full((SIDE, SIDE), 0.05), torch.full((SIDE, SIDE, 1), 0.5)
    error[0, :4] = 1.0  # of 4 x 16 pixels that count
    target[4:], error[4:] = torch.nan, 0.0
    target[:, 16:], error[:, 16:] = torch.nan, 0.0
    assert policy.pixel_maps(error, target, step)[..., 0].nonzero().tolist() == [[0, 0], [0, 1], [0, 2], [0, 3]]
    assert policy._mean_error == pytest.approx((4 * 1.0 + 60 * 0.05) / 64)
    assert not policy.pixel_maps(torch.zeros(SIDE, SIDE), torch.full((SIDE, SIDE, 1), torch.nan), step).any()


def test_of_a_large_image_the_largest_errors_are_found(monkeypatch):
    error = torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    target = torch.full((SIDE, SIDE, 1), 0.5)
    policy = control()
    policy.noise = 0.0
    known = policy.pixel_maps(error, target, 0)
    with_few_sorted(monkeypatch, 100)
    assert torch.equal(policy.pixel_maps(error, target, 0), known) and 0 < known.sum() < known.numel()


@pytest.mark.parametrize("floor, least, most", [(True, 0.0, 0.01), (False, 0.9, 1.0)])
def test_noise_is_not_wrong_but_would_be_without_the_floor(floor, least, most):
    policy = control()
    policy.noise = 0.01 if floor else 0.0
    generator = torch.Generator().manual_seed(1)
    noisy = [0.5 + 0.01 * torch.randn(SIDE, SIDE, generator=generator) for _ in range(10)]
    passed, _ = passing(policy, noisy)
    assert least <= passed.float().mean() <= most


def test_only_what_passes_grows_and_never_beyond_the_cap():
    for gate, cap, added in ((1.0, 1000, 2), (None, 1000, 7), (None, 66, 2)):
        policy = control(gate_pixels=gate, cap_max=cap, grad_quantile=0.9)
        cloud = wall(policy)
        cloud.state["seen"] += 1
        pulling = torch.arange(64.0)
        cloud.state["gradient"], cloud.state["absolute"] = pulling, pulling.clone()
        cloud.state["wrong"][[3, 60, 62]], cloud.state["blaming"][[3, 60, 62]] = 50.0, 5.0
        change = policy.refine(cloud, 19, 1.0, torch.Generator().manual_seed(0))
        assert (change.added, len(cloud)) == (added, 64 + added), (gate, cap)
        assert not any(statistic.any() for statistic in cloud.state.values())


def test_a_gaussian_is_asked_by_views_that_differ():
    policy = control(every=50, stop=500, late_every=50, late_stop=1000)
    policy.prepare(scene_of(23), "thermal")
    for event in range(50, 1001, 50):
        asked = [step for step in range(event - 50, event) if policy.maps_at(step)]
        assert len(asked) == 10 and len({step // 23 for step in asked}) == 1  # within one pass over all views


def test_nothing_is_asked_that_is_not_used():
    off = control(gate_pixels=None, late_blame=None, late_stop=200)
    assert not any(off.maps_at(step) for step in range(300))
    growing = control(late_blame=None, late_stop=200)
    assert any(growing.maps_at(step) for step in range(100)) and not any(
        growing.maps_at(step) for step in range(100, 300)
    )
    late = control(gate_pixels=None, late_stop=200)
    assert not any(late.maps_at(step) for step in range(100)) and sum(late.maps_at(s) for s in range(100, 300)) == 50


def test_late_pruning_takes_the_blamed_first_then_the_faintest_and_no_more_than_its_share():
    policy = control(late_share=0.05, late_stop=200)
    cloud = wall(policy)
    with torch.no_grad():
        cloud.splats["opacity_logits"][:10, 0] = torch.logit(torch.linspace(0.09, 0.01, 10))
    cloud.state["blame"][[40, 41]] = torch.tensor([10.0, 5.0])
    before = cloud.splats["means"].detach().clone()
    assert policy.refine(cloud, 118, 1.0, torch.Generator()) is None
    blame = cloud.state["blame"].clone()
    assert policy.refine(cloud, 119, 1.0, torch.Generator()).removed == 0  # a stage holds opacities still
    cloud.state["blame"] = blame
    cloud.splats["opacity_logits"].grad = torch.zeros(64, 1)
    assert policy.refine(cloud, 119, 1.0, torch.Generator()).removed == 3  # 5 % of 64
    left = torch.ones(64, dtype=torch.bool)
    left[[40, 9, 8]] = False
    assert torch.equal(cloud.splats["means"], before[left])
    assert policy.refine(cloud, 219, 1.0, torch.Generator()) is None  # after the last


def test_late_pruning_of_all_is_refused():
    policy = control(late_share=1.0, late_stop=200)
    cloud = wall(policy)
    cloud.splats["opacity_logits"].data.fill_(-5.0)
    cloud.splats["opacity_logits"].grad = torch.zeros(64, 1)
    with pytest.raises(SceneError, match=r"would remove all 64 Gaussians.*Lower density.late_share"):
        policy.refine(cloud, 119, 1.0, torch.Generator())


def scene_of(count: int):
    image = torch.full((8, 8, 1), 0.5)
    view = SimpleNamespace(image=lambda modality: image, mask=None, known=None, counts=True)
    return SimpleNamespace(name="few", train=[view] * count)


def test_few_views_are_refused_and_the_scene_tells_its_noise():
    with pytest.raises(SceneError, match="scene 'few' has 7 for training; it needs 8. Use density=adaptive"):
        control().prepare(scene_of(7), "thermal")
    policy = control()
    policy.prepare(scene_of(9), "thermal")
    assert policy.views == 9 and policy.noise > 0


def test_options_out_of_range_are_refused():
    with pytest.raises(ValueError, match="at most half of density.every"):
        control(every=10)
    with pytest.raises(ValueError, match="grad_quantile lies in"):
        control(grad_quantile=1.0)
    absent = {"gate_pixels": None, "late_opacity": None, "late_blame": None}
    control(**absent)
    for name in ("late_stop", *absent):
        with pytest.raises(ValueError, match=f"{name}.* must not be negative, got .*-0.5"):
            control(**{name: -0.5})


def test_under_the_cap_those_that_pass_the_gate_grow_and_not_those_that_pull_most():
    policy = control(grad_quantile=0.5)
    cloud = wall(policy)
    policy.cap_max = len(cloud) + 3
    cloud.state["seen"].fill_(10)
    cloud.state["gradient"].copy_(torch.linspace(10, 20, len(cloud)))
    cloud.state["gradient"][:5] = 16.0
    cloud.state["absolute"].copy_(cloud.state["gradient"])
    cloud.state["wrong"][:5], cloud.state["blaming"][:5] = 100, 5
    passing = cloud.splats.means[policy._passes(cloud.state)]
    before = len(cloud)
    assert len(passing) == 5 and policy._grow(cloud, 100.0, torch.Generator().manual_seed(0)) == 3
    assert (torch.cdist(cloud.splats.means[before:], passing).amin(1) < 1e-6).all()
