"""ThermoGS: what the network gives before and after training, its bounds, its balance, its toggles, what it refuses."""

import logging
import math
from dataclasses import replace

import pytest
import torch
from weathered import CAMERA, HOUR_S, make_scene, make_weather

from heatsplat.contracts import SceneError
from heatsplat.density.ops import Cloud
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.physics.ellipsoids import convecting_area_ratio, projected_area_ratio, radiating_area_ratio
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.energy_network import LIMITS, EnergyNetwork
from heatsplat.thermal.land_cover import ATTRIBUTES, TABLE, typical
from heatsplat.thermal.network_options import TERMS
from heatsplat.thermal.weather_drive import columns_at, remembered, source_of_sunlight, sunlight_at

ALL = {"smooth": 1.0, "physical": 0.01, "ode": 0.01, "pinn": 1.0}


def make(scene=None, count=40, disturb=0.0, **options):
    """A model on a scene with its splats; ``disturb`` gives the heads random weights of that size."""
    model = EnergyNetwork(**{"width": 16, "weights": ALL} | options)
    scene = scene or make_scene()
    model.check(scene)
    model.prepare(scene)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 4.0, 1.0])
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    geometry = {
        "means": means,
        "log_scales": torch.randn(count, 3, generator=generator) * 0.5 - 2.0,
        "quats": torch.randn(count, 4, generator=generator),
        "opacity_logits": torch.zeros(count, 1),
    }
    splats = Splats({name: item.initial for name, item in declared.items()} | geometry)
    if disturb:
        with torch.no_grad():
            for head in model.network.heads.values():
                head.weight.normal_(0.0, disturb, generator=torch.Generator().manual_seed(3))
    return model, splats


def query(time_s=HOUR_S, ids=None):
    return Query(ids=ids, camera=CAMERA, time_s=time_s)


def penalties(model, splats, step=0, time_s=HOUR_S, ids=None):
    model.on_step(step)
    model.features(splats, query(time_s, ids))
    return model.regularisers(splats)


# What comes out ---------------------------------------------------------------------------------------


def test_before_training_all_are_as_warm_as_the_images_and_of_typical_materials():
    model, splats = make()
    emitted = model.features(splats, query())
    assert emitted.shape == (40, 1)
    torch.testing.assert_close(emitted, splats["first_value"].mean().expand(40, 1))
    told = model.attributes(splats, query())
    assert list(told) == list(ATTRIBUTES)
    for name, start in zip(ATTRIBUTES, typical().tolist(), strict=True):
        torch.testing.assert_close(told[name], torch.full((40,), start))
    assert all(term.isfinite() and term >= 0 for term in penalties(model, splats).values())


def test_labels_alone_serve_in_double_precision_too():
    model, splats = make(features="labels", position_frequencies=0)
    single = model.features(splats, query())
    double = model.double().features(splats.to(torch.float64), query())
    assert double.dtype == torch.float64 and torch.allclose(double.float(), single, atol=1e-5)


@pytest.mark.parametrize("options", [{}, {"features": "labels"}, {"features": "none"}, {"attributes": "table"}])
def test_only_what_is_in_view_is_evaluated_and_it_is_the_same(options):
    model, splats = make(disturb=1.0, **options)
    ids = torch.tensor([3, 30, 17])
    everything = model.features(splats, query())
    torch.testing.assert_close(model.features(splats, query(ids=ids)), everything[ids])
    for name, values in model.attributes(splats, query()).items():
        torch.testing.assert_close(model.attributes(splats, query(ids=ids))[name], values[ids])


def test_no_head_leaves_its_bounds_and_no_gradient_is_lost_whatever_the_network_says():
    model, splats = make(disturb=1e4)
    celsius = model.temperature(splats, HOUR_S) - KELVIN_AT_0_C
    assert celsius.min() >= -5.001 and celsius.max() <= 55.001  # 0 to 50 °C and a tenth of it on either side
    for name, values in model.attributes(splats, query()).items():
        assert values.min() >= LIMITS[name][0] and values.max() <= LIMITS[name][1]
    sum(penalties(model, splats).values()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert splats["feature"].grad.isfinite().all()


@pytest.mark.parametrize("attributes", ["inferred", "constant"])
def test_materials_change_with_the_feature_of_a_gaussian(attributes):
    model, splats = make(disturb=0.3, attributes=attributes)
    for name, values in model.attributes(splats, query()).items():
        (slopes,) = torch.autograd.grad(values.sum(), [splats["feature"]], retain_graph=True)
        assert (slopes != 0).any(1).all(), name


def test_kelvin_and_image_values_are_the_same_temperature():
    model, splats = make(disturb=0.5)
    image = model.features(splats, query())[:, 0]
    torch.testing.assert_close(model.temperature(splats, HOUR_S), 0.0 + 50.0 * image + KELVIN_AT_0_C)


@pytest.mark.parametrize("time", ["record", "day", "none"])
def test_temperature_follows_the_time_of_the_question(time):
    """The weather of the record counts, not that of the frame, which may have been asked at another time."""
    model, splats = make(disturb=1.0, time=time)
    morning, evening = (model.features(splats, query(hours * HOUR_S)) for hours in (1, 9))
    assert (morning - evening).abs().max() > 1e-3
    tomorrow = make_weather()
    model.weather = replace(tomorrow, times_s=tomorrow.times_s + 24 * HOUR_S)  # the same weather a day later
    again = model.features(splats, query(25 * HOUR_S))
    assert ((again - morning).abs().max() < 1e-4) == (time != "record")


def test_hours_come_again_where_the_weather_goes_on_for_more_than_a_day():
    scene = make_scene()
    weather = scene.weather
    span = float(weather.times_s[-1] - weather.times_s[0])
    for days, time in ((0.9, "record"), (2.0, "day")):
        start, stretch = weather.times_s[0], days * 24 * HOUR_S / span
        longer = replace(scene, weather=replace(weather, times_s=start + stretch * (weather.times_s - start)))
        model, _ = make(longer)
        assert model.effects()["relaxation"]["time"] == time
    clock = [
        model._moment(moment)[-2 * model.options.time_frequencies :] for moment in (HOUR_S, 25 * HOUR_S, 13 * HOUR_S)
    ]
    torch.testing.assert_close(clock[0], clock[1])
    assert not torch.allclose(clock[0], clock[2], atol=0.1)


def test_the_network_sees_octaves_that_images_tell():
    """Of ten images in nine hours there are four or more to a cycle of 18, 9 and 4.5 hours, or of 24, 12 and 6."""
    scene = make_scene(times=[hour * HOUR_S for hour in range(10)])
    for options, seen in (({"time": "record"}, 3), ({"time": "day"}, 3), ({"frames_per_cycle": None}, 10)):
        model, _ = make(scene, **options)
        code = model._moment(1.3 * HOUR_S)[-2 * model.options.time_frequencies :].unflatten(0, (2, -1))
        assert int(code.ne(0).any(0).sum()) == seen


@pytest.mark.parametrize(("collocation", "later"), [("record", 18 * HOUR_S), ("view", 18 * HOUR_S)])
def test_no_two_moments_that_penalties_ask_for_have_the_same_time(collocation, later):
    """The code of time repeats after two records of the images, which are of nine hours, and the weather is of 22."""
    model, _ = make(time="record", collocation=collocation, frames_per_cycle=None)
    model.train()
    code, again = (model._moment(moment)[5:] for moment in (HOUR_S, HOUR_S + later))
    assert torch.equal(code, again) == (collocation == "view")  # which asks for nothing that late
    assert not torch.equal(model._moment(9 * HOUR_S + 600)[5:], model._moment(9 * HOUR_S)[5:])


def test_beyond_the_record_the_clock_stays_and_the_weather_goes_on():
    model, _ = make()
    last, later = 9 * HOUR_S, 15 * HOUR_S
    weather, clock = (model.eval()._moment(later) - model._moment(last)).split([5, 2 * model.options.time_frequencies])
    assert weather.abs().max() > 0.1 and torch.equal(clock, torch.zeros_like(clock))
    # Intervals of penalties end minutes after the last image, where the balance holds as well.
    assert not torch.equal(model.train()._moment(last + 600)[5:], model._moment(last)[5:])


# Stages and density control ---------------------------------------------------------------------------


def test_the_first_stage_shows_one_value_and_leaves_the_network_alone():
    model, splats = make(first_steps=10)
    model.on_step(9)
    emitted = model.features(splats, query())
    assert torch.equal(emitted[:, 0], splats["first_value"])
    assert model.attributes(splats, query()) == {} and model.regularisers(splats) == {}
    emitted.sum().backward()
    assert all(parameter.grad is None for parameter in model.parameters())
    model.on_step(10)
    model.features(splats, query()).sum().backward()
    assert model.network.heads["temperature"].bias.grad != 0
    model.on_step(9)
    state = {name: value.clone() for name, value in model.state_dict().items()}
    other, _ = make(first_steps=10)
    other.load_state_dict(state)  # a checkpoint of the first stage shows the first stage
    assert torch.equal(other.features(splats, query())[:, 0], splats["first_value"])


def test_classes_and_features_go_with_their_gaussian():
    model, splats = make()
    scene = make_scene()
    nearest = torch.cdist(splats.means, scene.points).argmin(1)
    assert torch.equal(splats["label"].long(), scene.labels[nearest])
    groups = [{"params": [splats[name]], "name": name, "lr": 0.1} for name in splats.names]
    cloud = Cloud(splats, torch.optim.Adam(groups))
    labels, features = splats["label"].detach().clone(), splats["feature"].detach().clone()
    cloud.append(cloud.rows(torch.tensor([5, 7])))
    keep = torch.ones(42, dtype=torch.bool)
    keep[:3] = False
    cloud.keep(keep)
    assert torch.equal(splats["label"].detach(), torch.cat((labels, labels[[5, 7]]))[3:])
    assert torch.equal(splats["feature"].detach(), torch.cat((features, features[[5, 7]]))[3:])
    assert model.features(splats, query()).shape == (39, 1)


def test_classes_and_given_features_do_not_learn():
    scene = make_scene()
    scene = replace(scene, point_features=torch.randn(60, 3, generator=torch.Generator().manual_seed(1)) * 5 + 2)
    model, splats = make(scene, features="given", feature_size=3)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(40, 3, generator=generator) * torch.tensor([4.0, 4.0, 1.0])
    declared = model.per_gaussian(Seeds(means, torch.rand(40, 1, generator=generator), generator))
    assert declared["label"].lr == declared["feature"].lr == 0.0
    nearest = torch.cdist(splats.means, scene.points).argmin(1)
    assert torch.equal(splats["feature"].detach(), scene.point_features[nearest])
    assert model.feature_mean.tolist() == pytest.approx(scene.point_features.mean(0).tolist())


# The balance ------------------------------------------------------------------------------------------


def test_the_rate_is_the_balance_of_ellipsoid_sun_and_air():
    """By hand, for the sun and the sky's light at 3 h, with the printed area of convection and a clear sky."""
    model, splats = make(sky="swinbank", disturb=1.0)
    time_s = 3 * HOUR_S
    ids = torch.arange(40)
    units = torch.linspace(0.1, 0.9, 40)
    hidden = model.network(model._base(splats, ids), model._moment(time_s))
    body = model._body(splats, ids, model._base(splats, ids), hidden)
    areas = model.balance.areas(splats, ids, 1.0)
    rate = model._rate(units, body, areas, time_s) * 60.0  # the network's range is 60 K

    axes = splats.scales.double().clamp(min=0.01)
    sun = torch.tensor([math.cos(0.3 * math.pi), 0.0, math.sin(0.3 * math.pi)], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rotations = quats_to_matrices(splats.quats.double())
    lit = 700.0 * projected_area_ratio(axes, torch.einsum("nij,i->nj", rotations, sun))
    lit = lit + 100.0 * math.sin(0.3 * math.pi) * projected_area_ratio(axes, torch.einsum("nij,i->nj", rotations, up))
    air = 15.0 + 5.0 * math.sin(math.pi / 12) + KELVIN_AT_0_C
    kelvin = KELVIN_AT_0_C - 5.0 + 60.0 * units.double()
    body = {name: values.double() for name, values in body.items()}
    radiated = STEFAN_BOLTZMANN * radiating_area_ratio(axes) * (kelvin**4 - (0.0552 * air**1.5) ** 4)
    convected = body["convection"] * convecting_area_ratio(axes, "printed") * (kelvin - air)
    expected = (body["absorptivity"] * lit - body["emissivity"] * radiated - convected) / body["capacity"]
    torch.testing.assert_close(rate.double(), expected, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize(
    ("options", "changes"),
    [({"projected_area": "printed"}, True), ({"surface_area": "consistent"}, True), ({"sky": "swinbank"}, True),
     ({"sky": "brutsaert"}, True),
     ({"smallest_axis_m": 0.3}, True), ({}, False)],
)  # fmt: skip
def test_every_switch_of_the_balance_acts(options, changes):
    (plain, splats), (switched, _) = make(disturb=1.0), make(disturb=1.0, **options)
    terms = penalties(plain, splats), penalties(switched, splats)
    assert (terms[0]["pinn"] != terms[1]["pinn"]) == changes and (terms[0]["ode"] != terms[1]["ode"]) == changes
    assert terms[0]["smooth"] == terms[1]["smooth"] and terms[0]["physical"] == terms[1]["physical"]


def test_night_is_dark_and_light_without_a_sun_comes_from_above():
    weather = make_weather()
    assert sunlight_at(weather, 15 * HOUR_S) == []
    (sun, direct), (up, diffuse) = sunlight_at(weather, 5 * HOUR_S)
    assert sun.tolist() == pytest.approx([0, 0, 1], abs=1e-9) and direct == pytest.approx(700)
    assert up.tolist() == [0, 0, 1] and diffuse == pytest.approx(100)
    sunless = make_weather(sun=None)
    ((above, power),) = sunlight_at(sunless, 2.5 * HOUR_S)
    assert above.tolist() == [0, 0, 1] and power == pytest.approx(800 * math.sin(0.25 * math.pi))
    assert "from above" in source_of_sunlight(sunless)
    dark = make_weather(irradiance_w_m2=None, sun=None)
    assert sunlight_at(dark, 5 * HOUR_S) == [] and "none" in source_of_sunlight(dark)
    model, splats = make(make_scene(weather=dark))
    assert all(term.isfinite() for term in penalties(model, splats).values())


def test_a_body_in_balance_pays_nothing_but_the_table():
    """Still air as warm as the body, no sun, a sky as warm as the air would be: only materials are off."""
    steady = make_weather(irradiance_w_m2=None, sun=None, direct_w_m2=None, diffuse_w_m2=None)
    air_c = 25.0
    steady = replace(steady, air_c=torch.full_like(steady.air_c, air_c))
    model, splats = make(make_scene(weather=steady))
    with torch.no_grad():
        model.network.heads["temperature"].bias.fill_(0.0)  # the middle of -5 to 55 °C
        model.network.heads["attributes"].bias[0] = -40.0  # nothing is radiated
    terms = penalties(model, splats)
    assert terms["smooth"] == 0 and terms["ode"] < 1e-9 and terms["pinn"] < 1e-6
    assert terms["physical"] > 0.001


# Intervals and samples --------------------------------------------------------------------------------


def test_intervals_are_of_one_to_ten_minutes_and_stay_within_the_record():
    model, _ = make()
    lengths = []
    for step in range(500):
        model.on_step(step)
        lengths.append(model._interval(HOUR_S))
        assert -600 <= model._interval(20 * HOUR_S) <= -60  # the record ends there
    assert min(lengths) < 65 and max(lengths) > 595 and sum(lengths) / 500 == pytest.approx(330, abs=3)
    last = float(model.weather.times_s[-1])
    model.weather = replace(model.weather, times_s=model.weather.times_s / last)  # a record of a second
    assert model._interval(0.5) == pytest.approx(-0.6)


def test_every_gaussian_has_its_turn_and_no_step_takes_more_than_it_may():
    model, splats = make(sampled=15, weights={"physical": 0.01})
    taken = torch.zeros(40)
    for step in range(3):
        splats["feature"].grad = None
        model.network.heads["attributes"].weight.data.fill_(0.1)
        penalties(model, splats, step)["physical"].backward()
        pulled = splats["feature"].grad.abs().sum(1) > 0
        assert pulled.sum() <= 15
        taken += pulled
    assert (taken == 1).all()


def test_penalties_grow_to_their_weight():
    model, splats = make(first_steps=10, ramp_steps=4, disturb=0.5)
    ids = torch.arange(40)
    early, full = (penalties(model, splats, step, ids=ids)["physical"].item() for step in (10, 14))
    assert early == pytest.approx(full / 5, rel=1e-5)
    assert penalties(model, splats, 400)["physical"].item() == pytest.approx(full, rel=1e-5)


# Toggles ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("off", TERMS)
def test_a_term_of_weight_zero_is_absent(off, monkeypatch):
    model, splats = make(weights=ALL | {off: 0.0}, disturb=0.5)
    whole, same = make(disturb=0.5)
    terms, all_terms = penalties(model, splats), penalties(whole, same)
    assert list(all_terms) == ["physical", "smooth", "ode", "pinn"] and set(terms) == set(all_terms) - {off}
    assert all(terms[name] == all_terms[name] for name in terms)


def test_without_terms_nothing_is_evaluated_twice(monkeypatch):
    model, splats = make(make_scene(labels=None, metres_per_unit=None), weights={})
    calls = []
    forward = type(model.network).forward
    monkeypatch.setattr(type(model.network), "forward", lambda *args: calls.append(1) or forward(*args))
    assert penalties(model, splats) == {} and len(calls) == 1
    assert "label" not in splats and set(model.effects()) == {"relaxation"}


def test_the_table_in_place_of_heads():
    model, splats = make(attributes="table", disturb=0.5)
    assert "attributes" not in model.network.heads
    told = model.attributes(splats, query())
    for number, name in enumerate(ATTRIBUTES):
        expected = torch.tensor([list(TABLE.values())[int(label)][number] for label in splats["label"]])
        assert torch.equal(told[name], expected) and torch.equal(model.prior(splats)[name], expected)
    assert set(penalties(model, splats)) == {"smooth", "ode", "pinn"}


def test_no_loss_reaches_latent_heat():
    model, splats = make(disturb=0.5)
    (sum(penalties(model, splats).values()) + model.features(splats, query()).sum()).backward()
    assert model.network.heads["latent_heat"].weight.grad is None
    assert model.network.heads["attributes"].weight.grad.abs().min() > 0


def test_cost_and_effects_are_told():
    model, _ = make(width=32, blocks=3)
    assert model.cost == 32 * (60 + 8) + 6 * 32 * 32 + 32 + 60
    effects = model.effects()
    assert set(effects) == {"relaxation", "radiation", "convection", "solar"}
    assert effects["convection"] == {"surface_area": "printed"} and effects["radiation"]["sky"] == "none"


# Weather ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["wind_m_s", "humidity_percent", "irradiance_w_m2", "pressure_hpa"])
def test_a_missing_column_is_left_out_and_said_to_be(column, caplog):
    with caplog.at_level(logging.WARNING):
        model, splats = make(make_scene(weather=make_weather(**{column: None})), disturb=1.0)
    assert column in caplog.text
    assert model.effects()["relaxation"]["left_out"] == [column]
    assert model.features(splats, query()).isfinite().all()
    assert all(term.isfinite() for term in penalties(model, splats).values())


def test_weather_comes_to_the_network_in_its_own_spread():
    model, _ = make()
    weather = make_weather()
    seen = torch.stack([columns_at(weather, t) for t in (0.0, 2 * HOUR_S, 9 * HOUR_S)])
    moments = torch.stack([model._moment(t)[:5] for t in (0.0, 2 * HOUR_S, 9 * HOUR_S)])
    torch.testing.assert_close(moments, ((seen - seen.mean(0)) / seen.std(0, unbiased=False)).float())
    assert seen[1, 1] == pytest.approx(math.log1p(1.0 + math.sin(0.5)), rel=1e-6)


# The network of another run ---------------------------------------------------------------------------


def test_a_network_goes_to_another_scene_with_its_measures(tmp_path):
    options = {"features": "labels", "position_frequencies": 0}
    trained, splats = make(count=150, disturb=1.0, **options)
    weights = {f"thermal.{name}": value for name, value in trained.state_dict().items()}
    torch.save({"state_dict": weights}, tmp_path / "last.ckpt")
    elsewhere = make_scene(80, times=(0.0, HOUR_S), thermal_range=replace(make_scene().thermal_range, max_c=40.0))
    model, others = make(elsewhere, count=160, network=str(tmp_path / "last.ckpt"), first_steps=10, **options)
    assert model.lr == 0.0
    model.on_step(0)
    assert torch.equal(model.features(others, query())[:, 0], others["first_value"])  # its first stage trains
    model.eval()
    for label in range(10):
        here, there = ((who["label"] == label).nonzero()[0] for who in (others, splats))
        torch.testing.assert_close(
            model.temperature(others, HOUR_S)[here], trained.temperature(splats, HOUR_S)[there], rtol=0, atol=1e-3
        )
    with pytest.raises(SceneError, match="is another one .*give the width"):
        make(elsewhere, network=str(tmp_path / "last.ckpt"), features="labels", position_frequencies=4)
    with pytest.raises(SceneError, match="no checkpoint at"):
        make(elsewhere, network=str(tmp_path / "lost.ckpt"), **options)
    assert EnergyNetwork(network="x", fine_tune=True, lr=0.5).lr == 0.5


# Bad input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"weather": None}, "lacks 'weather'.*give the data set a weather record"),
        ({"labels": None}, "lacks 'labels'.*thermal.weights.physical=0"),
        ({"metres_per_unit": None}, "lacks 'metres'.*metres_per_unit, or leave the balance out"),
        ({"labels": torch.zeros(59, dtype=torch.int64)}, r"60 points but labels of shape \[59\]"),
        ({"labels": torch.full((60,), 10)}, "the label 10, which is no land-cover class; there are 0 building, 1 road"),
        ({"weather": make_weather(air_c=None)}, "no air temperature.*add air_c"),
        ({"thermal_range": None}, "thermal_range"),
    ],
)
def test_scenes_that_lack_something_are_refused_with_the_way_out(changed, message):
    with pytest.raises(SceneError, match=message):
        EnergyNetwork(weights=ALL).check(replace(make_scene(), **changed))


def test_a_sky_that_needs_humidity_says_so():
    dry = make_scene(weather=make_weather(humidity_percent=None))
    with pytest.raises(SceneError, match="no humidity, which thermal.sky=brutsaert needs; thermal.sky=swinbank"):
        make(dry, sky="brutsaert")
    assert make(dry, sky="swinbank")


def test_frames_outside_the_weather_record_are_refused():
    with pytest.raises(SceneError, match="no weather for second"):
        EnergyNetwork(weights=ALL).prepare(make_scene(times=(0.0, HOUR_S, 30 * HOUR_S)))


def test_given_features_must_be_there_and_fit():
    with pytest.raises(SceneError, match="lacks 'point_features'"):
        make(features="given")
    with pytest.raises(SceneError, match="feature_size=3"):
        make(replace(make_scene(), point_features=torch.zeros(60, 3)), features="given")


def test_the_table_needs_a_class_for_every_point():
    scene = make_scene(labels=torch.full((60,), -1))
    with pytest.raises(SceneError, match="points without a class"):
        make(scene, attributes="table")
    model, splats = make(scene)
    assert penalties(model, splats)["physical"] == 0


# Beyond the paper ---------------------------------------------------------------------------------------


def on_slabs(**options):
    """A model of one-sided slabs, whose Gaussians face up or east by turns."""
    model, splats = make(body="surface", disturb=0.5, **options)
    splats["normals"].data.copy_(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]).repeat(20, 1))
    return model, splats


def test_constant_attributes_are_the_same_at_every_moment():
    model, splats = make(disturb=1.0, attributes="constant")
    morning, night = (model.attributes(splats, query(hours * HOUR_S)) for hours in (2, 9))
    for name in ATTRIBUTES:
        torch.testing.assert_close(morning[name], night[name], rtol=0, atol=0)
        assert morning[name].std() > 0
    free, splats = make(disturb=1.0)
    morning, night = (free.attributes(splats, query(hours * HOUR_S)) for hours in (2, 9))
    assert (morning["convection"] - night["convection"]).abs().max() > 1e-3


def test_the_balance_is_asked_over_the_whole_record(monkeypatch):
    asked = {}
    for collocation in ("view", "record"):
        model, splats = make(collocation=collocation)
        rate, times = model._rate, []
        monkeypatch.setattr(model, "_rate", lambda *args, rate=rate, times=times: times.append(args[-1]) or rate(*args))
        for step in range(60):
            penalties(model, splats, step)
        asked[collocation] = torch.tensor(times)
    assert (asked["view"] - HOUR_S).abs().max() <= 600
    shares = (asked["record"] + 2 * HOUR_S) / (22 * HOUR_S)
    assert shares.min() < 0.05 and shares.max() > 0.95
    assert shares.histc(10, 0.0, 1.0).min() > 0


def test_past_weather_is_seen_as_fading_means():
    weather = make_weather()
    step = replace(weather, air_c=torch.where(weather.times_s < 0, 10.0, 20.0).double())
    past = remembered(step, [3.0])
    known = float(past[0, 0]) + (20 - float(past[0, 0])) * (1 - math.exp(-10 / 3))
    at_ten = int((weather.times_s == 10 * HOUR_S).nonzero())
    assert abs(float(past[at_ten, 0]) - known) < 1.0  # two hours of 10 °C come first
    steady = remembered(replace(weather, air_c=torch.full_like(weather.air_c, 7.0)), [1.0, 12.0])
    assert steady.shape == (len(weather.times_s), 10)
    torch.testing.assert_close(steady[:, [0, 5]], torch.full((len(steady), 2), 7.0, dtype=torch.float64))

    model, splats = make(disturb=1.0, past_h=[4.0], time="none")
    before = model.features(splats, query(6 * HOUR_S))
    warmer = torch.where(weather.times_s < 5 * HOUR_S, weather.air_c + 8.0, weather.air_c)
    model._past = remembered(replace(weather, air_c=warmer), model.options.past_h)
    assert (model.features(splats, query(6 * HOUR_S)) - before).abs().max() > 1e-3


def test_slabs_train():
    model, splats = on_slabs(sky="swinbank", attributes="constant", collocation="record", past_h=[1.0, 12.0])
    terms = penalties(model, splats)
    sum(terms.values()).backward()
    assert set(terms) == set(TERMS)
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert model.network.heads["attributes"].weight.grad.abs().max() > 0
