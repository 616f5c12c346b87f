"""The yard under the sky: its solver, its weather, and what the scene tells of both."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene import heat
from heatsplat.datamodules.synthetic_scene.film import pixel_rays
from heatsplat.datamodules.synthetic_scene.outdoor import (
    CLASSES,
    DAY_S,
    METAL_ROOF,
    OUTDOOR,
    YARD,
    OutdoorScene,
    in_weather,
)
from heatsplat.datamodules.synthetic_scene.outdoor_heat import (
    STEFAN_BOLTZMANN,
    Forcing,
    OutdoorMaterial,
    Slab,
    integrate,
    solve,
)
from heatsplat.datamodules.synthetic_scene.outdoor_sky import (
    START_UTC_S,
    forcing_of,
    outdoor_weather,
)
from heatsplat.physics.units import KELVIN_AT_0_C

SOUTH_WALL, ROOF = (0.0, -1.0, 0.0), (0.0, -(0.5**0.5), 0.5**0.5)
UP = (0.0, 0.0, 1.0)


@pytest.fixture(autouse=True)
def one_thread():
    """Small tensor operations on a busy machine are faster on one thread than on two that wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@cache
def world(weather: str = "fair") -> OutdoorScene:
    return OutdoorScene(in_weather(OUTDOOR["outdoor"], weather))


@cache
def tiny(weather: str | None = None):
    return Synthetic(scene="outdoor", size="tiny", weather=weather).scene


@cache
def day(*normals: tuple[float, float, float]) -> Forcing:
    return forcing_of(outdoor_weather("fair", 0.0, DAY_S), np.array(normals))


def test_a_thin_sheet_follows_the_balance_of_a_body_of_one_temperature():
    """scipy's stiff solver on one ordinary differential equation, against finite volumes in depth."""
    slabs = [Slab(METAL_ROOF, 0.6, 0), Slab(METAL_ROOF, 0.4, 1)]
    forcing = day(UP, ROOF)
    history = solve(slabs, forcing, 288.0)
    times = np.linspace(600.0, DAY_S, 300)
    for m, slab in enumerate(slabs):

        def rate(t, temperature, slab=slab):
            def at(series):
                return np.interp(t, forcing.times_s, series)

            material = slab.material
            # The product h T_air of the solver is that of two linear functions, and so is this one.
            h = material.convection_still + material.convection_per_wind * at(forcing.wind_m_s)
            taken = slab.absorptivity * at(forcing.sunlight_w_m2[:, slab.face]) + h * (at(forcing.air_k) - temperature)
            waves = at(forcing.long_waves_w_m2[:, slab.face]) - STEFAN_BOLTZMANN * temperature**4
            return (taken + material.emissivity * waves) / material.areal_heat_capacity

        solution = solve_ivp(rate, (0.0, DAY_S), [288.0], "LSODA", times, rtol=1e-8, atol=1e-7, max_step=600.0)
        assert np.abs(history.at(times)[:, m] - solution.y[0]).max() < 0.01
    assert np.ptp(history.surface_k) > 25.0


def test_without_long_waves_it_is_the_linear_conduction_of_the_other_solver():
    material = OutdoorMaterial(0.4, 1.2e6, 0.03, 0.0, 12.0, 0.0)
    times = np.arange(0.0, 7201.0, 600.0)
    still = np.zeros(len(times))
    forcing = Forcing(times, still + 290.0, still, still[:, None] + 500.0, still[:, None])
    history = solve([Slab(material, 0.7, 0)], forcing, 310.0, tolerance_k=0.1)
    linear = heat.solve([heat.Material(0.4, 1.2e6, 0.03, 12.0)], heat.CONSTANT, 7200.0)
    moments = np.linspace(900.0, 7200.0, 40)
    rise = linear.at(moments)[:, 0]
    assert np.abs(history.at(moments)[:, 0] - (290.0 + 20.0 * rise[:, 0] + 350.0 * rise[:, 1])).max() < 5e-3


def test_its_grids_converge_far_below_the_noise_of_the_camera():
    slabs = [Slab(surface.material, surface.absorbs.level, 0) for surface in YARD]
    coarse = solve(slabs, day(UP), 288.0)
    fine = integrate(slabs, day(UP), 288.0, cells=64, steps=24)
    assert coarse.error_k < 0.05
    moments = np.linspace(3600.0, DAY_S, 200)
    assert np.abs(coarse.at(moments) - fine.at(moments)).max() < 0.01


def test_heat_is_conserved():
    """What a slab holds is what it held plus what passed its surface; the integral is done here, not in the solver."""
    slabs = [Slab(surface.material, 0.6, 0) for surface in YARD]
    forcing = day(SOUTH_WALL)
    history = integrate(slabs, forcing, 288.0, cells=40, steps=12)
    t, surface = history.times_s, history.surface_k
    wind, air = np.interp(t, forcing.times_s, forcing.wind_m_s), np.interp(t, forcing.times_s, forcing.air_k)
    sunlight, waves = (np.interp(t, forcing.times_s, s[:, 0]) for s in (forcing.sunlight_w_m2, forcing.long_waves_w_m2))
    depth_share = np.linspace(0.0, 1.0, 41) ** 2
    for m, slab in enumerate(slabs):
        material = slab.material
        h = material.convection_still + material.convection_per_wind * wind
        emitted = STEFAN_BOLTZMANN * surface[:, m] ** 4
        inflow = 0.6 * sunlight + h * (air - surface[:, m]) + material.emissivity * (waves - emitted)
        gained = np.trapezoid(history.states_k[m] - 288.0, depth_share) * material.areal_heat_capacity
        assert gained == pytest.approx(np.trapezoid(inflow, t), abs=2e-3 * np.trapezoid(np.abs(inflow), t))


def test_shades_between_the_solved_ones_are_interpolated_to_a_hundredth_of_the_noise():
    scene = world()
    on = torch.tensor([[0.0, 0.0, 0.0], [3.3, -5.0, 0.0], [-4.0, 2.9, 0.0], [2.5, 9.1, 0.0]], dtype=torch.float64)
    meadow = scene.heat_at(on, torch.zeros(4, dtype=torch.int64))
    assert meadow.absorptivity.max() - meadow.absorptivity.min() > 0.05
    slabs = [Slab(YARD[0].material, float(a), 0) for a in meadow.absorptivity]
    before = forcing_of(outdoor_weather("fair", -0.5 * DAY_S, 0.0), np.array([UP]))
    midnight = integrate(slabs, before, float(before.air_k.mean()), cells=20, steps=4).states_k
    direct = solve(slabs, forcing_of(outdoor_weather("fair"), np.array([UP])), midnight)
    moments = torch.linspace(0.0, 2 * DAY_S, 97, dtype=torch.float64)
    found = scene.celsius(meadow, moments).numpy().T
    assert np.abs(found - (direct.at(moments.numpy()) - KELVIN_AT_0_C)).max() < 5e-4


def test_wind_cools_what_the_sun_warms_and_warms_what_the_sky_cools():
    roof = torch.tensor([[0.9, -1.2, 5.5]], dtype=torch.float64)
    noon, night = torch.tensor([1.47 * DAY_S]), torch.tensor([1.1 * DAY_S])
    at_noon, at_night = ([world(w).truth(roof, t).item() for w in ("calm", "fair", "windy")] for t in (noon, night))
    assert at_noon[0] > at_noon[1] + 3.0 > at_noon[2] + 6.0
    assert at_night[0] < at_night[1] < at_night[2]
    start = torch.tensor([0.0])
    assert world("windy").truth(roof, start).item() == pytest.approx(world().truth(roof, start).item(), abs=1e-6)


def test_the_first_day_trains_and_the_second_tests():
    scene = tiny()
    assert (len(scene.train), len(scene.test)) == (13, 6)
    zero = scene.weather.notes["utc_at_zero_s"]
    days = [[(zero + t) // DAY_S for t in views.times_s] for views in (scene.train, scene.test)]
    assert set(days[0]) == {zero // DAY_S} and set(days[1]) == {zero // DAY_S + 1}
    assert scene.metadata == {"time", "thermal_range", "ambient", "metres", "weather", "labels"}
    assert scene.weather.times_s[0] < 0.0 < scene.test.times_s[-1] < scene.weather.times_s[-1]
    for frame in (*scene.train.frames, *scene.test.frames):
        assert frame.environment == scene.weather.at(frame.time_s)
    mixed = Synthetic(scene="outdoor", size="tiny", frames=9, split="every_8th").scene
    assert len(mixed.test) == 2 and mixed.notes["split"] == "every_8th"


def test_a_longer_record_begins_like_a_short_one_and_holds_out_its_last_day():
    short, long = world(), OutdoorScene(replace(OUTDOOR["outdoor"], duration_s=3 * DAY_S))
    roof, times = torch.tensor([[0.9, -1.2, 5.5]], dtype=torch.float64), torch.tensor([0.2, 0.9, 1.6]) * DAY_S
    # The same solver and the same forcing; only how far it refines is decided by the whole record.
    torch.testing.assert_close(long.truth(roof, times), short.truth(roof, times), rtol=0, atol=0.02)
    scene = Synthetic(scene="outdoor", size="tiny", frames=7, days=3).scene
    zero = scene.weather.notes["utc_at_zero_s"]
    days = [{(zero + t) // DAY_S - zero // DAY_S for t in views.times_s} for views in (scene.train, scene.test)]
    assert days == [{0, 1}, {2}] and (len(scene.train), len(scene.test)) == (5, 2)
    assert scene.weather.times_s[-1] - scene.weather.times_s[0] == 3 * DAY_S


@pytest.mark.parametrize(("hours", "inside"), [((20, 4), lambda h: h >= 20 or h < 4), ((9, 17), lambda h: 9 <= h < 17)])
def test_images_of_some_hours_keep_the_days_that_are_held_out_and_the_weather_of_all(hours, inside):
    scene = Synthetic(scene="outdoor", size="tiny", frames=7, hours=hours).scene
    zero = scene.weather.notes["utc_at_zero_s"]
    for day, views, count in ((0, scene.train, 5), (1, scene.test, 2)):  # as many as of a scene of all hours
        seconds = np.array(views.times_s) + zero
        assert len(views) == count and (np.diff(seconds) > 0).all()
        assert all(inside(hour) for hour in seconds % DAY_S / 3600)
        assert {s // DAY_S - START_UTC_S // DAY_S for s in seconds} == {day}
    assert scene.weather.times_s[-1] - scene.weather.times_s[0] == 2 * DAY_S


def test_hours_are_those_of_a_day():
    for hours in ((20,), (20, 25), (4, 4), (24, 0), 20, "night"):
        with pytest.raises(SceneError, match=r"data.hours=.*the first and the last hour in UTC"):
            Synthetic(scene="outdoor", hours=hours)
    with pytest.raises(SceneError, match="outdoor and outdoor_true know the hour of the day"):
        Synthetic(scene="cooling", hours=(20, 4))


def test_images_show_the_truth_and_every_surface_is_seen():
    scene = tiny()
    errors = []
    for view in (scene.train[0], scene.train[7], scene.test[3]):
        camera = view.camera
        in_camera = scene.points.double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixel = (in_camera @ camera.K.T)[:, :2] / in_camera[:, 2:]
        seen = (pixel > 0).all(1) & (pixel[:, 0] < 64) & (pixel[:, 1] < 52) & (in_camera[:, 2] > 0)
        column, row = pixel[seen].long().unbind(1)
        truth = scene.truth(scene.points, torch.tensor([view.time_s]))[seen, 0]
        errors.append((scene.thermal_range.to_celsius(view.thermal[row, column, 0]) - truth).abs())
        assert view.thermal.min() > 0.0 and view.thermal.max() < 1.0
    assert torch.cat(errors).median() < 0.8  # K; what is hidden behind others makes the tail
    assert scene.notes["probes"] == [surface.name for surface in YARD]
    assert scene.labels.unique().tolist() == sorted({CLASSES.index(surface.label) for surface in YARD})


def test_no_ray_of_a_drone_meets_the_sky():
    scene = world()
    from heatsplat.datamodules.formats.lens import Lens

    lens = Lens(fx=72.0, fy=72.0, cx=32.0, cy=26.0, width=64, height=52, model="PINHOLE")
    corners = pixel_rays(lens, torch.tensor([[0.0, 0.0], [64.0, 0.0], [0.0, 52.0], [64.0, 52.0]], dtype=torch.float64))
    times, viewmats = scene.route(60, 0)
    assert (np.diff(times) > 0).all() and times[0] > 0 and times[-1] < 2 * DAY_S
    for viewmat in viewmats:
        origin = -(viewmat[:3, :3].T @ viewmat[:3, 3])[None]
        _, which = scene.first_hits(origin, corners @ viewmat[:3, :3])
        assert (which >= 0).all()


def test_other_weather_changes_temperatures_and_nothing_else():
    fair, windy = tiny(), tiny("windy")
    assert windy.thermal_range == fair.thermal_range
    assert torch.equal(windy.points, fair.points) and torch.equal(windy.labels, fair.labels)
    assert windy.test.times_s == fair.test.times_s
    assert all(
        torch.equal(a.camera.viewmat, b.camera.viewmat)
        for a, b in zip(windy.test.frames, fair.test.frames, strict=True)
    )
    assert windy.weather.at(1e5).wind_m_s > fair.weather.at(1e5).wind_m_s + 4.0
    assert windy.test.frames[2].environment == windy.weather.at(windy.test.times_s[2])
    colder = fair.test[3].thermal - windy.test[3].thermal  # in the afternoon
    assert fair.thermal_range.span_k * colder.abs().mean() > 1.0


def test_true_attributes_are_those_of_the_materials():
    scene = tiny()
    known = scene.true_attributes(scene.points)
    assert all(values.shape == (600,) for values in known.values())
    roof = known["depth_m"] == METAL_ROOF.depth_m
    assert roof.sum() > 10
    assert (known["areal_heat_capacity_j_m2_k"][roof] == METAL_ROOF.areal_heat_capacity).all()
    assert (known["emissivity"][roof] == METAL_ROOF.emissivity).all()
    assert known["biot"][roof].max() < 1e-3 and known["biot"].max() > 0.5
    assert ((known["absorptivity"] > 0.3) & (known["absorptivity"] < 1.0)).all()
    mean_wind = world().weather.wind_m_s.mean()
    expected = METAL_ROOF.convection_still + METAL_ROOF.convection_per_wind * mean_wind
    assert known["convection_w_m2_k"][roof] == pytest.approx(expected.item())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "outdoor", "weather": "stormy"}, "data.weather=stormy: choose one of fair, calm, windy, overcast"),
        ({"scene": "cooling", "weather": "windy"}, "scene 'cooling' lies in a room without weather"),
    ],
)
def test_bad_weather_is_named(options, message):
    with pytest.raises(SceneError, match=message):
        Synthetic(**options)
