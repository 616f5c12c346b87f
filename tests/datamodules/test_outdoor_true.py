"""The yard that shares no assumption with the models: what it shows, and what a scene tells of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.outdoor_sky import SKIES, cloud_cover, series
from heatsplat.datamodules.synthetic_scene.outdoor_true import TRUE, YARDS, OutdoorTrueScene, sky_of, true_weather
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C, STEFAN_BOLTZMANN


@cache
def world() -> OutdoorTrueScene:
    return OutdoorTrueScene(replace(TRUE, patch_m=1.0, ground_m=2.0))


def truth(points, hours) -> np.ndarray:
    """°C [n, F]."""
    where = torch.tensor(points, dtype=torch.float64)
    return world().truth(where, torch.tensor(hours, dtype=torch.float64) * 3600.0).numpy()


def test_a_shadow_leaves_the_meadow_colder_long_after_the_sun_has_moved_on():
    """North of the house, where it casts its shadow at noon, beside open meadow of the same paint."""
    before, noon, late = truth([(1.3, 4.7, 0.0), (25.0, 20.0, 0.0)], (4.0, 11.5, 20.0)).T
    assert abs(before[0] - before[1]) < 3.0  # under the sky that the house leaves, the meadow does not cool as far
    assert noon[1] - noon[0] > 6.0
    assert late[1] > late[0] - 1.5


def test_heat_comes_through_the_walls_of_a_heated_house():
    """0.4 to 0.5 W/(m² K) times 15 K, over an exchange of 15 W/(m² K) with air and sky."""
    heated = next(surface for surface in TRUE.surfaces if surface.name == "house")
    cold = replace(heated, material=replace(heated.material, back_c=heated.material.back_c - 15.0))
    yard = tuple(cold if surface is heated else surface for surface in TRUE.surfaces)
    unheated = OutdoorTrueScene(replace(TRUE, surfaces=yard, patch_m=2.0, ground_m=4.0))
    wall, night = torch.tensor([(0.0, -2.5, 2.0)], dtype=torch.float64), torch.arange(24.0, 28.0) * 3600.0
    more = world().truth(wall, night.double()) - unheated.truth(wall, night.double())
    assert 0.2 < more.mean() < 0.8


def test_the_camera_sees_cold_sky_in_the_roof_and_the_truth_does_not():
    scene = world()
    roof = torch.tensor([[0.9, -1.2, 5.5]], dtype=torch.float64)
    on, which = scene.nearest(roof)
    time = 2.0 * 3600.0
    when = torch.tensor([time], dtype=torch.float64)
    celsius = scene.celsius(scene.heat_at(on, which), when)[:, 0]
    normal = scene.normals(on, which)
    seen = scene.apparent(celsius, on, which, -normal, time)  # straight at it: the mirror shows the sky at 45 degrees
    sky = float(scene._sky_celsius(normal[:, 2], time))
    emissivity = scene.materials[int(which)].emissivity
    assert sky < float(celsius)
    # Of small differences the radiance of any band is linear.
    expected = emissivity * float(celsius) + (1 - emissivity) * sky
    assert float(seen) == pytest.approx(expected, abs=0.1)
    assert float(celsius) - float(seen) > 0.2
    assert scene.truth(on, when)[0] == celsius


def test_the_sky_of_all_directions_sends_the_long_waves_of_the_record():
    """∫ L cos over the hemisphere, with the diffusivity factor that is right within some percent."""
    scene, time = world(), 5.0 * 3600.0
    sine = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000
    total = (2.0 * sine * STEFAN_BOLTZMANN * (scene._sky_celsius(sine, time) + KELVIN_AT_0_C) ** 4).mean()
    assert float(total) == pytest.approx(float(np.interp(time, scene.sky.times_s, scene.sky.long_waves_w_m2)), rel=0.05)


def test_clouds_and_rain_warm_the_sky_and_darken_the_day():
    weather = true_weather("fair", 2 * DAY_S)
    sky, hours = sky_of("fair", weather), weather.times_s.numpy() / 3600.0
    rain = (hours > 18.6) & (hours < 19.4)
    black = STEFAN_BOLTZMANN * sky.air_k**4
    assert np.allclose(sky.long_waves_w_m2[rain], black[rain])
    assert (sky.long_waves_w_m2 / black).min() < 0.85
    assert sky.rain_kg_m2_s[rain].min() > 0 and sky.rain_kg_m2_s[hours < 18].max() == 0
    overcast = sky_of("overcast", true_weather("overcast", 2 * DAY_S))
    assert (overcast.long_waves_w_m2 / overcast.air_k**4).mean() > (sky.long_waves_w_m2 / sky.air_k**4).mean()


def test_by_night_the_sky_is_as_cloudy_as_the_clouds_that_take_light_by_day():
    hours = np.array([-2.0, 0.5, 12.0, 22.0, 26.0])
    cover, passing = cloud_cover("fair", hours * 3600.0), series(SKIES["fair"], hours * 3600.0)[3]
    assert np.allclose(1.0 - 0.75 * cover**3.4, passing) and np.ptp(cover) > 0.3
    sky = sky_of("fair", true_weather("fair", 2 * DAY_S))
    share = sky.long_waves_w_m2 / (STEFAN_BOLTZMANN * sky.air_k**4)
    night = (sky.times_s > 22 * 3600.0) & (sky.times_s < 26 * 3600.0)
    assert 0.7 < share[night].min() < 0.85


def test_the_scene_trains_on_the_first_days_and_tells_of_clouds_and_rain_what_a_station_would(monkeypatch):
    monkeypatch.setitem(YARDS, "outdoor_true", (OutdoorTrueScene, world().preset))
    scene = Synthetic(scene="outdoor_true", size="tiny", frames=6).scene
    zero = scene.weather.notes["utc_at_zero_s"]
    days = [{(zero + t) // DAY_S for t in views.times_s} for views in (scene.train, scene.test)]
    assert max(days[0]) < min(days[1]) and len(days[1]) == 1
    assert scene.metadata == {"time", "thermal_range", "ambient", "metres", "weather", "labels"}
    images = torch.stack([view.thermal for view in (*scene.train, *scene.test)])
    assert images.min() > 0.0 and images.max() < 1.0 and images.std() > 0.05
    known = scene.true_attributes(scene.points)
    assert ((known["absorptivity"] > 0.3) & (known["absorptivity"] < 1.0)).all()
    assert "cast shadows" in scene.notes["heat"]
    fell = float((scene.weather.rain_mm_h[1:] * scene.weather.times_s.diff()).sum()) / 3600.0
    assert fell == pytest.approx(1.0 * 2.0 + 0.7 * 3.0, abs=0.9)  # the showers of two days, on samples of ten minutes


def test_a_longer_record_holds_out_its_last_day():
    times, _ = OutdoorTrueScene.route(replace_days(5), 30, 0)
    assert (np.diff(times) > 0).all() and times[19] < 4 * DAY_S < times[20] and times[-1] < 5 * DAY_S


def replace_days(days: int):
    """Stands in for a scene of so many days, of which only the length matters to the route."""
    return type("Long", (), {"preset": replace(TRUE, duration_s=days * DAY_S)})()


@pytest.mark.parametrize("options", [{"scene": "facade", "days": 3}, {"scene": "outdoor", "days": 8}])
def test_days_that_a_scene_does_not_have_are_refused(options):
    with pytest.raises(SceneError, match="outdoor and outdoor_true last 2 to 7 days"):
        Synthetic(**options)
