"""Anchors decoded by hand, what is out of view, and what cannot be done with Gaussians that are made for every view."""

import math

import pytest
import torch
from running import TINY, run
from threads import with_threads

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, SceneError
from heatsplat.density.merging import FlatMerging
from heatsplat.export.snapshot import snapshot
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.scaffold import Scaffold
from heatsplat.thermal.time_mlp import TimeMlp

CAMERA = Camera(torch.eye(4), torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), 32, 32)
AHEAD, BEHIND, ASIDE = [0.0, 0.0, 4.0], [0.0, 0.0, -4.0], [3.0, 0.0, 4.0]  # ASIDE projects at x = 40 of 32


def anchors(*places, **options):
    """A scaffold of two Gaussians each with features of two numbers, all networks zero, and its anchors."""
    model = Scaffold(**{"gaussians": 2, "feature_size": 2, **options})
    model.extent.fill_(2.0)
    means = torch.tensor(places)
    count = len(means)
    generator = torch.Generator().manual_seed(0)
    declared = model.per_gaussian(
        Seeds(means, torch.zeros(count, 1), generator, log_scales=torch.full((count, 3), math.log(0.5)))
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    shape = {"log_scales": torch.full((count, 3), math.log(0.2)), "quats": torch.ones(count, 4)}
    shape |= {"means": means, "opacity_logits": torch.zeros(count, 1)}
    return model, Splats(shape | {name: item.initial for name, item in declared.items()})


def seen(model, splats):
    query = Query(None, CAMERA)
    made = model.geometry(splats, query)
    return made, model.features(splats, Query(None, CAMERA, geometry=made))


@torch.no_grad()
def test_an_anchor_is_decoded_as_by_hand():
    model, splats = anchors(AHEAD)
    splats["offsets"][0] = torch.tensor([[1.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    splats["feature"][0] = torch.tensor([0.25, 0.0])
    opacity, shape, value = (model.networks[name] for name in ("opacity", "shape", "value"))
    opacity[0].weight[0, 5] = 1.0  # the first hidden unit is the distance: 4 of an extent of 2
    opacity[2].weight[:, 0] = torch.tensor([0.3, -0.3])
    shape[2].bias.copy_(torch.tensor([0.0, math.log(3.0), -math.log(3.0), 1.0, 2.0, 3.0, 4.0] * 2))
    value[0].weight[1, 0] = 2.0  # the second hidden unit is twice the first number of the feature
    value[0].weight[1, 4] = 1.0  # and the direction along z, which is 1
    value[2].weight[:, 1] = torch.tensor([1.0, -1.0])
    made, values = seen(model, splats)
    assert torch.allclose(made.means, torch.tensor([[0.5, 0.0, 4.0], [0.0, -1.0, 4.0]]))  # reach 0.5
    assert torch.allclose(made.opacities, torch.tensor([[math.tanh(0.6), 0.0]]))  # tanh(-0.6) is no Gaussian
    assert torch.allclose(made.scales, 0.2 * torch.tensor([[0.5, 0.75, 0.25]] * 2))
    assert torch.allclose(made.quats, torch.tensor([[1.0, 2.0, 3.0, 4.0]] * 2))
    sigmoid = 1 / (1 + math.exp(-1.5))
    assert torch.allclose(values, torch.tensor([[sigmoid], [1 - sigmoid]]))
    with torch.enable_grad():
        model.geometry(splats, Query(None, CAMERA))
        found = model.regularisers(splats)["volume"].item()
    assert found == pytest.approx(0.01 * 0.1**3 * 0.5 * 0.75 * 0.25)  # semi-axes of 0.2 are 0.1 extents
    assert model.regularisers(splats) == {}  # of the last geometry alone


@torch.no_grad()
def test_anchors_out_of_view_have_no_gaussians_and_ids_count_gaussians():
    model, splats = anchors(BEHIND, AHEAD, ASIDE, [0.5, 0.0, 4.0])
    for network in model.networks.values():
        network[2].bias.copy_(torch.linspace(0.1, 1.0, len(network[2].bias)))
        # The first Gaussian depends on the direction along x.
        network[0].weight[0, 2], network[2].weight[0, 0] = 1.0, 1.0
    made, every = seen(model, splats)
    assert made.in_view.tolist() == [False, True, False, True]
    assert not made.quats[[0, 1, 4, 5]].any() and not made.opacities[:, [0, 1, 4, 5]].any()
    assert made.opacities[0, [2, 3, 6, 7]].gt(0).all() and made.opacities[0, 2] < made.opacities[0, 6]
    some = model.features(splats, Query(torch.tensor([3, 6]), CAMERA, geometry=made))
    assert torch.equal(some, every[[3, 6]]) and not torch.equal(every[2], every[6])


def test_without_the_distance_nothing_changes_as_the_camera_comes_closer():
    for distance, same in ((True, False), (False, True)):
        torch.manual_seed(0)
        model, splats = anchors(AHEAD, [0.0, 0.0, 2.0], distance=distance)
        with torch.no_grad():
            for parameter in model.networks["value"].parameters():
                parameter.fill_(0.3)
        values = seen(model, splats)[1]
        assert torch.equal(values[:2], values[2:]) == same
    with pytest.raises(ValueError, match="must be at least 1, got 0, 32, 1"):
        Scaffold(gaussians=0)


def test_an_anchor_learns_by_the_length_of_the_run_as_gaussians_do():
    """All of it: the public code has one tensor for what are base sizes and reach here."""
    points = torch.zeros(3, 3)
    seeds = Seeds(points, points[:, :1], torch.Generator(), log_scales=points)
    declared = Scaffold().per_gaussian(seeds)
    assert set(declared) == {"feature", "offsets", "log_reach"} and all(item.paced for item in declared.values())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scaffold")
    given = (*TINY, "method=scaffold_gs", "max_steps=60", "test=false", "trainer.val_check_interval=60")
    given = (
        *given,
        "density.start=2",
        "density.every=10",
        "density.grow_from=5",
        "callbacks.checkpoint.every_n_train_steps=35",
    )
    given = (*given, "density.grad_threshold=2e-5", "density.stop=50")
    return given, folder, run(folder, *given)[0]


def test_a_run_learns_and_a_resumed_one_equals_it_bit_for_bit(trained, tmp_path):
    given, folder, module = trained
    view = module.scene.train[0]
    error = (module.predict(view.frame) - view.thermal).abs().mean()
    assert error < 0.6 * (view.thermal - view.thermal.mean()).abs().mean()
    first = len(module.init._means(module.scene, torch.Generator(), None))
    assert len(module.splats) > 1.02 * first
    again, _ = run(tmp_path, *given, f"ckpt={folder / 'checkpoints' / 'step_000035.ckpt'}")
    others = again.state_dict()
    assert [name for name, value in module.state_dict().items() if not torch.equal(value, others[name])] == []


def test_what_needs_gaussians_that_stay_is_refused_with_a_remedy(trained):
    _, folder, module = trained

    def begun(*overrides):
        build(compose([*TINY, *overrides])["module"]).attach(module.scene)

    with pytest.raises(
        SceneError, match=r"what Scaffold learned cannot be exported as Gaussians.* change with the view.*method=3dgs"
    ):
        snapshot(module)
    with pytest.raises(SceneError, match="the Gaussians of Scaffold cannot be merged: they are made anew .*merge=none"):
        FlatMerging().check(module)
    with pytest.raises(
        SceneError, match="Scaffold has anchors, and Adaptive is for Gaussians: leave density to the method"
    ):
        begun("method=scaffold_gs", "density=adaptive")
    with pytest.raises(SceneError, match=r"Static has Gaussians, and Anchors is for anchors"):
        begun("method=3dgs", "density=anchors")
    with pytest.raises(SceneError, match="which no filter of Gaussians in space knows: give smoothing=none"):
        begun("method=scaffold_gs", "smoothing=sampling")
    pretrained = "init=pretrained", f"init.path={folder}/checkpoints/last.ckpt"
    with pytest.raises(
        SceneError, match="last.ckpt holds anchors, whose Gaussians are made for each view: give a .ply"
    ):
        begun("method=3dgs", *pretrained)
    begun("method=scaffold_gs", *pretrained)  # which takes them for what they are
    with pytest.raises(ValueError, match="TimeMlp changes what Gaussians emit, and those of Scaffold are made anew"):
        TimeMlp(Scaffold())


@torch.no_grad()
def test_values_of_anchors_are_those_of_all_their_gaussians(trained):
    _, _, module = trained
    frame = module.scene.train.frames[0]
    ones = torch.ones(len(module.splats), 1)
    output = module.composited(frame, ones)
    assert torch.allclose(output.features[..., 0], output.alpha[0], atol=1e-5) and output.alpha.mean() > 0.3
    shown = module.render(frame, values=0.5 * ones)
    assert torch.allclose(
        shown.features[..., 0], 0.5 * shown.alpha[0] + (1 - shown.alpha[0]) * module.background, atol=1e-5
    )


def test_many_anchors_give_and_learn_the_same_bits_on_any_number_of_threads():
    count = 7001  # times ten Gaussians are more than torch leaves to one thread, and shares end inside vectors
    generator = torch.Generator().manual_seed(3)
    places = torch.rand(count, 3, generator=generator) * torch.tensor([2.0, 2.0, 1.0]) + torch.tensor([-1.0, -1.0, 4.0])
    model, splats = anchors(*places.tolist(), gaussians=10, feature_size=8)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.5, generator=generator)
        splats["feature"].normal_(generator=generator)

    def results():
        made, values = seen(model, splats)
        loss = sum(x.sum(-1).double().square().mean() for x in (made.scales, made.opacities.mT, values))
        loss = loss + 1e6 * model.regularisers(splats)["volume"]
        learned = dict(model.named_parameters())
        slopes = torch.autograd.grad(loss, list(learned.values()))
        found = {"scales": made.scales, "opacities": made.opacities, "values": values}
        return {name: x.detach() for name, x in found.items()} | dict(zip(learned, slopes, strict=True))

    one, *others = with_threads((1, 2, 3, 7), results)
    assert all(found.any() for found in one.values())
    for other in others:
        assert not [name for name, found in one.items() if not torch.equal(found, other[name])]
