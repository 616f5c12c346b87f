"""Merging after training: what is lost is what was stated, and only what agrees at all times becomes one."""

import math
from types import SimpleNamespace

import pytest
import torch
from running import TINY, compose_run

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.density import merging
from heatsplat.density.merging import STRICT, FlatMerging
from heatsplat.density.ops import Cloud
from heatsplat.runs.run import begin
from heatsplat.splats import Splats
from heatsplat.thermal.conduction import Conducting
from heatsplat.thermal.hexplane import HexPlane

HALF = 0.3  # of a semi-axis: how far the halves of a split Gaussian are from its mean


def untrained(tmp_path, *overrides):
    """The module of a run before its first step, with its scene."""
    run = begin(
        compose(
            [
                *TINY,
                "data.scene=cooling",
                "data.downscale=2",
                "data.frames=9",
                "init.count=200",
                "max_steps=10",
                *overrides,
            ]
        ),
        tmp_path,
    )
    run.data.setup("fit")
    run.module.attach(run.data.scene)
    return run.module


def halved(module):
    """Every Gaussian of the module in two halves with its moments, so that half of the Gaussians are too many."""
    splats = module.splats
    rows = {name: torch.cat([splats[name].detach()] * 2) for name in splats.names}
    count = len(splats)
    rows["quats"] = torch.tensor([1.0, 0, 0, 0]).repeat(2 * count, 1)
    offset = HALF * rows["log_scales"][:count, 0].exp()
    rows["means"][:count, 0] += offset
    rows["means"][count:, 0] -= offset
    rows["log_scales"][:, 0] += 0.5 * torch.log(torch.tensor(1 - HALF**2))
    rows["opacity_logits"] = torch.full_like(rows["opacity_logits"], -1.0)
    module.splats = Splats(rows)
    return module


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    return halved(untrained(tmp_path_factory.mktemp("run"), "method=etgs"))


@pytest.fixture(scope="module")
def level(module):
    return next(FlatMerging().levels(module, [0.05]))


def lost_c(module, splats):
    """What other splats change of all training images, °C: root mean square, and the quantile that is reported beside it."""
    before = [module.predict_all(frame)["clean"] for frame in module.scene.train.frames]
    with module.showing(splats):
        after = [module.predict_all(frame)["clean"] for frame in module.scene.train.frames]
    off = (torch.stack(after) - torch.stack(before)).abs().flatten().double()
    strict = off.sort().values[math.ceil(STRICT * len(off)) - 1]
    return [module.scene.thermal_range.span_k * lost.item() for lost in (off.square().mean().sqrt(), strict)]


def test_a_long_search_says_how_far_it_is(module, monkeypatch, caplog):
    caplog.set_level("INFO", merging.__name__)
    next(FlatMerging(views=2).levels(module, [0.05]))
    assert [line.split(":")[0] for line in caplog.messages] == ["merged"]
    monkeypatch.setattr(merging, "TOLD_SECONDS", 0.0)
    told = []
    for level in FlatMerging(views=2).levels(module, [0.02, 0.05]):
        told.append([line for line in caplog.messages if line.startswith("merging, round ")])
        rounds = {int(line.split()[2].strip(",")) for line in told[-1]}
        assert rounds == set(range(level.found["rounds"] + 1))
    for doing in ("weighing the Gaussians", "dealing out what changed", "comparing the images"):
        assert any(f"{doing} (view 2 of 2): {len(module.splats)} Gaussians are left" in line for line in told[0])
    assert len(told[1]) > len(told[0])


def test_what_is_lost_is_measured_and_kept(module):
    before = len(module.splats)
    first, second = FlatMerging().levels(module, [0.02, 0.2])
    for level, tolerance_c in ((first, 0.02), (second, 0.2)):
        assert level.found["rms_c"] <= tolerance_c
        told = [level.found[name] for name in ("rms_c", "q0.999_c")]
        assert told == pytest.approx(lost_c(module, level.splats), rel=1e-4)
        assert level.found["after"] == len(level.splats) == len(level.origin)
    assert len(second.splats) < len(first.splats) < before
    assert len(module.splats) == before


def test_the_same_gaussians_are_merged_every_time(module, level):
    again = next(FlatMerging().levels(module, [0.05]))
    assert torch.equal(again.origin, level.origin)
    assert all(torch.equal(again.splats[name], level.splats[name]) for name in level.splats.names)


def test_a_few_pairs_and_views_at_a_time_find_the_same(module, level, monkeypatch):
    monkeypatch.setattr(merging, "PAIRS", 97)
    monkeypatch.setattr(merging, "VIEWS", 3)
    few = next(FlatMerging().levels(module, [0.05]))
    assert torch.equal(few.origin, level.origin)
    assert all(torch.equal(few.splats[name], level.splats[name]) for name in level.splats.names)


def test_what_stays_keeps_its_moments(module, level):
    splats = Splats({name: module.splats[name].detach() for name in module.splats.names})
    adam = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names], lr=0.0)
    sum(splats[name].square().sum() for name in splats.names).backward()
    adam.step()
    moments = adam.state[splats["means"]]["exp_avg"].clone()
    cloud = Cloud(splats, adam, {"seen": torch.arange(float(len(splats)))})
    level.apply(cloud)
    stayed, new = level.origin >= 0, level.origin < 0
    assert new.any()
    assert all(torch.equal(splats[name], level.splats[name]) for name in splats.names)
    after = adam.state[splats["means"]]["exp_avg"]
    assert torch.equal(after[stayed], moments[level.origin[stayed]])
    assert not after[new].any()
    assert torch.equal(cloud.state["seen"][stayed], level.origin[stayed].float())


def test_temperatures_that_cross_are_not_merged(module):
    """Two Gaussians at one place, of the same mean temperature: one cools at once, the other is always in between."""
    pair = {name: module.splats[name].detach()[:2].clone() for name in module.splats.names}
    pair["means"][1] = pair["means"][0]
    pair["log_scales"][:], pair["opacity_logits"][:] = -2.0, 3.0
    for apart, left in ((0.0, 1), (0.5, 2)):
        pair["initial_state"] = torch.tensor([0.5 + apart, 0.5])
        pair["log_rate"] = torch.tensor([3.0, 0.0])
        if not apart:
            pair["log_rate"][:] = 0.0
        with module.showing(Splats(pair)):
            at = torch.stack([module.emissions(module.splats, frame)[:, 0] for frame in module.scene.train.frames])
            if apart:
                assert (at[0, 0] > at[0, 1]) and (at[-1, 0] < at[-1, 1])
            level = next(FlatMerging(tolerance_c=40.0).levels(module, [40.0]))
        assert len(level.splats) == left


def test_a_gaussian_that_is_never_shown_is_not_merged_into_one_that_is(module):
    """It has a zero quaternion, which says nothing of how it lies."""
    pair = {name: module.splats[name].detach()[[0, 0]] for name in module.splats.names}
    for hidden, left in ((False, 1), (True, 2)):
        pair["quats"][0] = torch.tensor([0.0 if hidden else 1.0, 0.0, 0.0, 0.0])
        with module.showing(Splats(pair)):
            level = next(FlatMerging(tolerance_c=40.0).levels(module, [40.0]))
        assert len(level.splats) == left


def test_options_out_of_range_are_refused():
    for options in ({"tolerance_c": 0.0}, {"share": 0.6}, {"views": 0}, {"neighbours": 0}):
        with pytest.raises(ValueError, match=r"merge\."):
            FlatMerging(**options)


@pytest.mark.parametrize("model", [Conducting, HexPlane])
def test_models_whose_gaussians_depend_on_each_other_are_refused_by_name(model):
    class Model(model):
        def __init__(self):
            torch.nn.Module.__init__(self)

    with pytest.raises(SceneError, match=f"Model cannot be merged: {model.inseparable}"):
        FlatMerging().check(SimpleNamespace(thermal=Model()))


def test_images_without_degrees_are_refused(module):
    scene = SimpleNamespace(range_of=lambda _: None, name="photos")
    with pytest.raises(SceneError, match="photos.*no temperatures"):
        FlatMerging().check(SimpleNamespace(thermal=module.thermal, modality="thermal", scene=scene))


def test_off_is_absent():
    config = compose_run("method=etgs")
    assert config.merge._target_ == "heatsplat.density.base.Merging" and len(config.merge) == 1
