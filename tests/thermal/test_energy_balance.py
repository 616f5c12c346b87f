"""The energy balance as a thermal model: what it needs, what is absent, what it says, and what a checkpoint carries.

A kernel of the full balance takes seconds to compile for each combination of effects, once with derivatives and once without, in
float32 and in float64: tests ask for those that other tests have.
"""

import io
import math
import re
from dataclasses import replace

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet, Weather
from heatsplat.geometry.exposure import felt_directions, sun_directions
from heatsplat.physics.units import celsius
from heatsplat.splats import Splats
from heatsplat.thermal.base import NORMALS, Query, Seeds
from heatsplat.thermal.energy_balance import EnergyBalance

HOUR = 3600.0
FULL = ("log_rate", "raw_sun", "raw_share", "raw_wind")


def weather(**changes) -> Weather:
    """A day and a half from midnight: warm afternoon, sun from east over south to west, wind that rises by day."""
    times = torch.arange(-6 * HOUR, 30 * HOUR + 1, 1800.0, dtype=torch.float64)
    angle = 2 * math.pi * times / (24 * HOUR)
    sun = torch.stack((angle.sin(), 0.6 * angle.cos() - 1.2, -angle.cos()), dim=1)  # x is east
    sun = torch.nn.functional.normalize(sun, dim=1)
    height = sun[:, 2].clamp(min=0)
    record = Weather(
        times,
        air_c=16 - 6 * angle.cos(),
        wind_m_s=3 - 2 * angle.cos(),
        humidity_percent=60 + 20 * angle.cos(),
        irradiance_w_m2=700 * height + 100 * height.sqrt(),
        direct_w_m2=torch.where(height > 0, 700.0, 0.0).double(),
        diffuse_w_m2=100 * height.sqrt(),
        sun=sun,
    )
    return replace(record, **changes)


def scene(record: Weather | None = None, times=(0.0, 6 * HOUR, 12 * HOUR, 18 * HOUR), **changes) -> SceneData:
    camera = Camera(torch.eye(4), torch.eye(3), 4, 4)
    above = torch.eye(4)
    above[2, 3] = -20.0  # the camera stands at z = 20
    camera = replace(camera, viewmat=above)
    views = ViewSet([Frame(f"{i}.png", i, camera, time) for i, time in enumerate(times)], lambda i: None)
    data = SceneData("yard", views, views, views, torch.zeros(4, 3), None, ThermalRange(0.0, 60.0))
    return replace(data, weather=record or weather(), **changes)


def splats_of(model: EnergyBalance, count: int = 6) -> Splats:
    """Flat splats: half of them lie level, half stand upright and face east."""
    generator = torch.Generator().manual_seed(0)
    start = Seeds(torch.zeros(count, 3), 0.3 + 0.3 * torch.rand(count, 1, generator=generator), generator)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    quats[count // 2 :] = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
    means = torch.zeros(count, 3)
    flat = torch.tensor([0.0, 0.0, -4.0]).repeat(count, 1)
    seen = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]).repeat_interleave(count // 2, dim=0)
    tensors = {"means": means, "log_scales": flat, "quats": quats, "opacity_logits": torch.zeros(count, 1)}
    declared = {name: item.initial for name, item in model.per_gaussian(start).items()}
    return Splats(tensors | declared | ({NORMALS: seen} if NORMALS in declared else {}))


def ready(data: SceneData | None = None, **options) -> tuple[EnergyBalance, Splats]:
    model = EnergyBalance(**options)
    model.check(data or scene())
    model.prepare(data or scene())
    return model, splats_of(model)


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_it_emits_temperatures_and_all_that_it_learns_gets_a_gradient(solution):
    model, splats = ready(solution=solution)
    assert set(splats.names) >= {"initial_state", *FULL}
    ids = torch.tensor([4, 1])
    shown = model.features(splats, Query(ids, time_s=13 * HOUR))
    assert shown.shape == (2, 1)
    kelvin = model.temperature(splats, 13 * HOUR)
    torch.testing.assert_close(shown[:, 0], ((kelvin[ids] - 273.15) / 60.0), atol=1e-4, rtol=0)
    shown.sum().backward()
    for name in FULL:
        assert (splats[name].grad[ids] != 0).all(), name
        assert (splats[name].grad[0] == 0).all(), name


@pytest.mark.parametrize(
    "options",
    [{"solution": "linear"}, {"solution": "linear", "nodes": 2}, {"solution": "linear", "semi_infinite": True}, {}],
    ids=str,
)
def test_temperatures_of_many_times_are_those_of_each(options):
    model, splats = ready(**options)
    times, ids = [0.0, 3.1 * HOUR, 3.2 * HOUR, 11 * HOUR, 24 * HOUR], torch.tensor([2, 5, 0])
    with torch.no_grad():
        together = model.temperatures(splats, times, ids)
        alone = torch.stack([model.temperature(splats, time_s)[ids] for time_s in times])
        torch.testing.assert_close(together, alone, atol=2e-4, rtol=0)
        assert (together.diff(dim=0).abs() > 0.01).any(1).all()
        with pytest.raises(SceneError, match="there is no weather for second"):
            model.temperatures(splats, [0.0, 1e9])


def test_both_solutions_agree_within_what_linearising_costs():
    models = [ready(solution=solution) for solution in ("linear", "corrected")]
    linear, corrected = (torch.stack([m.temperature(s, h * HOUR) for h in range(0, 30, 3)]) for m, s in models)
    assert 0.0 < (linear - corrected).abs().max() < 6.0


def test_the_sun_heats_what_faces_it_and_only_by_day():
    model, splats = ready(solution="corrected")  # the linear one is about a mean that sunlight moves
    with torch.no_grad():
        splats["log_rate"].fill_(-math.log(300.0))
    level, east = (slice(0, 3), slice(3, 6))
    bright, dark = model.temperature(splats, 7 * HOUR), model.temperature(splats, 23 * HOUR)
    assert bright[east].mean() > bright[level].mean() + 5  # the morning sun is low
    splats["raw_sun"].data.fill_(-100.0)
    assert (model.temperature(splats, 7 * HOUR) < bright).all()
    torch.testing.assert_close(model.temperature(splats, 23 * HOUR), dark, atol=1e-3, rtol=0)  # forgotten by night
    assert dark[level].mean() < dark[east].mean()  # what lies level sees more of the cold sky


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_what_stands_around_takes_sun_and_sky_and_the_ground_gives_some_back(solution):
    """All in the shade is a day without beams; all of the sky hidden, or ground that reflects, is another diffuse light."""
    options = {"solution": solution, "clouds": True}  # a closed sky is as warm as the air, whatever part of it is seen

    def at_noon(model, splats, **seen):
        with torch.no_grad():
            for name, value in ({"raw_sun": 0.0} | seen).items():  # which starts from the light of its own weather
                splats[name].fill_(value)
        return model.temperature(splats, 12 * HOUR).detach()  # by the kernel that other tests have compiled, too

    def plainly(**changes):
        return at_noon(*ready(scene(replace(record, **changes)), **options))

    none = torch.zeros(73, dtype=torch.float64)
    record = weather(clouds=none + 1)
    closed = scene(record)
    shaded = ready(closed, shadows=True, albedo=0.3, **options)
    assert shaded[1]["sun_seen"].shape[1] > 24
    open_air, bright = plainly(), at_noon(*shaded)
    torch.testing.assert_close(bright[:3], open_air[:3])  # what lies level sees no ground
    level = record.direct_w_m2 * record.sun[:, 2].clamp(min=0) + record.diffuse_w_m2
    more = record.diffuse_w_m2 + 0.3 * level  # what stands sees as much of the ground as of the sky
    torch.testing.assert_close(bright[3:], plainly(diffuse_w_m2=more)[3:], atol=2e-3, rtol=0)
    dark = at_noon(*shaded, sun_seen=0.0)  # but the ground, which lies in the sun
    torch.testing.assert_close(dark[:3], plainly(direct_w_m2=none)[:3], atol=2e-3, rtol=0)
    torch.testing.assert_close(dark[3:], plainly(direct_w_m2=none, diffuse_w_m2=more)[3:], atol=2e-3, rtol=0)
    assert (dark < bright - 1).all()
    assert ((at_noon(*shaded, sun_seen=0.5) - 0.5 * (dark + bright)).abs() < 0.02 * (bright - dark)).all()
    hidden = ready(closed, sky_view=True, **options)
    torch.testing.assert_close(at_noon(*hidden), open_air)
    torch.testing.assert_close(at_noon(*hidden, sky_seen=0.0), plainly(diffuse_w_m2=none), atol=2e-3, rtol=0)
    with pytest.raises(SceneError, match="need the direction of the sun"):
        ready(scene(weather(sun=None)), shadows=True)


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_shadows_of_a_sun_that_never_rises_change_nothing(solution):
    record = weather()
    low = record.sun - 2.0 * record.sun[:, 2:].clamp(min=0.0) * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    none = torch.zeros(73, dtype=torch.float64)
    night = scene(replace(record, sun=low, irradiance_w_m2=none, direct_w_m2=none, diffuse_w_m2=none))
    model, splats = ready(night, solution=solution, shadows=True, albedo=0.3)
    plain, open_splats = ready(night, solution=solution)
    torch.testing.assert_close(
        model.temperature(splats, 12 * HOUR), plain.temperature(open_splats, 12 * HOUR), atol=1e-4, rtol=0
    )


def test_by_night_nothing_is_sunlit():
    """The map of it showed what the first sun of the record reaches."""
    model, splats = ready(shadows=True)
    assert model.attributes(splats, Query(time_s=12 * HOUR))["sunlit"].tolist() == [1.0] * 6
    assert model.attributes(splats, Query(time_s=0.0))["sunlit"].tolist() == [0.0] * 6


def test_effects_that_are_off_or_unknown_are_absent():
    model, splats = ready(sky=None, wind=False, sun=False)
    assert set(splats.names) & {"raw_share", "raw_sun", "raw_wind"} == set()
    assert model.effects() == {"convection": {"air": "recorded"}}
    assert set(model.attributes(splats, Query(time_s=0.0))) == {"time_constant_h"}
    bare = weather(wind_m_s=None, humidity_percent=None, pressure_hpa=None)
    model, splats = ready(scene(bare))
    assert "raw_wind" not in splats
    assert model.effects()["convection"]["left_out"] == "wind, which the weather lacks"
    assert model.effects()["radiation"]["sky"] == "swinbank"
    assert "humidity" in model.effects()["radiation"]["left_out"]
    assert model.temperature(splats, 5 * HOUR).isfinite().all()


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_clouds_close_the_sky_as_far_as_the_record_says(solution):
    """A closed sky is as warm as the air: surfaces end where those that lose no heat to the sky do."""
    none = torch.zeros(73, dtype=torch.float64)
    nights = weather(irradiance_w_m2=none, direct_w_m2=none, diffuse_w_m2=none, wind_m_s=none + 3.0)
    closed = scene(replace(nights, clouds=torch.ones_like(nights.times_s)))
    half = scene(replace(nights, clouds=torch.full_like(nights.times_s, 0.5)))
    air, splats = ready(closed, sky=None, solution="linear")  # in still air and without T⁴ that is all of the balance
    under = [ready(data, clouds=True, solution=solution)[0] for data in (closed, half)]
    clear, full = ready(closed, solution=solution)
    with torch.no_grad():
        at = [model.temperature(full, 27 * HOUR) for model in (*under, clear)]
        torch.testing.assert_close(at[0], air.temperature(splats, 27 * HOUR), rtol=0, atol=0.1)
    assert (at[0] > at[1] + 0.5).all() and (at[1] > at[2] + 0.5).all()
    assert "clouds" in under[0].effects()["radiation"] and "clouds" not in clear.effects()["radiation"]
    with pytest.raises(SceneError, match="the weather tells no clouds, which clouds=true needs"):
        ready(scene(nights), clouds=True)


def test_rain_cools_surfaces_until_it_has_evaporated_and_a_dry_record_has_no_trace_of_it(caplog):
    record = weather()
    shower = ((record.times_s >= 12 * HOUR) & (record.times_s <= 13 * HOUR)).double()
    model, splats = ready(scene(replace(record, rain_mm_h=2.0 * shower)), rain=0.3)
    dry, _ = ready(scene(replace(record, rain_mm_h=0.0 * shower)), rain=0.3)
    splats.double()
    assert dry.climate.drivers.rain is None and dry.effects()["convection"]["rain"].startswith("0 mm")
    colder = [dry.temperature(splats, t * HOUR) - model.temperature(splats, t * HOUR) for t in (11, 13, 29)]
    # Where it rains, hours are passed in pieces.
    assert (colder[0].abs() < 1e-3).all() and (colder[1] > 2.0).all() and (colder[2].abs() < 0.2).all()
    assert splats_of(model).state_dict().keys() == splats_of(dry).state_dict().keys()  # nothing of it is learned
    untold, _ = ready(scene(record), rain=0.3)
    assert untold.climate.drivers.rain is None and "rain_mm_h" in untold.effects()["convection"]["left_out_rain"]
    assert "surfaces stay dry" in caplog.text


def test_transpiration_cools_in_the_sun_is_learned_and_can_be_looked_at():
    model, splats = ready(scene(weather()), transpires=True)
    dry, _ = ready(scene(weather()))
    assert set(splats.names) - set(splats_of(dry).names) == {"raw_transpires"}
    assert model.effects()["convection"]["transpires"] and "transpires" not in dry.effects()["convection"]
    splats.double()
    found = [dry.temperature(splats, 13 * HOUR)]
    for raw in (-4.0, 0.0, 4.0):
        with torch.no_grad():
            splats["raw_transpires"].fill_(raw)
        share = model.attributes(splats, Query())["transpiration"]
        torch.testing.assert_close(share, torch.sigmoid(splats["raw_transpires"].detach()))
        found.append(model.temperature(splats, 13 * HOUR))
    assert (torch.stack(found).diff(dim=0) < 0).all() and (found[0] - found[-1] > 3.0).all()
    with torch.no_grad():
        splats["raw_transpires"].zero_()
    model.features(splats, Query(time_s=13 * HOUR)).sum().backward()
    assert (splats["raw_transpires"].grad < 0).all()


def test_without_the_suns_direction_all_surfaces_lie_level_and_it_says_so():
    model, splats = ready(scene(weather(sun=None, direct_w_m2=None, diffuse_w_m2=None)), wind=False)
    assert model.effects()["solar"]["left_out"] == "the direction of the sun, which the weather lacks"
    assert model.climate.beam is None
    with torch.no_grad():
        splats["raw_sun"].fill_(0.0)
        splats["initial_state"].fill_(0.3)
    temperatures = model.temperature(splats.double(), 12 * HOUR)
    torch.testing.assert_close(temperatures, temperatures[:1].expand(6), atol=1e-4, rtol=0)
    model, splats = ready(scene(weather(sun=None, direct_w_m2=None, diffuse_w_m2=None, irradiance_w_m2=None)))
    assert "raw_sun" not in splats
    assert "no irradiance" in str(model.effects())


def test_a_weather_that_tells_of_the_sun_what_training_did_not_is_refused_with_what_to_leave_out():
    dark = weather(sun=None, direct_w_m2=None, diffuse_w_m2=None, irradiance_w_m2=None)
    level = weather(sun=None, direct_w_m2=None, diffuse_w_m2=None)
    for trained, word in ((dark, "light"), (level, "direction")):
        model, splats = ready(scene(trained))
        model.under(weather())
        with pytest.raises(
            SceneError, match=f"tells the sun's {word}, of which there was none in training: leave its columns"
        ):
            model.temperature(splats, 12 * HOUR)


def test_another_weather_changes_the_answer_without_training():
    model, splats = ready()
    with torch.no_grad():
        before = model.temperature(splats, 14 * HOUR)
        model.prepare(scene(weather(wind_m_s=torch.full((73,), 12.0, dtype=torch.float64))))
        windy = model.temperature(splats, 14 * HOUR)
    hot = before > 273.15 + 30
    assert hot.any()
    assert (windy[hot] < before[hot] - 2).all()
    assert model.mean_wind.item() == pytest.approx(3.0, abs=1.0)  # still that of the trained record


def test_a_checkpoint_brings_the_constants_of_its_own_weather():
    model, splats = ready()
    warm = scene(weather(air_c=weather().air_c + 15))
    truth, _ = ready()
    truth.prepare(warm)
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    restored = EnergyBalance()
    restored.prepare(warm)
    assert restored.reference_k != model.reference_k
    restored.load_state_dict(torch.load(file))
    with torch.no_grad():
        torch.testing.assert_close(restored.temperature(splats, 9 * HOUR), truth.temperature(splats, 9 * HOUR))
        assert (restored.temperature(splats, 9 * HOUR) > model.temperature(splats, 9 * HOUR)).all()


def test_attributes_follow_the_assumed_emissivity_by_one_common_factor():
    """The gauge: absorptivity, convection, capacity and emissivity times one number show the same image."""
    query = Query(torch.tensor([0, 5]), time_s=12 * HOUR)
    (model, splats), (other, _) = ready(emissivity=0.9), ready(emissivity=0.45)
    told, half = model.attributes(splats, query), other.attributes(splats, query)
    for name in ("absorptivity", "convection_w_m2_k", "areal_heat_capacity_kj_m2_k"):
        torch.testing.assert_close(half[name], told[name] / 2)
    for name in ("time_constant_h", "sun_k_per_kw_m2", "radiation_share", "wind_share"):
        torch.testing.assert_close(half[name], told[name])
    torch.testing.assert_close(model.features(splats, query), other.features(splats, query))
    assert (told["absorptivity"] > 0).all()


def test_scenes_and_moments_that_cannot_be_answered_are_refused():
    with pytest.raises(SceneError, match="EnergyBalance needs .*weather by weather.csv of data=thermo"):
        ready(replace(scene(), weather=None))
    with pytest.raises(SceneError, match="EnergyBalance needs thermal_range"):
        ready(scene(thermal_range=None))
    with pytest.raises(SceneError, match="has no air_c, the temperature of the air"):
        ready(scene(weather(air_c=None)))
    with pytest.raises(SceneError, match="there is no weather for second 720000"):
        ready(scene(times=(0.0, 200 * HOUR)))
    with pytest.raises(SceneError, match="sky=brunt needs humidity_percent"):
        ready(scene(weather(humidity_percent=None)), sky="brunt")
    model, splats = ready()
    with pytest.raises(SceneError, match="the record runs from -21600 to 108000 s"):
        model.features(splats, Query(time_s=-1e6))
    with pytest.raises(ValueError, match="give time_s"):
        model.features(splats, Query())
    with pytest.raises(SceneError, match="trained with wind, but this weather has no wind_m_s"):
        model.prepare(scene(weather(wind_m_s=None)))


def test_a_night_only_record_works_without_sun():
    night = torch.arange(0, 6 * HOUR + 1, 600.0, dtype=torch.float64)
    zero = torch.zeros_like(night)
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(len(night), 3)
    record = Weather(night, air_c=zero + 10, direct_w_m2=zero, diffuse_w_m2=zero, irradiance_w_m2=zero, sun=down)
    model, splats = ready(scene(record, times=(0.0, 3 * HOUR)))
    with torch.no_grad():
        splats["log_rate"].fill_(-math.log(600.0))
    late = model.temperature(splats, 6 * HOUR)
    assert (late < 273.15 + 10).all()  # below the air, under a clear sky
    assert (late > 273.15 - 10).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip": "soft"}, "clip must be one of"),
        ({"material_weight": 0.0}, "material_weight must be above zero, got 0.0; materials=null is without"),
    ],
)
def test_unknown_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        EnergyBalance(**options)


def test_the_yaml_builds_the_defaults_of_the_class():
    settings = OmegaConf.load("conf/thermal/energy_balance.yaml")
    settings.materials_from = 0  # a share of the run
    built, plain = instantiate(settings), EnergyBalance()
    assert built.options == plain.options
    for name, value in vars(plain).items():
        if isinstance(value, (int, float, str)) and not name.startswith("_"):
            assert getattr(built, name) == value, name


def test_a_core_is_there_only_where_it_is_asked_for_and_stays_warm_after_dusk():
    plain, without = ready()
    model, splats = ready(nodes=2, inner=True)  # which begins without heat from within
    core = {"initial_core", "log_core_rate", "log_coupling"}
    assert core <= set(splats.names) and not core & set(without.names)
    assert "relaxation" in model.effects() and "relaxation" not in plain.effects()
    assert model.cost == 2 * plain.cost
    with torch.no_grad():
        splats["log_coupling"].fill_(math.log(3.0))
    dusk = 20 * HOUR
    assert (model.temperature(splats, dusk) > plain.temperature(without, dusk) + 0.5).all()
    noon = model.features(splats, Query(time_s=12 * HOUR))
    noon.sum().backward()
    assert all((splats[name].grad != 0).any() for name in core)
    told = model.attributes(splats, Query(time_s=0.0))
    torch.testing.assert_close(told["core_coupling"], torch.full((6,), 3.0))
    torch.testing.assert_close(told["core_time_constant_h"], torch.full((6,), 6.0))


def test_heat_from_within_and_bodies_without_an_end_tell_what_walls_are():
    plain, without = ready()
    model, splats = ready(semi_infinite=True, inner=True, indoor_c=40.0)
    assert set(splats.names) - set(without.names) == {"inner_rise"}
    assert "from_within" in model.effects()["convection"] and "from_within" not in plain.effects()["convection"]
    with torch.no_grad():
        splats["inner_rise"].fill_(2.0 / 60.0)
    model.features(splats, Query(time_s=12 * HOUR)).sum().backward()
    assert all((splats[name].grad != 0).all() for name in ("inner_rise", "log_rate"))
    told = model.attributes(splats, Query(time_s=0.0))
    exchange = told["convection_w_m2_k"] / (1 - told["radiation_share"])
    # 2 K where a surface is as warm as the mean air.
    lets_through = 2 * exchange / (40.0 - celsius(model.reference_k).float())
    torch.testing.assert_close(told["heat_loss_w_m2"], lets_through * (40.0 - told["mean_surface_c"]))
    torch.testing.assert_close(told["u_value_w_m2_k"], lets_through / (1 + 0.04 * lets_through))
    torch.testing.assert_close(told["effusivity_j_m2_k_s05"], exchange * told["settling_time_h"].mul(3600).sqrt())
    assert (told["u_value_w_m2_k"] > 0.5).all() and not {"time_constant_h", "areal_heat_capacity_kj_m2_k"} & set(told)
    assert "u_value_w_m2_k" not in plain.attributes(without, Query(time_s=0.0))
    constant, _ = ready(semi_infinite=True, inner=True)
    told = constant.attributes(splats, Query(time_s=0.0))
    torch.testing.assert_close(told["heat_loss_w_m2"], 2 * exchange)
    assert "u_value_w_m2_k" not in told
    with pytest.raises(SceneError, match="is the mean temperature of the air outside .* leave indoor_c out"):
        ready(inner=True, indoor_c=round(celsius(model.reference_k).item(), 1))


@pytest.mark.parametrize(
    "solution", ["linear", pytest.param("corrected", marks=pytest.mark.slow)]
)  # kernels of its own
def test_a_core_heat_from_within_and_a_known_exchange_go_with_either_solution(solution):
    """Emitted, looked at and learned: all numbers get a gradient, and looking finds what training does."""
    model, splats = ready(solution=solution, nodes=2, inner=True, exchange=[5.0, 2.5], indoor_c=60.0, shadows=True)
    trained = {"initial_state", "log_rate", "raw_sun", "inner_rise", "initial_core", "log_core_rate", "log_coupling"}
    assert trained <= set(splats.names) and "sun_seen" in splats
    assert not {"raw_share", "raw_wind"} & set(splats.names)
    assert ("marched_at" in splats) == (solution == "corrected")
    with torch.no_grad():
        splats["inner_rise"].fill_(2.0 / 60.0)
        splats["log_coupling"].fill_(math.log(3.0))
        looked = model.temperature(splats, 12 * HOUR)  # a training frame
        splats["inner_rise"].fill_(0.0)
        assert ((looked - model.temperature(splats, 12 * HOUR)) > 0.3).all()  # another scene, not what was kept
        splats["inner_rise"].fill_(2.0 / 60.0)
    shown = model.features(splats, Query(time_s=12 * HOUR))
    torch.testing.assert_close(shown[:, 0] * 60 + 273.15, looked, atol=2e-3, rtol=0)
    shown.sum().backward()
    for name in trained:
        assert (splats[name].grad != 0).all(), name
    between = model.temperature(splats, 12.3 * HOUR)  # no frame: marched for itself
    with torch.no_grad():
        torch.testing.assert_close(model.temperature(splats, 12.3 * HOUR), between, atol=2e-3, rtol=0)
        with model.doubts()["convection"]():  # not the course that was kept for the exchange as given
            assert ((model.temperature(splats, 12.3 * HOUR) - between).abs() > 0.02).all()
        torch.testing.assert_close(model.temperature(splats, 12.3 * HOUR), between, atol=2e-3, rtol=0)


def test_looking_finds_what_training_does_of_what_is_marched():
    """Kept at training frames, marched for itself between them; of another scene or another exchange nothing is kept."""
    model, splats = ready()
    assert "marched_at" in splats
    with torch.no_grad():
        looked = model.temperature(splats, 12 * HOUR)  # a training frame
        splats["raw_sun"].add_(1.0)
        assert ((model.temperature(splats, 12 * HOUR) - looked).abs() > 0.3).all()
        splats["raw_sun"].sub_(1.0)
    shown = model.features(splats, Query(time_s=12 * HOUR))
    torch.testing.assert_close(shown[:, 0] * 60 + 273.15, looked, atol=2e-3, rtol=0)
    between = model.temperature(splats, 12.3 * HOUR)
    with torch.no_grad():
        torch.testing.assert_close(model.temperature(splats, 12.3 * HOUR), between, atol=2e-3, rtol=0)


def test_what_is_mixed_has_the_quotient_of_means_and_not_the_mean_of_quotients():
    model, splats = ready(inner=True, indoor_c=40.0)
    with torch.no_grad():
        splats["inner_rise"].copy_(torch.linspace(0.5, 4.0, 6) / 60.0)
    told = model.attributes(splats, Query(time_s=0.0))
    mixed = {name: values.mean() for name, values in told.items()}
    found = model.quotients(mixed)["u_value_w_m2_k"]
    loss, driving = mixed["heat_loss_w_m2"], 40.0 - mixed["mean_surface_c"]
    torch.testing.assert_close(found, loss / (driving + 0.04 * loss))
    assert (found - mixed["u_value_w_m2_k"]).abs() > 1e-3
    assert not ready(inner=True)[0].quotients({"heat_loss_w_m2": loss})


def test_an_exchange_by_convention_is_not_learned():
    model, splats = ready(exchange="iso_6946", emissivity=0.9)
    assert not {"raw_share", "raw_wind"} & set(splats.names)
    told = model.attributes(splats, Query(time_s=0.0))
    wind = model.mean_wind.item()
    torch.testing.assert_close(told["convection_w_m2_k"], torch.full((6,), 4 + 4 * wind), rtol=1e-5, atol=0)
    torch.testing.assert_close(told["wind_share"], torch.full((6,), 4 * wind / (4 + 4 * wind)), rtol=1e-5, atol=0)
    with model.doubts()["convection"]():
        more = model.attributes(splats, Query(time_s=0.0))["convection_w_m2_k"]
    torch.testing.assert_close(more, 1.2 * told["convection_w_m2_k"])
    assert not ready()[0].doubts() and not ready(exchange="iso_6946", convection_error=0.0)[0].doubts()
    with pytest.raises(SceneError, match="exchange=iso_6946 needs wind_m_s"):
        ready(scene(weather(wind_m_s=None)), exchange="iso_6946")


@pytest.mark.parametrize("exchange", ["iso_6946", [5.0, 2.5]])
def test_where_the_exchange_is_given_nothing_absorbs_more_light_than_falls_on_it(exchange):
    model, splats = ready(exchange=exchange, emissivity=0.9)
    told = model.attributes(splats, Query(time_s=0.0))["absorptivity"]
    assert (told > 0).all() and (told <= 0.5001).all()  # where training starts
    learned, of_learned = ready(emissivity=0.9)
    assert (learned.attributes(of_learned, Query(time_s=0.0))["absorptivity"] > 0.5).any()
    with torch.no_grad():
        splats["raw_sun"].fill_(50.0)
    black = model.attributes(splats, Query(time_s=0.0))["absorptivity"]
    torch.testing.assert_close(black, torch.ones(6), rtol=1e-5, atol=0)


def test_a_record_of_still_air_has_the_convection_of_still_air():
    still = torch.zeros_like(weather().wind_m_s)
    for exchange, expected in (("iso_6946", 4.0), ([5.0, 2.5], 5.0)):
        model, splats = ready(scene(weather(wind_m_s=still)), exchange=exchange, emissivity=0.9)
        told = model.attributes(splats, Query(time_s=13 * HOUR))
        torch.testing.assert_close(told["convection_w_m2_k"], torch.full((6,), expected), rtol=1e-5, atol=0)
        assert model.temperature(splats, 13 * HOUR).isfinite().all()
        assert model.effects()["convection"]["wind"] == "recorded, 0 m/s throughout"


def test_convection_that_was_measured_is_what_the_balance_has():
    model, splats = ready(exchange=[5.0, 2.5], emissivity=0.9)
    told, wind = model.attributes(splats, Query(time_s=0.0)), model.mean_wind.item()
    torch.testing.assert_close(told["convection_w_m2_k"], torch.full((6,), 5 + 2.5 * wind), rtol=1e-5, atol=0)
    torch.testing.assert_close(told["wind_share"], torch.full((6,), 2.5 * wind / (5 + 2.5 * wind)), rtol=1e-5, atol=0)
    assert model.effects()["convection"]["given"] == "5 + 2.5 v W/(m² K) in wind v"
    assert model.doubts() and not ready(exchange=[5.0, 2.5], convection_error=0.0)[0].doubts()
    by_name, splats = ready(exchange="iso_6946")
    same = ready(exchange=[4, 4])[0]
    torch.testing.assert_close(same.temperature(splats, 9 * HOUR), by_name.temperature(splats, 9 * HOUR))
    calm, splats = ready(scene(weather(wind_m_s=None)), exchange=[8.0, 0.0])  # asks for no wind
    told = calm.attributes(splats, Query(time_s=0.0))
    torch.testing.assert_close(told["convection_w_m2_k"], torch.full((6,), 8.0))
    assert "wind_share" not in told


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_what_materials_have_in_common_is_held_from_their_step_on(solution):
    """One material: the pull is to the mean of all."""
    model, splats = ready(solution=solution, materials=1, material_weight=0.3, materials_from=7)
    held = ("log_rate", "raw_sun", "raw_share", "raw_wind")
    for name in held:
        splats[name].requires_grad_().data.copy_(torch.arange(6.0) ** 2)
    model.on_step(6)
    assert model.regularisers(splats) == {}
    model.on_step(7)
    (term,) = model.regularisers(splats).values()
    squares = torch.arange(6.0, dtype=torch.float64) ** 2
    torch.testing.assert_close(term.double(), 4 * 0.3 * (squares - squares.mean()).square().mean(), rtol=1e-6, atol=0)
    term.backward()
    pull = 0.3 * 2 * (squares - squares.mean()) / 6
    for name in held:
        torch.testing.assert_close(splats[name].grad.double(), pull, rtol=1e-6, atol=1e-6)
    assert splats["initial_state"].grad is None


def test_materials_are_absent_where_they_are_off():
    model, splats = ready()
    assert model.regularisers(splats) == {} and not any("materials" in name for name in model.state_dict())
    model, _ = ready(materials=8)
    assert model.regularisers(splats_of(model, 0)) == {}


@pytest.mark.parametrize(
    ("options", "follow"),
    [({"solution": "linear"}, True), ({}, False)],
)
def test_shares_that_few_images_tell_do_not_learn_faster_in_shorter_runs(options, follow):
    model, _ = ready(**options)
    seeds = Seeds(torch.zeros(2, 3), torch.full((2, 1), 0.4), torch.Generator())
    paced = {name: item.paced for name, item in model.per_gaussian(seeds).items()}
    assert paced["raw_share"] is paced["raw_wind"] is follow
    assert paced["log_rate"] and paced["raw_sun"]


def test_a_weather_with_far_more_wind_than_training_had_is_warned_of(caplog):
    model, _ = ready()
    model.under(replace(weather(), wind_m_s=2.0 * weather().wind_m_s))
    assert not caplog.text
    model.under(replace(weather(), wind_m_s=4.0 * weather().wind_m_s))
    assert re.search(r"m/s of wind in the mean, and training had [0-9.]+: images did not tell", caplog.text)


def test_shadows_of_a_long_record_are_of_the_sun_that_images_feel():
    day, days = weather(), 120
    times = torch.arange(days * 48, dtype=torch.float64) * 1800.0 - (days - 1) * 24 * HOUR
    names = ("air_c", "wind_m_s", "humidity_percent", "irradiance_w_m2", "direct_w_m2", "diffuse_w_m2")
    angle = 2 * math.pi * times / (24 * HOUR)
    season = 1.2 * (times / times[0]).clamp(min=0)  # the sun stands lower the longer ago
    sun = torch.stack((angle.sin(), 0.6 * angle.cos() - season, -angle.cos()), dim=1)
    series = {name: getattr(day, name)[:48].repeat(days) for name in names}
    record = Weather(times, sun=torch.nn.functional.normalize(sun, dim=1), **series)
    model, splats = ready(scene(record), shadows=True)
    ways = felt_directions(record, (0.0, 6 * HOUR, 12 * HOUR, 18 * HOUR))
    assert torch.equal(model.sun_ways, ways) and splats["sun_seen"].shape[1] == len(ways)
    assert len(ways) < 0.5 * len(sun_directions(record.sun, record.up))


@pytest.mark.parametrize("solution", ["linear", "corrected"])
def test_in_another_weather_shadows_are_those_of_the_directions_that_were_looked_at(solution, caplog):
    def striped(model):
        return ((20 * model.climate.drivers.ways).sin().sum(1) > 0).float()

    trained, splats = ready(shadows=True, albedo=0.3, solution=solution)
    splats["sun_seen"].data[:] = striped(trained)
    record = weather()
    series = (
        "times_s",
        "air_c",
        "wind_m_s",
        "humidity_percent",
        "irradiance_w_m2",
        "direct_w_m2",
        "diffuse_w_m2",
        "sun",
    )
    later = scene(replace(record, **{name: getattr(record, name)[12:] for name in series}))  # from midnight on
    model, own = ready(later, shadows=True, albedo=0.3, solution=solution)
    assert not torch.equal(model.sun_ways, trained.sun_ways)  # the first sun is that of the morning, not of the evening
    with torch.no_grad():
        for name in own.names:
            own[name].copy_(splats[name])
        own["sun_seen"][:] = striped(model)
        model.load_state_dict(trained.state_dict() | {"sun_ways": model.sun_ways})
        truth = model.temperature(own, 9 * HOUR)
        model.load_state_dict(trained.state_dict())
        torch.testing.assert_close(model.temperature(splats, 9 * HOUR), truth, atol=1e-3, rtol=0)
        assert (model.temperature(own, 9 * HOUR) - truth).abs().max() > 0.1  # columns of other directions tell
        assert "shadows are those of the sun where it stood" not in caplog.text
        lower = torch.nn.functional.normalize(record.sun + torch.tensor([0.0, -0.4, 0.0], dtype=torch.float64), dim=1)
        model.under(weather(sun=lower))
    assert "shadows are those of the sun where it stood during training, up to" in caplog.text
