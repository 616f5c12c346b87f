"""Bodies in layers against scipy's stiff solver, a closed form, and the conservation of heat and water."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from heatsplat.datamodules.synthetic_scene import layered_heat as lh
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C, STEFAN_BOLTZMANN

WALL = lh.Body(
    (lh.Layer(0.8, 1.6e6, 0.02), lh.Layer(0.04, 4e4, 0.08), lh.Layer(0.7, 1.4e6, 0.12)), 0.92, 6.0, 3.0, 21.0, 8.0
)
SHEET = lh.Body((lh.Layer(50.0, 3.6e6, 0.0015), lh.Layer(0.04, 4e4, 0.1)), 0.8, 7.0, 3.5)
GRASS = lh.Body((lh.Layer(0.15, 1.2e6, 0.03), lh.Layer(1.4, 2.4e6, 0.6)), 0.97, 8.0, 3.5, 12.0, 2.0, 1.0, 0.3)
BODIES = (WALL, SHEET, GRASS)


def day(rain: float = 0.0, sun: float = 800.0) -> tuple[lh.Sky, lh.Patches]:
    times = np.arange(0.0, DAY_S + 1, 600.0)
    hour = times / 3600.0
    air = 288.0 + 7.0 * np.sin((hour - 9.0) * math.pi / 12)
    light = sun * np.clip(np.sin((hour - 6.0) * math.pi / 12), 0.0, None) * (1.0 - 0.5 * ((hour > 11) & (hour < 12)))
    vapour = np.full(len(times), 0.009)
    falls = np.where((hour > 15) & (hour < 16), rain, 0.0)
    sky = lh.Sky(times, air, 2.0 + np.sin(hour), vapour, falls, 0.8 * STEFAN_BOLTZMANN * air**4)
    patches = lh.Patches(
        np.arange(3), np.array([0.6, 0.5, 0.75]), np.array([0.5, 1.0, 0.9]), np.repeat(light[:, None], 3, 1)
    )
    return sky, patches


def stiff(body: lh.Body, number: int, sky: lh.Sky, patches: lh.Patches, moments: np.ndarray, nodes: int) -> np.ndarray:
    """Surface temperatures of a dry body by scipy, with one unknown a node and no eigenvectors."""
    content, between = lh.volumes(body, nodes)

    def rate(t, kelvin):
        air, wind, vapour, waves, light = (
            np.interp(t, sky.times_s, series)
            for series in (
                sky.air_k, sky.wind_m_s, sky.vapour_kg_m3, sky.long_waves_w_m2, patches.sunlight_w_m2[:, number]
            )
        )  # fmt: skip
        h = body.convection_still + body.convection_per_wind * wind
        celsius = kelvin[0] - KELVIN_AT_0_C
        density = 610.94 * math.exp(17.625 * celsius / (celsius + 243.04)) / (461.5 * kelvin[0])
        evaporated = h / 1200.0 * (density - vapour) * (body.transpires if density > vapour else 1.0)
        share = patches.sky_share[number]
        inflow = patches.absorptivity[number] * light + h * (air - kelvin[0]) - 2.45e6 * evaporated
        inflow += body.emissivity * (share * waves + STEFAN_BOLTZMANN * ((1 - share) * air**4 - kelvin[0] ** 4))
        flow = between * (kelvin[:-1] - kelvin[1:])
        total = np.append(-flow, 0.0) + np.append(0.0, flow)
        total[0] += inflow
        total[-1] -= body.back_w_m2_k * (kelvin[-1] - body.back_c - KELVIN_AT_0_C)
        return total / content

    start = np.full(len(content), 288.0)
    # Each depends on its neighbours alone.
    found = solve_ivp(
        rate, (0.0, DAY_S), start, "LSODA", moments, rtol=1e-7, atol=1e-6, max_step=600.0, lband=1, uband=1
    )
    return found.y[0]


@pytest.fixture
def dry() -> tuple[lh.Body, ...]:
    """The bodies, holding no water: dew falls on them and runs off."""
    return tuple(replace(body, holds_kg_m2=0.0) for body in BODIES)


def test_it_is_the_solution_of_a_stiff_solver(dry):
    sky, patches = day()
    course = lh.solve(dry, patches, sky, 288.0)
    moments = course.times_s[6::12]
    for number, body in enumerate(dry):
        expected = stiff(body, number, sky, patches, moments, lh.NODES_A_LAYER)
        assert np.abs(course.surface_k[6::12, number] - expected).max() < (0.3 if body.layers == SHEET.layers else 0.05)
        fine = lh.solve(dry, patches, sky, 288.0, step_s=60.0).surface_k[30::60, number]
        assert np.abs(fine - expected).max() < 0.03


def test_volumes_in_depth_are_fine_enough(dry):
    sky, patches = day()
    coarse, fine = (lh.solve(dry, patches, sky, 288.0, nodes=n).surface_k for n in (lh.NODES_A_LAYER, 28))
    assert np.abs(coarse - fine).max() < 0.25


def test_a_slab_under_a_steady_flux_warms_as_the_closed_form_says():
    """Carslaw and Jaeger, 2.9(8): a half-space that takes up q from time 0 is 2 q / k sqrt(D t / π) warmer at its surface."""
    ground = lh.Body((lh.Layer(1.0, 2e6, 1.5),), 0.0, 0.0, 0.0)
    times = np.arange(0.0, 6 * 3600.0 + 1, 600.0)
    none = np.zeros(len(times))
    sky = lh.Sky(times, none + 288.0, none, none, none, none)
    course = lh.solve(
        (ground,), lh.Patches(np.zeros(1, int), np.ones(1), np.ones(1), none[:, None] + 100.0), sky, 288.0, nodes=60
    )
    expected = 2 * 100.0 * np.sqrt(1.0 / 2e6 * course.times_s / math.pi)
    assert np.abs(course.surface_k[12:, 0] - 288.0 - expected[12:]).max() < 0.02 * expected[-1]


def test_at_rest_heat_flows_through_all_layers_as_through_resistances():
    times = np.arange(0.0, 60 * DAY_S, 3600.0)
    none = np.zeros(len(times))
    plain = lh.Body(WALL.layers, 0.0, 10.0, 0.0, 21.0, 8.0, 0.0)
    sky = lh.Sky(times, none + 273.15, none, lh.saturated_kg_m3(np.full(len(times), 273.15))[0] * 0, none, none)
    course = lh.solve((plain,), lh.Patches(np.zeros(1, int), np.ones(1), np.ones(1), none[:, None]), sky, 280.0, 3600.0)
    resistances = np.array([1 / 10.0, 0.02 / 0.8, 0.08 / 0.04, 0.12 / 0.7, 1 / 8.0])
    assert course.surface_k[-1, 0] - 273.15 == pytest.approx(21.0 * resistances[0] / resistances.sum(), abs=2e-3)


def test_rain_cools_and_dew_warms_and_no_water_appears_from_nowhere():
    dry_sky, patches = day()
    wet_sky, _ = day(rain=1e-3)
    without, with_rain = lh.solve(BODIES, patches, dry_sky, 295.0), lh.solve(BODIES, patches, wet_sky, 295.0)
    after = (without.times_s > 15.5 * 3600) & (without.times_s < 17 * 3600)
    assert (with_rain.surface_k[after] < without.surface_k[after] + 1e-3).all()
    assert (without.surface_k[after, 0] - with_rain.surface_k[after, 0]).max() > 2.0
    assert (with_rain.film_kg_m2 <= [body.holds_kg_m2 for body in BODIES]).all() and (with_rain.film_kg_m2 >= 0).all()
    # At night the sheet under the sky cools below the dew point: condensation keeps it warmer than dry air would.
    damp, arid = (replace(dry_sky, vapour_kg_m3=factor * dry_sky.vapour_kg_m3) for factor in (1.1, 0.3))
    moist, dry = (lh.solve(BODIES, patches, s, 284.0) for s in (damp, arid))
    night = moist.times_s < 5 * 3600
    assert (moist.surface_k[night, 1] >= dry.surface_k[night, 1] - 1e-3).all()
    assert (moist.surface_k[night, 1] - dry.surface_k[night, 1]).max() > 0.5


def test_moments_outside_of_the_record_are_refused():
    sky, patches = day()
    course = lh.solve(BODIES, patches, sky, 288.0)
    assert course.at(150.0) == pytest.approx(course.surface_k[:2].mean(0))
    with pytest.raises(ValueError, match="heat is solved for"):
        course.at(-10.0)
