"""From verdicts to configuration: what is on is in it with its settings, what is off is not."""

from dataclasses import replace
from functools import cache

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from running import compose_run

from heatsplat.composition import build
from heatsplat.contracts import SceneError, ViewSet
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.runs.prices import Price

EFFECTS = {effect.name: effect for effect in CATALOGUE}


def simulated_by(slot):
    return [effect.name for effect in CATALOGUE if effect.part.slot == slot]


ON_THE_WAY, SENSOR = simulated_by("path"), simulated_by("camera")


@cache
def config(*overrides):
    return OmegaConf.to_container(compose_run("data.size=tiny", *overrides), resolve=True)


def verdicts(*on, **settings):
    """Verdicts with these effects on; settings by name of effect."""
    return {
        name: Verdict(name, name in on, 3.0 if name in on else 0.5, 1.0, "as measured", settings.get(name, {}))
        for name in assembly.NAMES
    }


def assembled(*on, **settings):
    return assembly.assemble(verdicts(*on, **settings), config("method=auto")["effects"])


def test_nothing_on_is_3dgs_seen_by_a_perfect_camera():
    found = assembled()
    assert found["thermal"]["state"] == config("method=3dgs")["thermal"] and found["loss"] == {}
    assert found["thermal"]["parts"] == {} and found["thermal"]["companion"] is None and found["sensor"]["parts"] == {}


@pytest.mark.parametrize(
    "on, state, expected",
    [
        (["relaxation"], "NewtonHarmonic", {"frequencies": 0}),
        (["relaxation", "harmonic_source"], "NewtonHarmonic", {"frequencies": None}),  # the class's own
        (["relaxation", "solar"], "EnergyBalance", {"sun": True, "sky": None, "wind": False}),
        (["relaxation", "radiation", "convection"], "EnergyBalance", {"sun": False, "sky": "auto", "wind": True}),
    ],
)
def test_each_selection_has_its_state(on, state, expected):
    found = assembled(*on)["thermal"]["state"]
    assert found["_target_"].endswith(f".{state}") and {key: found.get(key) for key in expected} == expected


def test_a_state_is_open_ended_where_parts_follow_and_only_there():
    assert assembled("relaxation")["thermal"]["state"]["clip"] == "straight_through"
    assert assembled("relaxation", "reflection")["thermal"]["state"]["clip"] == "none"
    assert assembled("attenuation")["thermal"]["state"]["floor"] is False


def test_conduction_wraps_the_state():
    found = assembled("relaxation", "conduction")["thermal"]["state"]
    assert found["_target_"].endswith(".Conducting")
    assert found["state"] == assembled("relaxation")["thermal"]["state"]


@pytest.mark.parametrize("name", ON_THE_WAY)
def test_a_part_stands_in_the_configuration_exactly_when_its_effect_is_on(name):
    everything = assembled(*assembly.NAMES)["thermal"]["parts"]
    assert list(everything) == [
        "directional_emissivity",
        "view_dependence",
        "reflection",
        "mirrored_sky",
        "attenuation",
    ]
    assert list(assembled(name)["thermal"]["parts"]) == [name]


def test_light_meets_the_camera_in_order_and_pattern_and_falloff_are_two_effects_of_one_part():
    assert list(assembled(*assembly.NAMES)["sensor"]["parts"]) == [
        "point_spread",
        "thermal_lag",
        "rolling_readout",
        "calibration",
        "frame_offset",
        "agc",
        "tone",
    ]
    pattern, falloff = (assembled(name)["sensor"]["parts"]["calibration"] for name in ("fixed_pattern", "vignetting"))
    assert pattern["vignetting_max"] == 0 < pattern["gain_max"] and pattern["bias_max"] > 0
    assert falloff["vignetting_max"] > 0 == falloff["gain_max"] == falloff["bias_max"]


def test_thermal_opacity_brings_the_colour_image_and_its_loss():
    found = assembled("thermal_opacity")
    assert found["thermal"]["companion"]["modality"] == "rgb" and set(found["loss"]) == {"rgb"}


def test_what_evidence_found_is_where_parts_start():
    found = assembled("relaxation", "harmonic_source", harmonic_source={"frequencies": 7})
    assert found["thermal"]["state"]["frequencies"] == 7
    with pytest.raises(SceneError, match="the evidence on attenuation sets 'colour'"):
        assembled("attenuation", attenuation={"colour": 1})


def test_the_evidence_or_the_user_says_whether_points_share_the_course_of_a_source():
    both = {"source": "common", "frequencies": 7, "course": [0.0, 1.0, 0.5]}
    common = assembled("relaxation", "harmonic_source", harmonic_source=both)["thermal"]["state"]
    assert common["_target_"].endswith(".CommonSource") and common["course"] == [0.0, 1.0, 0.5]
    assert "frequencies" not in common
    apart = assembled("relaxation", "harmonic_source", harmonic_source=both | {"source": "harmonics"})["thermal"][
        "state"
    ]
    assert apart["_target_"].endswith(".NewtonHarmonic") and apart["frequencies"] == 7 and "course" not in apart
    on = verdicts("relaxation", "harmonic_source", harmonic_source=both)
    asked = assembly.assemble(on, config("method=auto", "effects.source=harmonics")["effects"])
    assert asked["thermal"]["state"] == apart
    without = assembled("relaxation", harmonic_source=both)["thermal"]["state"]
    assert without["_target_"].endswith(".NewtonHarmonic") and without["frequencies"] == 0
    with pytest.raises(SceneError, match="effects.source must be one of scene, harmonics, common, got 'lamp'"):
        assembly.assemble(on, config("method=auto", "effects.source=lamp")["effects"])


def test_what_is_set_by_hand_wins_over_the_evidence():
    by_hand = config(
        "method=auto", "effects.parts.attenuation.moments=8", "effects.states.newton_harmonic.frequencies=5"
    )
    on = verdicts(
        "relaxation",
        "harmonic_source",
        "attenuation",
        attenuation={"depth": 0.3, "moments": 0},
        harmonic_source={"frequencies": 7},
    )
    thermal = assembly.assemble(on, by_hand["effects"])["thermal"]
    assert thermal["parts"]["attenuation"]["moments"] == 8 and thermal["parts"]["attenuation"]["depth"] == 0.3
    assert thermal["state"]["frequencies"] == 5


@pytest.mark.parametrize("paper", ["etgs", "supirgs", "ravigs", "ti3dgs", "thermogs"])
def test_a_papers_effects_are_a_selection(paper):
    """The selection simulates what the method reports of itself; grey-body emission of RaViGS is a law of emission."""
    from heatsplat.datamodules.synthetic import Synthetic

    method = config(f"method={paper}", "max_steps=10")
    thermal, sensor = build(method["thermal"]), build(method["sensor"])
    if paper in ("etgs", "thermogs"):
        thermal.prepare(Synthetic(scene=method["synthetic_preset"], size="tiny").scene)
    own = set(thermal.effects()) | set(sensor.effects())
    given = assembly.explicit_choices(config("method=auto", f"effects={paper}")["effects"])
    assert set(given.values()) == {"on"} and set(given) == own - ({"radiation"} if paper == "ravigs" else set())


def test_the_selection_of_etgs_is_etgs():
    chosen = config("method=auto", "effects=etgs")
    on = verdicts(*assembly.explicit_choices(chosen["effects"]), harmonic_source={"frequencies": 6})
    found = assembly.assemble(on, chosen["effects"])
    assert found["thermal"]["state"] == config("method=etgs")["thermal"]
    assert found["thermal"]["parts"] == found["sensor"]["parts"] == found["loss"] == {}


def test_the_selection_of_supirgs_has_its_camera():
    chosen = config("method=auto", "effects=supirgs")
    found = assembly.assemble(verdicts(*assembly.explicit_choices(chosen["effects"])), chosen["effects"])
    own = config("method=supirgs")["sensor"]["parts"]
    assert found["sensor"]["parts"] == {name: part for name, part in own.items() if part is not None}


def test_every_selection_of_one_effect_can_be_built():
    for name in assembly.NAMES:
        found = assembled(*{name, EFFECTS[name].stands_on or name})
        thermal, sensor = build(found["thermal"]), build(found["sensor"])
        assert thermal.modality == "thermal" and len(sensor.parts) == (name in SENSOR)
        simulated = set(sensor.effects())
        assert simulated == ({name} if name in SENSOR else set())


def test_every_part_tells_its_effect_under_the_name_of_the_catalogue():
    outdoors = {"semi_infinite", "solar", "radiation", "convection", "shadows", "sky_view", "albedo"}
    thermal = build(assembled(*set(assembly.NAMES) - outdoors)["thermal"])
    assert set(thermal.effects()) <= set(assembly.NAMES)
    assert {"relaxation", "conduction", *ON_THE_WAY, "thermal_opacity"} <= set(thermal.effects())


# Verdicts that fit together -------------------------------------------------------------------------------


def names_on(found):
    return {name for name, verdict in found.items() if verdict.on}


def test_what_acts_on_a_changing_temperature_brings_relaxation():
    found = assembly.reconcile(verdicts("harmonic_source"))
    assert names_on(found) == {"relaxation", "harmonic_source"}
    assert found["relaxation"].reason == "harmonic_source stands on it"


def test_recorded_weather_takes_the_place_of_harmonics():
    both = verdicts("relaxation", "harmonic_source", "solar")
    assert names_on(assembly.reconcile(both)) == {"relaxation", "solar"}
    assert names_on(assembly.reconcile(both, {"harmonic_source": "on"})) == {"relaxation", "harmonic_source"}
    with pytest.raises(SceneError, match="effects.harmonic_source=on is not possible: the recorded weather drives"):
        assembly.reconcile(both, {"harmonic_source": "on", "solar": "on"})


def test_relaxation_that_is_switched_off_takes_along_what_stands_on_it():
    found = assembly.reconcile(verdicts("harmonic_source", "agc"), {"relaxation": "off"})
    assert names_on(found) == {"agc"} and found["harmonic_source"].reason == "it stands on relaxation, which is off"
    with pytest.raises(SceneError, match="effects.relaxation=off is not possible: harmonic_source stands on it"):
        assembly.reconcile(verdicts("harmonic_source"), {"relaxation": "off", "harmonic_source": "on"})


def test_what_the_scene_cannot_give_is_refused_where_it_was_asked_for():
    with pytest.raises(SceneError, match="effects.solar=on is not possible: as measured"):
        assembly.reconcile(verdicts(), {"solar": "on"})


def test_an_opacity_for_each_image_needs_two_images():
    from heatsplat.datamodules.synthetic import Synthetic

    scene = Synthetic(scene="static", size="tiny").scene
    assert assembly.drop_impossible(verdicts("thermal_opacity", "agc"), scene) == verdicts("thermal_opacity", "agc")
    thermal = ViewSet(scene.train.frames, lambda i: replace(scene.train[i], rgb=None))
    found = assembly.drop_impossible(verdicts("thermal_opacity", "agc"), replace(scene, train=thermal))
    assert names_on(found) == {"agc"} and "has no visible image" in found["thermal_opacity"].reason


def test_leaving_an_effect_out_leaves_out_what_stands_on_it():
    full = verdicts("relaxation", "harmonic_source", "agc")
    assert names_on(assembly.without(full, "relaxation")) == {"agc"}
    assert names_on(assembly.without(full, "harmonic_source")) == {"relaxation", "agc"}
    yard = verdicts("relaxation", "solar", "radiation", "convection", "shadows", "sky_view", "albedo")
    assert names_on(assembly.without(yard, "relaxation")) == set()
    for name in names_on(yard):  # what is measured of each effect's cost
        build(assembly.assemble(assembly.without(yard, name), config("method=auto")["effects"])["thermal"])


def test_what_stands_on_others_brings_all_of_them_or_goes_with_them():
    shaded = verdicts("shadows")
    assert names_on(assembly.reconcile(shaded)) == {"shadows", "solar", "relaxation"}
    assert names_on(assembly.reconcile(verdicts("shadows", "solar", "agc"), {"relaxation": "off"})) == {"agc"}
    with pytest.raises(SceneError, match="effects.relaxation=off is not possible: solar stands on it"):
        assembly.reconcile(verdicts("shadows", "solar"), {"relaxation": "off", "shadows": "on"})


def test_the_log_tells_verdict_statistic_price_and_reason():
    known = verdicts("agc")
    known["agc"], known["tone"] = replace(known["agc"], gain_db=2.34), replace(known["tone"], told=False)
    told = assembly.verdicts_as_dicts(known, {"agc": Price(2, 10, 0.256)})
    head, *rows = assembly.verdict_table(told)
    assert head.split() == ["effect", "statistic", "dB", "ms/step", "numbers", "reason"] and len(rows) == len(
        assembly.NAMES
    )
    of = {row.split()[0]: row.split() for row in rows}
    assert of["agc"] == ["agc", "on", "3", ">", "1", "+2.3", "+0.26", "+2", "N", "+10", "as", "measured"]
    assert of["tone"] == ["tone", "?", "0.5", "≤", "1", "as", "measured"]


def test_what_a_rule_decides_is_told_whatever_images_tell():
    """The report says "cannot be told" of what images leave open, with what would tell; here more images would tell nothing."""
    unsure = {name: replace(one, told=False, gain_db=0.1) for name, one in verdicts("harmonic_source", "solar").items()}
    found = assembly.reconcile(unsure)
    off, ground = found["harmonic_source"], found["relaxation"]
    assert not off.on and off.told and off.reason == "the recorded weather drives the scene"
    assert ground.on and ground.told and ground.reason == "solar stands on it"
    assert found["solar"].on and not found["solar"].told
    dear = assembly.affordable(found, {"solar": Price(1, 0, 4.0)}, 1.0)["solar"]
    assert not dear.on and dear.told and "4.00 ms" in dear.reason


def test_an_effect_that_costs_more_than_it_brings_is_left_out_when_that_is_asked():
    known = {name: replace(one, gain_db=1.0) for name, one in verdicts("relaxation", "conduction", "agc").items()}
    prices = {"relaxation": Price(2, 0, 4.0), "conduction": Price(0, 1, 0.1), "agc": Price(0, 9, -0.01)}
    of = {least: assembly.affordable(known, prices, least) for least in (0.0, 0.2, 0.5)}
    assert of[0.0] == of[0.2] == known
    assert {name for name, one in of[0.5].items() if one.on} == {"agc"}  # conduction stands on relaxation
    assert "1.0 dB for 4.00 ms a step" in of[0.5]["relaxation"].reason
    assert of[0.5]["conduction"].reason == "it stands on relaxation, which is off"
    assert of[0.5]["solar"] == known["solar"]  # stands on it too, and was off anyhow
    lost = {name: replace(one, gain_db=-0.2) for name, one in known.items()}  # on, though images cannot tell
    assert assembly.affordable(lost, prices, 0.0) == lost


def test_what_was_asked_for_keeps_what_it_stands_on_whatever_that_costs():
    known = verdicts("relaxation", "conduction", "agc")
    known |= {name: replace(known[name], gain_db=1.0) for name in ("relaxation", "agc")}
    prices = {"relaxation": Price(2, 0, 4.0), "conduction": Price(0, 1, 0.1), "agc": Price(0, 9, 4.0)}
    found = assembly.affordable(known, prices, 0.5, {"conduction": "on", "agc": "auto"})
    assert names_on(found) == {"relaxation", "conduction"}
    assert names_on(assembly.affordable(known, prices, 0.5, {"conduction": "auto"})) == set()


# Choices ---------------------------------------------------------------------------------------------------


def test_selections_and_single_choices():
    assert set(assembly.choices(config("method=auto")["effects"]).values()) == {"auto"}
    assert set(assembly.choices(config("method=auto", "effects=none")["effects"]).values()) == {"off"}
    one = assembly.choices(config("method=auto", "effects=all", "effects.agc=off", "effects.tone=auto")["effects"])
    assert one == dict.fromkeys(assembly.NAMES, "on") | {"agc": "off", "tone": "auto", "semi_infinite": "auto"}
    yaml_words = {"solar": True, "agc": False}  # what YAML makes of on and off
    assert assembly.explicit_choices(yaml_words) == {"solar": "on", "agc": "off"}


@pytest.mark.parametrize(
    "given, why",
    [
        (["effects.least_db_per_ms=0.5", "effects.price=false"], "effects.price=false does not measure"),
        (["effects.least_db_per_ms=-1"], "must be 0 or more, got -1"),
        (["effects.least_db_per_ms=much"], "must be a number, got much"),
    ],
)
def test_a_least_gain_that_nobody_can_ask_for_is_refused(given, why):
    with pytest.raises(SceneError, match=f"effects.least_db_per_ms.*{why}"):
        assembly.least_db_per_ms(config("method=auto", *given)["effects"])


def test_a_least_gain_is_zero_unless_one_is_asked_for():
    assert assembly.least_db_per_ms(config("method=auto", "effects.price=false")["effects"]) == 0
    assert assembly.least_db_per_ms(config("method=auto", "effects.least_db_per_ms=2")["effects"]) == 2


def test_choices_that_cannot_be_are_refused():
    with pytest.raises(SceneError, match="effects.agc must be one of on, off, auto, got 'maybe'"):
        assembly.choices(config("method=auto", "effects.agc=maybe")["effects"])
    with pytest.raises(SceneError, match="effects=all chooses the parts of method=auto, but method=etgs has its own"):
        assembly.chooses_effects(config("method=etgs", "effects=all") | {"name": "etgs"})
    with pytest.raises(
        SceneError, match="effects.harmonic_source=off is asked for.*effects=etgs effects.harmonic_source=off"
    ):
        assembly.chooses_effects(config("method=etgs", "effects.harmonic_source=off") | {"name": "etgs"})
    with pytest.raises(SceneError, match="effects=method leaves method=auto without effects"):
        assembly.chooses_effects(config("method=auto", "effects=method") | {"name": "auto"})
    with pytest.raises(HydraException, match="sunshine"):
        config("method=auto", "effects.sunshine=on")
    assert not assembly.chooses_effects(config("method=etgs") | {"name": "etgs"})
    assert assembly.chooses_effects(config("method=auto") | {"name": "auto"})


def test_the_effects_of_a_run_are_those_of_the_catalogue():
    assert {effect.name for effect in CATALOGUE} == set(assembly.NAMES)
