"""Fields: what a place sends by hand, runs that resume, and what is refused because there are no Gaussians."""

import math

import pytest
import torch
from running import TINY, run
from threads import with_threads

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.export.snapshot import snapshot
from heatsplat.runs.run import load
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.hash_field import HashField
from heatsplat.thermal.time_mlp import TimeMlp

SMALL = (
    "thermal.levels=4",
    "thermal.coarsest=8",
    "thermal.finest=64",
    "thermal.entries_log2=12",
    "thermal.lr=0.02",
    "schedule.rays=400",
)


def field(**options) -> HashField:
    model = HashField(**{"levels": 1, "coarsest": 4, "finest": 4, "numbers": 1, "width": 2, "known": 1} | options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    return model


@torch.no_grad()
def test_density_and_values_of_a_place_are_those_computed_by_hand():
    model = field(companions={"rgb": 3}, directional=["rgb"])
    model.center.copy_(torch.tensor([1.0, 0.0, 0.0]))
    model.reach.fill_(2.0)
    model.tables[0, 2 + 2 * 5 + 2 * 25, 0] = 0.8  # the middle node of 5³, which is the box's middle
    model.trunk[0].weight[0, 0], model.trunk[2].weight[0, 0] = 1.0, 3.0
    model.trunk[2].weight[1, 0] = 2.0
    model.heads["thermal"][0].weight[0, 0] = model.heads["thermal"][2].weight[0, 0] = 1.0
    model.heads["rgb"][0].weight[0, 1 + 2] = model.heads["rgb"][2].weight[1, 0] = 1.0  # the harmonic along z
    points = torch.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1e6, 0.0, 0.0]])
    density, known = model.density(points)
    # A half edge is half of the contracted half; nodes of 4 cells lie a half edge apart, so that the second reads half of it.
    read = torch.tensor([0.8, 0.4, 0.0])
    assert torch.allclose(density, (3 * read - 1).exp() / 2, rtol=1e-4) and torch.allclose(
        known[:, 0], 2 * read, atol=1e-5
    )
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    sent = model.values(known, up, Query())
    assert torch.allclose(sent[:, 0], (2 * read).sigmoid(), atol=1e-5)
    c1 = math.sqrt(3 / (4 * math.pi))
    assert torch.allclose(sent[:, 2], torch.tensor(c1).sigmoid(), atol=1e-5)
    assert torch.allclose(sent[:, [1, 3]], torch.tensor(0.5))
    assert torch.allclose(model.values(known, -up, Query())[:, 0], sent[:, 0])  # heat does not see the direction
    assert not torch.allclose(model.values(known, -up, Query())[:, 2], sent[:, 2])


def test_it_starts_from_the_runs_own_generator_and_refuses_what_is_not_there():
    one, two = HashField(levels=1), HashField(levels=1)
    for model in (one, two):
        assert model.per_gaussian(Seeds(torch.zeros(0, 3), torch.zeros(0, 1), torch.Generator().manual_seed(0))) == {}
    assert (
        all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True)) and one.tables.std() > 0
    )
    with pytest.raises(ValueError, match="thermal.directional names rgb; there are thermal"):
        HashField(directional=["rgb"])
    with pytest.raises(ValueError, match="finest not below coarsest, got 1, 8, 16, 15, 2, 32, 15, 8"):
        HashField(finest=8, directional=[])
    with pytest.raises(TypeError, match="HashField has no Gaussians that would emit"):
        one.features(None, Query())
    with pytest.raises(
        ValueError, match="TimeMlp changes what Gaussians emit, and those of HashField .* there are none"
    ):
        TimeMlp(HashField(directional=[]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("field")
    given = (
        *TINY,
        *SMALL,
        "method=thermonerf",
        "max_steps=60",
        "trainer.val_check_interval=60",
        "trainer.limit_val_batches=1",
    )
    given = (*given, "test=false", "callbacks.checkpoint.every_n_train_steps=35")
    return given, folder, run(folder, *given)[0]


def test_a_field_learns_both_images_and_a_resumed_run_equals_it_bit_for_bit(trained, tmp_path):
    given, folder, module = trained
    view = module.scene.train[0]
    found = module.predict_all(view.frame)
    for name, target, share in (("thermal", view.thermal, 0.8), ("rgb", view.rgb, 0.99)):
        assert (found[name] - target).abs().mean() < share * (target - target.mean((0, 1))).abs().mean(), name
    again, _ = run(tmp_path, *given, f"ckpt={folder / 'checkpoints' / 'step_000035.ckpt'}")
    others = again.state_dict()
    assert [name for name, value in module.state_dict().items() if not torch.equal(value, others[name])] == []


def test_a_trained_field_is_loaded_and_rendered_and_has_a_depth(trained):
    _, folder, module = trained
    scene = load(folder / "checkpoints" / "last.ckpt")
    frame = scene.scene.train.frames[0]
    celsius = scene.render(frame, unseen="keep")
    assert torch.allclose(celsius, scene.scene.thermal_range.to_celsius(module.predict(frame)[..., 0]), atol=1e-4)
    depth = scene.depth(frame)
    assert depth.isfinite().float().mean() > 0.5 and (depth > 0).all()


def test_what_needs_gaussians_is_refused_with_a_remedy(trained):
    _, folder, module = trained

    def begun(*overrides):
        build(compose([*TINY, *overrides])["module"]).attach(module.scene)

    with pytest.raises(
        SceneError, match=r"what HashField learned cannot be exported as Gaussians.* it has no Gaussians.*method=3dgs"
    ):
        snapshot(module)
    with pytest.raises(SceneError, match="HashField has no Gaussians, which this asks for: leave it out"):
        module.composited(module.scene.train.frames[0], torch.zeros(0, 1))
    for name, other, part in (
        ("density", "adaptive", "Adaptive"),
        ("renderer", "auto", "Renderer"),
        ("init", "sfm", "Init"),
    ):
        with pytest.raises(
            SceneError, match=rf"is a field without Gaussians, and {part}\w* is for .*leave {name} to the method"
        ):
            begun("method=instant_ngp", f"{name}={other}")
    with pytest.raises(SceneError, match="Static has Gaussians, and VolumeRenderer is for fields: leave renderer"):
        begun("method=3dgs", "renderer=volume")
    with pytest.raises(SceneError, match="leave renderer to the method, and thermal with it"):
        begun("method=instant_ngp", "thermal=static")
    with pytest.raises(
        SceneError, match="Lattice takes single pixels out of images, .*frame_offset.*: give sensor=none"
    ):
        begun("method=instant_ngp", "sensor=frame_offset")
    with pytest.raises(SceneError, match="HashField is a field without Gaussians, .* ShortLists .* overlap=none"):
        begun("method=instant_ngp", "overlap=short_lists")
    with pytest.raises(SceneError, match="HashField is a field without Gaussians, .* optim.decoupled .* optim=adam"):
        begun("method=instant_ngp", "optim=adamw")
    with pytest.raises(SceneError, match="last.ckpt holds a field without Gaussians: give a .ply, or the checkpoint"):
        begun("method=3dgs", "init=pretrained", f"init.path={folder}/checkpoints/last.ckpt")


def test_colours_of_many_places_have_the_same_bits_on_any_number_of_threads():
    model = field(companions={"rgb": 3}, directional=["rgb"])
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.heads.parameters():
            parameter.normal_(generator=generator)
    known, ways = torch.rand(20_001, 1, generator=generator), torch.rand(20_001, 3, generator=generator)
    with torch.no_grad():
        one, *others = with_threads(
            (1, 2, 3, 7), lambda: model.values(known, ways / ways.norm(dim=1)[:, None], Query(None))
        )
    assert one.shape == (20_001, 4) and one.std(0).min() > 0
    assert all(torch.equal(one, other) for other in others)
