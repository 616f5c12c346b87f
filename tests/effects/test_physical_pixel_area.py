"""Finer views than were recorded: sizes tell, and the run renders as fine and compares averages."""

from dataclasses import replace
from functools import cache

import pytest
from omegaconf import OmegaConf
from running import compose_run

from heatsplat.composition import build
from heatsplat.effects import assembly
from heatsplat.effects.catalogue import decide
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.pixel_area import EFFECT, fineness, missing


@cache
def config(*overrides):
    return OmegaConf.to_container(compose_run("data.size=tiny", *overrides), resolve=True)


@cache
def scene(*overrides):
    return build(config("method=auto", "data.scene=static", *overrides)["data"]).scene


def test_sizes_of_images_tell():
    plain, coarse = scene(), scene("data.degrade=area2")
    assert (fineness(plain), fineness(coarse)) == (1, 2)
    assert not EFFECT.evidence(Inspection(plain)).statistic > EFFECT.threshold
    found = EFFECT.evidence(Inspection(coarse))
    assert found.statistic > EFFECT.threshold and found.settings == {"factor": 2} and "2 x 2 pixels" in found.reason
    assert missing(coarse) is None and "finer" in missing(plain)


def test_validation_views_count_where_there_are_no_test_views_and_sizes_that_do_not_fit_tell_nothing():
    coarse, plain = scene("data.degrade=area2"), scene()
    none = plain.test.subset([])
    assert fineness(replace(coarse, test=none, val=plain.test)) == 2
    assert fineness(replace(coarse, test=none, val=none)) is None
    assert fineness(replace(plain, train=coarse.test, test=coarse.train)) is None  # coarser ones are asked for
    mixed = replace(coarse, test=replace_first(plain.test, coarse.train))
    assert fineness(mixed) is None and EFFECT.evidence(Inspection(mixed)).statistic is None


def replace_first(views, others):
    from heatsplat.contracts import ViewSet

    return ViewSet([others.frames[0], *views.frames[1:]], lambda i: views[i])


def filled(scene):
    verdicts = assembly.drop_impossible(
        decide(scene, dict.fromkeys(assembly.NAMES, "off") | {"pixel_area": "auto"}), scene
    )
    plain = config("method=auto")
    return assembly.filled(
        plain, assembly.assemble(verdicts, plain["effects"]), assembly.verdicts_as_dicts(verdicts, {})
    )


def test_a_run_renders_as_fine_as_is_asked_and_compares_averages_over_pixels():
    found, plain = filled(scene("data.degrade=area2")), filled(scene())
    term = found["module"]["loss"]["terms"]["photometric"]
    assert found["module"]["supersample"] == 2 and found["effects"]["pixel_area"]
    assert (
        term["_target_"].endswith("OnTargetGrid")
        and term["term"] == config("method=auto")["loss"]["terms"]["photometric"]
    )
    assert build(term).kernel == "area"
    assert "supersample" not in plain["module"] and plain["loss"] == config("method=auto")["loss"]


def test_what_cannot_be_had_is_refused_by_name():
    on = decide(scene(), {"pixel_area": "on"})
    dropped = assembly.drop_impossible(on, scene())
    with pytest.raises(
        ValueError, match=r"effects\.pixel_area=on is not possible: no views are asked for that are finer"
    ):
        assembly.reconcile(dropped, {"pixel_area": "on"})
