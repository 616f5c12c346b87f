"""Budget: who grows and when, exactly to B and never above; noise is not detail; what shows nothing goes; resume."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, RenderOutput, SceneData, SceneError, View, ViewSet, WeightedSums
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.budget import CURVES, Budget, _best
from heatsplat.density.ops import Cloud
from heatsplat.renderers.base import rasterization
from heatsplat.splats import Splats

CAMERA = Camera(torch.eye(4), torch.eye(3), width=20, height=10)


def budget(**options) -> Budget:
    return Budget(**{"multiple": None, "least": 0} | options)


def make_cloud(policy, count: int, opacities: list[float] | None = None) -> Cloud:
    splats = Splats(
        {
            "means": torch.arange(count * 3, dtype=torch.float32).reshape(count, 3),
            "log_scales": torch.full((count, 3), 0.1).log(),
            "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            "opacity_logits": torch.logit(torch.tensor(opacities or [0.5] * count))[:, None],
        }
    )
    policy.initial_count = count
    return Cloud(splats, None, policy.initial_state(count, torch.device("cpu")))


def refine(policy: Budget, cloud: Cloud, step: int, seed: int = 0):
    return policy.refine(cloud, step, 1.0, torch.Generator().manual_seed(seed))


def blame(cloud: Cloud, score: list[float], wrong: float = 100.0) -> None:
    """What observing views would have summed."""
    cloud.state["worth"] = torch.tensor(score)
    cloud.state["pull"] = torch.ones(len(cloud))
    cloud.state["wrong"] = torch.where(cloud.state["worth"] > 0, wrong, 0.0)
    cloud.state["weight"] = torch.full((len(cloud),), 200.0)


def observed(policy: Budget, cloud: Cloud, sums: torch.Tensor, step: int) -> None:
    """A view of all Gaussians, with these sums [n, S], in which each pixel pulls at them alike."""
    means2d = torch.zeros(len(cloud), 2)
    means2d.absgrad = torch.ones(len(cloud), 2)
    rows = torch.zeros_like(sums, requires_grad=True)
    rows.grad = sums
    output = RenderOutput(
        torch.zeros(10, 20, 1), torch.zeros(1, 10, 20), None, {"visible_ids": torch.arange(len(cloud)), "means2d": means2d},
        WeightedSums(torch.zeros(10, 20, sums.shape[1]), rows),
    )  # fmt: skip
    policy.observe(cloud.state, output, CAMERA, step)


# Numbers ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curve", sorted(CURVES))
def test_numbers_follow_the_curve_to_exactly_b(curve: str):
    policy = budget(start=20, stop=115, every=10, cap_max=777, curve=curve, score="uniform", remove_at=())
    cloud = make_cloud(policy, 200)
    numbers = []
    for step in range(200):
        change = refine(policy, cloud, step)
        assert (change is not None) == (step in range(29, 115, 10))
        if change:
            numbers.append(len(cloud))
    events = range(1, len(numbers) + 1)
    assert len(numbers) == 9 and numbers[-1] == 777
    expected = [200 + 577 * CURVES[curve](event / 9) for event in events]
    unhindered = [min(number, 200 * 2**event) for event, number in zip(events, expected, strict=True)]
    assert numbers[2:] == pytest.approx(unhindered[2:], abs=6)
    assert all(after >= before for before, after in zip(numbers, numbers[1:], strict=False)) and max(numbers) <= 777


def test_what_was_pruned_comes_back_and_a_cap_that_is_lowered_holds():
    policy = budget(start=0, stop=100, every=10, cap_max=400, score="uniform", remove_at=())
    cloud = make_cloud(policy, 100)
    for step in range(100):
        if step == 39:
            cloud.splats["opacity_logits"].data[:50] = -20.0
            before = len(cloud)
        if step == 60:
            policy.cap_max = len(cloud)
        change = refine(policy, cloud, step)
        if step == 39:
            assert change.removed == 50 and len(cloud) == before - 50 + change.added
        if step == 69:
            assert change.added == 0
            policy.cap_max = 400
    assert len(cloud) == 400


def test_b_may_count_in_gaussians_of_the_start():
    policy = budget(start=0, stop=100, every=10, cap_max=400, score="uniform", remove_at=(), multiple=2.5)
    cloud = make_cloud(policy, 100)
    for step in range(100):
        refine(policy, cloud, step)
    assert len(cloud) == 250


@pytest.mark.parametrize("least, expected", [(90, 90), (10_000, 100)])
def test_a_start_of_few_gaussians_does_not_decide(least, expected):
    """One for two pixels of 20x10 at most."""
    policy = budget(multiple=3, least=least)
    policy.prepare(noisy_scene(0.02, 3), "thermal")
    policy.initial_count = 7
    assert policy.budget == expected
    policy.initial_count = 60
    assert policy.budget == 180


def test_a_round_that_begins_anew_fills_up_to_the_same_b():
    policy = budget(start=0, stop=100, every=10, cap_max=400, score="uniform", remove_at=(), multiple=2.5)
    cloud = make_cloud(policy, 100)
    for step in range(100):
        refine(policy, cloud, step)
    cloud.splats["opacity_logits"].data[:60] = -20.0
    numbers = []
    for step in range(100):
        change = refine(policy, cloud, step)
        numbers += [] if change is None else [len(cloud)]
    # 190 stayed, and not all that are missing come at once.
    assert numbers[0] < 230 and numbers[-1] == max(numbers) == 250


def test_more_than_b_at_the_start_stay_and_none_is_added():
    policy = budget(start=0, stop=100, every=10, cap_max=50, score="uniform", remove_at=())
    cloud = make_cloud(policy, 60)
    assert [refine(policy, cloud, step).added for step in range(9, 100, 10)] == [0] * 10


def test_one_event_splits_each_gaussian_once_at_most():
    policy = budget(start=0, stop=10, every=10, cap_max=1000, score="uniform", remove_at=())
    cloud = make_cloud(policy, 10)
    assert refine(policy, cloud, 9).added == 10


# Who -------------------------------------------------------------------------------------------------------------------


def test_only_gaussians_with_a_score_grow_the_worst_most_often():
    scores = torch.tensor([0.0, 1.0, 3.0, 6.0]).repeat(1000)
    drawn = _best(scores, 300, torch.Generator().manual_seed(1))
    counts = (drawn % 4).bincount(minlength=4)
    assert len(drawn.unique()) == 300 and counts[0] == 0
    assert counts[1:].tolist() == pytest.approx([30, 90, 180], abs=25)
    assert len(_best(scores, 9999, torch.Generator())) == 3000


def test_those_of_the_highest_scores_are_split_unless_they_are_drawn():
    scores = torch.tensor([2.0, 0.0, 9.0, 4.0, 3.0, 4.0])
    assert _best(scores, 3, None).tolist() == [2, 3, 5]
    assert _best(scores, 2, None).tolist() == [2, 3]  # of equals the first
    assert _best(scores, 99, None).tolist() == [0, 2, 3, 4, 5]
    chosen = set()
    for sampled in (False, True):
        for seed in range(20):
            policy = budget(start=0, stop=10, every=10, cap_max=7, sampled=sampled, remove_at=())
            cloud = make_cloud(policy, 6)
            blame(cloud, scores.tolist())
            assert refine(policy, cloud, 9, seed).added == 1
            first = cloud.splats.means[:, 0]
            chosen.add((sampled, int((first - torch.arange(7) * 3).abs().gt(0.01).nonzero()[0])))
    assert [index for sampled, index in chosen if not sampled] == [2]
    assert {index for sampled, index in chosen if sampled} == {0, 2, 3, 4, 5}


def test_both_is_error_times_pull_and_the_error_alone_where_nothing_pulls():
    policy = budget(start=0, stop=100, every=10, remove_at=())
    cloud = make_cloud(policy, 4)
    blame(cloud, [3.0, 2.0, 5.0, 0.0])
    cloud.state["pull"] = torch.tensor([2.0, 4.0, 0.0, 9.0])
    assert policy._scored(cloud.state).tolist() == [6, 8, 0, 0]
    cloud.state["pull"].zero_()
    assert policy._scored(cloud.state).tolist() == [3, 2, 5, 0]


def test_only_what_the_score_asks_for_is_gathered():
    gathered = {}
    for score in ("both", "error", "edge", "absgrad", "uniform"):
        policy = budget(start=0, stop=100, every=10, views=2, score=score, remove_at=())
        names = set(policy.initial_state(1, torch.device("cpu"))) - {"shown", "seen", "judged"}
        asked = [[policy.absgrad_at(step), policy.maps_at(step)] for step in (7, 9, 100)]
        assert asked[0] == asked[2] == [False, 0]
        gathered[score] = (names, *asked[1])
    pixels = {"weight", "wrong", "worth"}
    assert gathered == {
        "both": (pixels | {"pull"}, True, 3),
        "error": (pixels, False, 3),
        "edge": (pixels, False, 3),
        "absgrad": ({"pull"}, True, 0),
        "uniform": (set(), False, 0),
    }


def test_score_is_error_beyond_the_noise_summed_over_the_last_views_before_an_event():
    policy = budget(start=0, stop=100, every=10, views=3, noise=0.1, remove_at=())
    policy.prepare(noisy_scene(0.0, 1), "thermal")
    assert [policy.maps_at(step) for step in range(11)] == [0] * 7 + [3] * 3 + [0]
    assert policy.maps_at(100) == 0
    maps = policy.pixel_maps(torch.tensor([[0.2, 0.5]]), torch.zeros(1, 2, 1), 7)
    torch.testing.assert_close(maps, torch.tensor([[[1.0, 0.0, 0.0], [1.0, 1.0, 0.2]]]))
    cloud = make_cloud(policy, 2)
    for step in (7, 8):
        observed(policy, cloud, torch.tensor([[50.0, 40.0, 2.0], [0.0, 0.0, 0.0]]), step)
    assert cloud.state["worth"].tolist() == [4, 0] and cloud.state["wrong"].tolist() == [80, 0]
    assert refine(policy, cloud, 9).added == 1
    assert not cloud.state["worth"].any() and cloud.splats.means[1].tolist() == [3, 4, 5]


def test_gaussians_wrong_on_few_pixels_are_not_split():
    policy = budget(start=0, stop=100, every=10, cap_max=100, remove_at=())
    cloud = make_cloud(policy, 3)
    blame(cloud, [1.0, 1.0, 1.0])
    cloud.state["wrong"] = torch.tensor([2.9, 4.9, 5.1])  # of 200 pixels each: 3 + 1 %
    assert refine(policy, cloud, 9).added == 1


def test_edge_scores_by_what_training_images_show_and_not_by_errors():
    policy = budget(start=0, stop=100, every=10, views=3, score="edge", noise=0.1, remove_at=())
    columns = torch.arange(40.0)
    step_at_20, error = (columns >= 20).double().expand(30, 40), torch.zeros(30, 40)
    weight, wrong, edge = policy.pixel_maps(error, step_at_20[..., None].expand(-1, -1, 3), 9).unbind(-1)
    # of a step blurred by s: the slope is a Gaussian, and its own slope at a distance x is -x / s^2 of it
    x = (columns - 19.5).double()
    expected = (x / 1.5**2 * torch.exp(-(x**2) / (2 * 1.5**2)) / (1.5 * (2 * torch.pi) ** 0.5)).abs()
    torch.testing.assert_close(edge.double(), expected.expand(30, 40), atol=0.005, rtol=0)
    assert weight.all() and not wrong.any() and edge.dtype == error.dtype


def test_pixels_that_are_not_known_have_no_edges_and_make_none():
    policy = budget(start=0, stop=100, every=10, views=3, score="edge", noise=0.1, remove_at=())
    target = (torch.arange(40) >= 20).float().expand(30, 40)[..., None].clone()
    whole = policy.pixel_maps(torch.zeros(30, 40), target, 9)[..., 2]
    target[:, 30:] = torch.nan
    target[4:8, 19:22] = torch.nan
    edge = policy.pixel_maps(torch.zeros(30, 40), target, 9)[..., 2]
    assert not edge[:, 30:].any() and not edge[4:8, 19:22].any()
    torch.testing.assert_close(edge[14:, :26], whole[14:, :26])
    assert not policy.pixel_maps(torch.zeros(30, 40), torch.full((30, 40, 1), torch.nan), 9)[..., 2].any()


def test_absgrad_scores_by_the_pull_on_screen_positions():
    policy = budget(start=0, stop=100, every=10, views=2, score="absgrad", remove_at=())
    assert policy.absgrad_at(9) and policy.maps_at(9) == 0
    cloud = make_cloud(policy, 2)
    means2d = torch.zeros(2, 2)
    means2d.absgrad = torch.tensor([[3.0, 0.0], [0.0, 2.0]])
    meta = {"visible_ids": torch.tensor([0, 1]), "means2d": means2d}
    output = RenderOutput(torch.zeros(10, 20, 1), torch.zeros(1, 10, 20), None, meta)
    for step in (7, 8, 9):
        policy.observe(cloud.state, output, CAMERA, step)
    assert cloud.state["pull"].tolist() == [60, 20] and policy._scored(cloud.state).tolist() == [60, 20]
    del means2d.absgrad  # centres that are held still leave none on some renderers
    policy.observe(cloud.state, output, CAMERA, 8)
    assert cloud.state["pull"].tolist() == [60, 20]


def noisy_scene(noise: float, views: int) -> SceneData:
    frames = [Frame(str(i), i, CAMERA) for i in range(views)]
    image = torch.linspace(0.3, 0.6, 64)[:, None] * torch.ones(1, 80)

    def view(i: int) -> View:
        return View(
            frames[i], (image + noise * torch.randn(64, 80, generator=torch.Generator().manual_seed(i)))[..., None]
        )

    train = ViewSet(frames, view)
    return SceneData("noisy", train, train.subset([]), train.subset([]), torch.rand(9, 3))


def selected(policy: Budget, noise: float) -> float:
    """Share of many Gaussians of many sizes that may be split where the image is right but for noise."""
    generator = torch.Generator().manual_seed(5)
    count, width, height = 400, 160, 120
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 3.0, 1.0]) - torch.tensor([2.0, 1.5, -4.0])
    scales = (0.02 * 12 ** torch.rand(count, 1, generator=generator)).repeat(1, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    K = torch.tensor([[160.0, 0.0, 80.0], [0.0, 160.0, 60.0], [0.0, 0.0, 1.0]])
    cloud = make_cloud(policy, count)
    for step in range(policy.every - policy.views, policy.every):
        output = rasterization(
            means, quats, scales, torch.full((1, count), 0.6), torch.zeros(count, 1), torch.eye(4), K, width, height,
            backend="cpu", depth=False, maps=3,
        )  # fmt: skip
        error = (noise * torch.randn(height, width, generator=generator)).abs()
        (output.weighted.image * policy.pixel_maps(error, error[..., None], step)).sum().backward()
        policy.observe(cloud.state, output, CAMERA, step)
    return refine(policy, cloud, policy.every - 1).added / count


def test_noise_is_not_detail():
    def policy(floor: float) -> Budget:
        made = budget(start=0, stop=100, every=50, cap_max=10**6, floor=floor, remove_at=())
        made.prepare(noisy_scene(0.02, 3), "thermal")
        return made

    assert policy(3.0).noise == pytest.approx(0.02, rel=0.15)
    assert policy(0.0).noise is None
    assert selected(policy(3.0), 0.02) < 0.01
    assert selected(policy(0.0), 0.02) > 0.9
    assert selected(policy(3.0), 0.06) > 0.9  # an error of three times that is none of the camera's


# Removal ---------------------------------------------------------------------------------------------------------------


def test_what_a_pass_of_the_views_hardly_shows_leaves_after_it():
    policy = budget(start=0, stop=10, every=10, cap_max=6, score="uniform", remove_at=(11,), keep=0.99)
    policy.prepare(noisy_scene(0.01, 4), "thermal")
    assert [step for step in range(40) if policy.maps_at(step)] == [12, 13, 14, 15]
    cloud = make_cloud(policy, 6)
    for step in range(12, 16):
        once = 500.0 if step == 13 else 0.0
        observed(policy, cloud, torch.tensor([[300.0], [300.0], [1.0], [0.0], [once], [30.0]]), step)
    assert refine(policy, cloud, 14) is None
    change = refine(policy, cloud, 15)  # of 2 to 5: below 1 % together, never seen, seen once, seen
    assert (change.added, change.removed) == (0, 3)
    assert cloud.splats.means[:, 0].tolist() == [0, 3, 15] and not cloud.state["shown"].any()


def test_no_pass_comes_before_a_step_that_is_after_the_last(caplog):
    """A pass came at steps 160 to 179, 30 before that which was asked for."""
    policy = budget(start=0, stop=0, every=10, remove_at=(210,), remove_by=180)
    policy.prepare(noisy_scene(0.01, 20), "thermal")
    assert not any(policy.maps_at(step) for step in range(300))
    assert "remove_at=[210] begins after density.remove_by=180" in caplog.text


def test_of_many_views_the_last_pass_that_ends_in_time_judges_and_what_was_split_in_it_stays():
    def policy_of(views: int) -> Budget:
        policy = budget(start=0, stop=0, every=10, remove_at=(96,), remove_by=180)
        policy.steps_of_pass = views
        return policy

    def judged(views: int) -> list[int]:
        return [step for step in range(200) if policy_of(views).maps_at(step)]

    assert judged(40) == list(range(120, 160))  # the first that begins at the step or later
    assert judged(70) == list(range(70, 140))  # that one would end at step 209
    assert judged(95) == list(range(95)) and judged(190) == []

    policy = policy_of(70)
    cloud = make_cloud(policy, 4)
    for step in range(70, 140):
        observed(policy, cloud, torch.tensor([90.0, 90, 0, 0, 0])[: len(cloud), None], step)
        if step == 100:
            cloud.split(torch.tensor([3]), policy.split)  # views before this step may show its halves
        change = refine(policy, cloud, step)
    assert change.removed == 1 and cloud.splats.means[:2, 0].tolist() == [0, 3] and len(cloud) == 4


def test_what_only_masked_pixels_show_leaves_and_does_not_count_as_right():
    policy = budget(start=0, stop=100, every=4, noise=0.01, remove_at=(4,))
    policy.prepare(noisy_scene(0.01, 4), "thermal")
    quats, K = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.tensor([[20.0, 0, 10], [0, 20, 5], [0, 0, 1]])
    means = torch.tensor([[-0.25, 0.0, 1.0], [0.25, 0.0, 1.0]])
    known = torch.full((10, 20, 1), 0.5)
    known[:, 10:] = torch.nan
    cloud = make_cloud(policy, 2)
    for step in range(4, 8):
        output = rasterization(
            means, quats, torch.full((2, 3), 0.02), torch.full((1, 2), 0.6), torch.zeros(2, 1), torch.eye(4), K, 20, 10,
            backend="cpu", depth=False, maps=policy.maps_at(step),
        )  # fmt: skip
        (output.weighted.image * policy.pixel_maps(torch.zeros(10, 20), known, step)).sum().backward()
        policy.observe(cloud.state, output, CAMERA, step)
    assert cloud.state["weight"][0] > 1 and cloud.state["weight"][1] == 0
    assert cloud.state["seen"].tolist() == [4, 0]
    assert policy._worth(cloud).tolist() == [True, False]


def test_what_another_modality_shows_stays():
    policy = budget(start=0, stop=10, every=10, remove_at=(0,))
    cloud = make_cloud(policy, 3)
    cloud.splats.raw["opacity_logits"] = torch.nn.Parameter(torch.tensor([[0.0, 0.0], [-30.0, 0.0], [-30.0, -30.0]]))
    cloud.state["shown"] = torch.tensor([1.0, 0.0, 0.0])
    cloud.state["seen"] = torch.tensor([2.0, 0.0, 0.0])
    cloud.state["judged"] += 1
    assert policy._worth(cloud).tolist() == [True, True, False]


def test_transparent_are_removed_at_events_and_an_empty_cloud_is_an_error():
    policy = budget(start=0, stop=100, every=10, cap_max=3, remove_at=())
    cloud = make_cloud(policy, 3, [0.5, 0.001, 0.5])
    assert refine(policy, cloud, 9).removed == 1 and len(cloud) == 2
    with pytest.raises(SceneError, match="remove all 2 Gaussians at step 9"):
        refine(policy, make_cloud(policy, 2, [0.001] * 2), 9)


@pytest.mark.parametrize(
    "options",
    [
        {"every": 0},
        {"multiple": float("inf")},
        {"cap_max": float("inf"), "multiple": None},
        {"keep": 0.0},
        {"floor": -1.0},
        {"curve": "steep"},
        {"score": "luck"},
        {"start": -1},
        {"stop": -1},
        {"prune_opacity": -0.1},
        {"remove_at": [9, -1]},
    ],
)
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Budget(**options)


# Training --------------------------------------------------------------------------------------------------------------


def plane_view(texture, noise: float, step: int) -> tuple[Camera, torch.Tensor]:
    """A camera before the plane z = 4, a little aside at every step, and what it records."""
    size, focal = 64, 64.0
    draw = torch.Generator().manual_seed(step)
    shift = 0.4 * (torch.rand(2, generator=draw) - 0.5)
    viewmat = torch.eye(4)
    viewmat[:2, 3] = -shift
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    places = (torch.arange(size) + 0.5 - size / 2) * 4 / focal
    image = texture(places[None, :] + shift[0], places[:, None] + shift[1])
    return Camera(viewmat, K, size, size), (image + noise * torch.randn(size, size, generator=draw))[..., None]


def share_of_new_on_the_right(policy, steps: int, noise: float) -> float:
    """Trains Gaussians on a plane whose left half is flat and whose right half is textured."""

    def texture(x, y):
        return 0.5 + torch.where(x > 0, 0.2 * torch.sin(12 * x) * torch.sin(12 * y), 0.0)

    grid = torch.linspace(-2.0, 2.0, 16)
    x, y = torch.meshgrid(grid, grid, indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((256,), 4.0)], dim=1)
    splats = Splats(
        {
            "means": means,
            "log_scales": torch.tensor([0.12, 0.13, 0.02]).log().repeat(256, 1),
            "quats": torch.tensor([1.0, 0, 0, 0]).repeat(256, 1),
            "opacity_logits": torch.full((256, 1), 1.0),
            "heat": torch.full((256, 1), 0.4),
        }
    )
    rates = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "heat": 1e-2}
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name, "lr": lr} for name, lr in rates.items()])
    cloud = Cloud(splats, optimizer, policy.initial_state(256, torch.device("cpu")))
    for step in range(steps):
        camera, target = plane_view(texture, noise, step)
        output = rasterization(
            splats.means, splats.quats, splats.scales, splats.opacities, splats["heat"], camera.viewmat.float(),
            camera.K.float(), camera.width, camera.height, backend="cpu", depth=False, maps=policy.maps_at(step),
            absgrad=policy.absgrad_at(step),
        )  # fmt: skip
        error = (output.features - target).abs()
        loss = error.mean()
        if output.weighted is not None:
            loss = (
                loss + (output.weighted.image * policy.pixel_maps(error.detach()[..., 0], error.detach(), step)).sum()
            )
        optimizer.zero_grad()
        loss.backward()
        policy.observe(cloud.state, output, camera, step)
        optimizer.step()
        policy.refine(cloud, step, 1.0, torch.Generator().manual_seed(step))
    assert len(splats) > 300
    right = int((splats.means[:, 0] > 0).sum())
    return (right - 128) / (len(splats) - 256)


def test_new_gaussians_come_where_there_is_texture():
    steps, noise = 160, 0.01
    ours = budget(start=40, stop=160, every=20, cap_max=512, curve="sqrt", noise=noise, remove_at=())
    theirs = Adaptive(start=40, stop=160, every=20, cap_max=512, duplicate_scale=0.05, reset_every=None)
    share = share_of_new_on_the_right(ours, steps, noise)
    assert share >= 0.8
    assert share_of_new_on_the_right(theirs, steps, noise) < share
