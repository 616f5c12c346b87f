"""Settings that nothing asks for, parts that are not there, and kinds of lists and of settings by name: all with origin."""

import sys
from collections.abc import Mapping, Sequence
from types import ModuleType

import pytest
from helpers import ALL_METHODS

from heatsplat.composition import build, compose
from heatsplat.contracts import SceneError
from heatsplat.losses.compose import LossTerm
from heatsplat.runs.declared import check_declared, declared


@pytest.mark.parametrize("method", ALL_METHODS)
@pytest.mark.parametrize("recipe", [(), ("recipe=published",)])
def test_what_methods_set_is_asked_for_by_something(method, recipe):
    check_declared(compose([f"method={method}", *recipe]))


@pytest.mark.parametrize(
    "overrides",
    [
        "method=etgs loss=squared",
        "method=etgs loss=low_resolution",
        "method=thermogs loss=photometric",
        "method=thermonerf loss=rgb_thermal",
        "method=thermogs thermal=static",
        "method=instant_ngp thermal=static",
        "method=thermonerf thermal=static",
        "method=mftg thermal=newton_harmonic",
        "method=msmg thermal=through_air",
        "method=ti3dgs recipe=published thermal=static loss=photometric",
    ],
)
def test_an_option_takes_the_place_of_all_that_a_method_says_of_its_group(overrides):
    config = compose(overrides.split())
    check_declared(config)
    for group in ("thermal", "loss"):
        build(config[group])


def test_weights_of_thermogs_are_those_of_its_method_and_its_parts_have_them_elsewhere():
    config = compose(["method=thermogs", "weights.edge=0.5", "weights.pinn=0"])
    assert config["loss"]["terms"]["edge"]["weight"] == 0.5 and config["thermal"]["weights"]["pinn"] == 0
    config = compose(["method=thermalgs", "loss=thermogs", "thermal=energy_network"])
    assert config["loss"]["terms"]["edge"]["weight"] == 0.2 and config["thermal"]["weights"]["pinn"] == 1.0


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            "method=mip_splatting renderer=volume",
            r"renderer.antialiased, set by conf/method/mip_splatting.yaml, is not a setting of VolumeRenderer "
            r"\(renderer=volume\), which has background, coarse, fine: leave renderer=volume out, or add ~renderer.antialiased",
        ),
        (
            "method=ntr_gaussian recipe=published density=budget",
            "^density.reset_every, set by conf/recipe/methods/published_ntr_gaussian.yaml, is not a setting of Budget .*: "
            "leave recipe=published or density=budget out, or add ~density.reset_every$",
        ),
        ("method=3dgs loss=ravigs_reconstruction", r"^thermal.color_l2, set by conf/loss/.*: leave loss=ravigs_reconstruction"),
        ("method=etgs +thermal.frequncies=3", r"^thermal.frequncies is not a .*; did you mean frequencies\?$"),
        ("method=etgs +data.sice=3 +optim.foo=1", "^optim.foo is not a setting of Optimisation .*: leave .optim.foo=1 out$"),
        ("method=etgs +trainer.colour=red", "^trainer.colour is not a setting of Trainer"),
        ("method=etgs +module.colour=red", "^module.colour is not a setting of SplatTraining"),
        (
            "method=hexplane_4dgs recipe=published loss=squared",
            "loss.terms.photometric, set by conf/recipe/methods/published_hexplane_4dgs.yaml, has no _target_, and loss=squared "
            "has no such part: leave recipe=published or loss=squared out, or add loss.terms.photometric=null",
        ),
        ("method=etgs +loss.terms.edge.weight=3", "^loss.terms.edge has no .*: leave .loss.terms.edge.weight=3 out$"),
    ],
)  # fmt: skip
def test_what_nothing_asks_for_is_told_with_who_has_set_it(overrides, told):
    with pytest.raises(SceneError, match=told):
        check_declared(compose(overrides.split()))


def test_the_remedies_are_ones():
    for overrides in (
        ["method=ntr_gaussian", "recipe=published", "density=budget", "~density.reset_every"],
        ["method=hexplane_4dgs", "recipe=published", "loss=squared", "loss.terms.photometric=null"],
    ):
        config = compose(overrides)
        check_declared(config)
        build(config["density"])
        build(config["loss"])


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        ("method=physir thermal.air=5", r"thermal.air must be settings with a _target_ or null, got 5; .* by thermal.air\.\*"),
        ("method=through_air thermal.air=null", "thermal.air must be settings with a _target_, got null$"),
        ("method=etgs +callbacks.plateau=true", "callbacks.plateau must be settings with a _target_ or null, got true"),
        ("method=supirgs loss.terms.high_frequency.schedule=linear", "schedule must be settings with a _target_ or null"),
        ("method=ravigs thermal.degrees=3", "thermal.degrees must be settings by name, got 3"),
        ("method=ravigs thermal.degrees.emissivity=abc", "thermal.degrees.emissivity must be a whole number, got abc"),
        ("method=etgs density.remove_at=5", "density.remove_at must be a list, got 5"),
        ("method=etgs density.remove_at=[5,abc]", r"density.remove_at\[1\] must be a whole number, got abc"),
        ("method=thermogs weights.ode=abc", "thermal.weights.ode must be a number, got abc"),
        ("method=direct_3dgs super_resolution=abc", "module.supersample must be a whole number, got abc"),
    ],
)  # fmt: skip
def test_parts_lists_and_settings_by_name_are_of_their_kind(overrides, told):
    with pytest.raises(SceneError, match=told):
        check_declared(compose(overrides.split()))


def test_of_what_takes_any_setting_or_is_not_there_nothing_is_known():
    assert declared("heatsplat.density.proximity.Proximity").names is None
    assert declared("heatsplat.nowhere.Nothing").names is declared("None").names is None
    found = declared("heatsplat.losses.compose.Weighted")
    assert found.names == {"term", "weight", "schedule"}
    assert found.kinds == {"term": {"part"}, "weight": {"float"}, "schedule": {"part", "None"}}
    assert declared("pytorch_lightning.Trainer").kinds == {} != declared("pytorch_lightning.Trainer").names


class Mine:
    """Its annotations are classes, as in a file without ``from __future__ import annotations``."""

    def __init__(
        self,
        term: LossTerm,
        every: int = 1,
        low: Sequence[float] = (),
        sizes: list[int] | None = None,
        weights: Mapping[str, float] | None = None,
    ) -> None: ...


def test_annotations_count_whether_they_are_evaluated_or_not(monkeypatch):
    module = ModuleType("heatsplat.mine")
    module.Mine = Mine
    monkeypatch.setitem(sys.modules, "heatsplat.mine", module)
    found = declared("heatsplat.mine.Mine")
    assert found.kinds == {
        "term": {"part"},
        "every": {"int"},
        "low": {"list"},
        "sizes": {"list", "None"},
        "weights": {"group", "None"},
    }
    assert found.within == {"low": {"float"}, "sizes": {"int"}, "weights": {"float"}}
