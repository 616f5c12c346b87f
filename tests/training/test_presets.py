"""Presets and recipes: every method with every one, what a preset leaves to the method, what the command line overrules."""

import functools
import itertools
from pathlib import Path

import pytest
import yaml
from running import BARE, run

from heatsplat.composition import CONF, build, compose
from heatsplat.contracts import SceneError
from heatsplat.runs.checks import checked
from heatsplat.runs.stepping import Stepper

PRESETS = ("draft", "fast", "balanced", "full")
METHODS = sorted(path.stem for path in (Path(CONF) / "method").glob("*.yaml"))
TURNS = list(zip(METHODS, itertools.cycle(PRESETS), strict=False))
RECIPES = sorted(path.stem for path in (Path(CONF) / "recipe").glob("*.yaml"))
PUBLISHED = ("etgs", "ti3dgs", "ravigs", "ntr_gaussian")  # each kind of density control; the others where there is time
MORE = ("supirgs", "thermogs", "thermal3dgs", "hexplane_4dgs")
OWN = {"ravigs": "CoSupport", "ti3dgs": "Proximity", "ntr_gaussian": "Adaptive", "mftg": "Adaptive"}


@functools.cache
def composed(*overrides: str) -> dict:
    """A configuration that several tests read and nobody changes."""
    return compose(overrides)


def density_of(config: dict) -> str:
    return kind(config["density"])


def kind(settings: dict) -> str:
    """The class that settings build."""
    return settings["_target_"].rpartition(".")[2]


@pytest.mark.parametrize(("method", "preset"), TURNS)
def test_a_method_keeps_what_is_its_own_with_a_preset(method, preset):
    """Its schedule is shares of the preset's steps, and none ends beyond them; presets take turns."""
    plain, own = compose([f"method={method}"]), (Path(CONF) / "method" / f"{method}.yaml").read_text()
    config = composed(f"method={method}", f"preset={preset}", "data.size=tiny")
    if "stop" not in config["density"]:  # nothing grows: a field has no Gaussians
        return
    steps, stop = config["max_steps"], config["density"]["stop"]
    assert config["density"]["cap_max"] == config["cap_max"]
    assert stop <= steps / 2
    for group in ("thermal", "loss", "stages", "sensor"):
        assert config[group].get("_target_") == plain[group].get("_target_"), group
    if density_of(plain) != "Budget" or "two_rounds" in own or "first_stage" in own:
        assert stop == pytest.approx(plain["density"]["stop"] * steps / 30000, abs=1)
        assert density_of(config) == density_of(plain)
    else:
        assert density_of(config) == "Budget"


def test_presets_are_ordered():
    found = [composed("method=etgs", f"preset={preset}", "data.size=tiny") for preset in PRESETS]
    for name in ("max_steps", "cap_max"):
        values = [config[name] for config in found]
        assert values == sorted(values) and len(set(values)) == len(PRESETS)


@pytest.mark.parametrize(("steps", "multiple"), [(60, 3), (2000, 3), (4000, 4.8), (5000, 6), (30000, 6)])
def test_longer_runs_grow_more_gaussians(steps, multiple):
    assert compose([f"max_steps={steps}", "method=3dgs"])["density"]["multiple"] == pytest.approx(multiple)


def test_a_multiple_that_is_given_stays():
    assert compose(["max_steps=60", "method=3dgs", "density.multiple=2"])["density"]["multiple"] == 2


def test_what_is_given_beside_a_preset_wins():
    config = compose(["preset=fast", "max_steps=70", "cap_max=7", "optim.decay=0.5", "density=proximity"])
    assert (config["max_steps"], config["density"]["cap_max"], config["optim"]["decay"]) == (70, 7, 0.5)
    assert config["density"]["stop"] == 35 and density_of(config) == "Proximity"
    for rule in ("adaptive", "budget", "co_support", "multiview_gate", "proximity"):
        options = yaml.safe_load((Path(CONF) / "density" / f"{rule}.yaml").read_text())
        assert options.get("cap_max", "${cap_max}") == "${cap_max}", rule
    assert compose(["cap_max=7", "density=mcmc"])["density"]["cap_max"] == 7
    assert compose(["preset=fast", "density=fixed"])["density"] == {"_target_": "heatsplat.density.fixed.Fixed"}
    assert compose(["preset=fast", "debug=fast"])["max_steps"] == 60


def test_a_preset_chooses_among_groups_only_where_the_method_does_not(tmp_path):
    """A preset of another density control: methods that need one of their own keep it, the command line overrules both."""
    (tmp_path / "preset").mkdir()
    (tmp_path / "preset" / "other.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /density: fixed\nmax_steps: 11\n"
    )
    found = f"hydra.searchpath=[file://{tmp_path}]"

    def chosen(*overrides: str) -> str:
        config = compose(["preset=other", found, *overrides])
        assert config["max_steps"] == 11
        return density_of(config)

    assert chosen("method=etgs") == "Fixed"
    assert {method: chosen(f"method={method}") for method in ("ravigs", "mftg")}.items() <= OWN.items()
    assert chosen("method=ravigs", "density=fixed") == "Fixed" and chosen("density=proximity") == "Proximity"


@pytest.mark.parametrize("other", ["preset=fast", "recipe=published"])
def test_a_budget_beside_a_preset_or_a_recipe_is_refused(other):
    """Both choose the steps."""
    with pytest.raises(SceneError, match=rf"budget and {other.partition('=')[0]} both choose .* leave out one of them"):
        checked(compose([other, "budget=60s"]))


@pytest.mark.parametrize("method", [*PUBLISHED, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE)])
def test_methods_train_with_the_papers_settings_and_grow_without_a_limit(method, tmp_path):
    """Refinements come early, so that each kind of density control meets its cap, which is infinity or 360,000."""
    assert RECIPES == ["published"]
    module, trainer = run(
        tmp_path,
        f"method={method}",
        "recipe=published",
        *BARE,
        "density.start=0",
        "density.every=2",
        "trainer.max_steps=4",
    )
    assert trainer.global_step == 4 and module.density.cap_max >= 360_000
    assert module.schedule.end == module.config["max_steps"] >= 5000  # and not of the four that are trained


def test_harmonics_join_within_a_shortened_run_and_where_3dgs_adds_them_in_a_whole_one(tmp_path):
    """In a short run, degrees that joined after a fixed number of steps would all stay zero."""
    whole = compose(["method=3dgs", "recipe=published"])["thermal"]
    assert (whole["sh_degree"], whole["sh_degree_interval"]) == (3, 1000)
    module, _ = run(tmp_path, "method=3dgs", "recipe=published", *BARE, "max_steps=30")
    assert (module.splats["sh_rest"].abs().amax((0, 2)) > 0).all()  # every coefficient of all three degrees


@pytest.mark.parametrize(("method", "preset"), [turn for turn in TURNS if turn[0] != "auto"])
def test_every_method_trains_with_a_preset(method, preset):
    """First steps of the preset's own schedule, without a trainer; presets take turns."""
    config = checked(composed(f"method={method}", f"preset={preset}", "data.size=tiny"))
    stepper = Stepper(build(config["module"]), build(config["data"]).scene, step=0, device="cpu")
    module = stepper.module
    for step in range(3):
        module.trainer.global_step = step
        stepper.step(module.scene.train[step])
    trained = [parameter for parameter in module.parameters() if parameter.grad is not None]
    assert trained and all(parameter.isfinite().all() for parameter in module.parameters())
    assert module.schedule.end == composed("method=etgs", f"preset={preset}", "data.size=tiny")["max_steps"]


def test_the_parts_that_a_scene_calls_for_train_with_a_preset(tmp_path):
    """A whole run: its parts are chosen as it begins."""
    module, trainer = run(tmp_path, "method=auto", "preset=balanced", *BARE, "trainer.max_steps=3")
    assert trainer.global_step == 3
    assert module.schedule.end == composed("method=etgs", "preset=balanced", "data.size=tiny")["max_steps"]


@pytest.mark.parametrize("method", ["3dgs", "msmg", "ravigs", "mftg"])
def test_growth_under_a_preset_stays_within_its_cap(method, tmp_path):
    """Each kind of density control, made short: Gaussians come, and never more than the cap."""
    growing = ["density.grad_threshold=1e-7"] if method in OWN else ["density.least_pixels=0"]
    module, _ = run(
        tmp_path, f"method={method}", "preset=draft", *BARE, "max_steps=40", "cap_max=600", "density.every=4", *growing
    )
    assert 550 < len(module.splats) <= 600 and density_of(module.config) == OWN.get(method, "Budget")
