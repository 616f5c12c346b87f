"""The balance of heat of a small body: equilibria, known numbers, and digits against fifty."""

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.physics.heat_flow import fourth_powers, heating_rate
from heatsplat.physics.units import STEFAN_BOLTZMANN

STONE = {"emissivity": torch.tensor(0.9), "convection": torch.tensor(8.0), "capacity": torch.tensor(2.4e6)}


def sphere(radius_m: float) -> dict:
    return {"radiating_ratio": torch.tensor(3 / radius_m), "convecting_ratio": torch.tensor(0.75 / radius_m)}


def test_the_difference_of_fourth_powers_keeps_its_digits():
    warm, cold = torch.tensor(300.0), torch.tensor(299.9)
    with mpmath.workdps(50):
        truth = float(mpmath.mpf(warm.item()) ** 4 - mpmath.mpf(cold.item()) ** 4)
    assert abs(fourth_powers(warm, cold).item() / truth - 1) < 3e-7
    assert abs((warm**4 - cold**4).item() / truth - 1) > 1e-5


def test_nothing_happens_at_the_temperature_of_everything_around():
    rate = heating_rate(torch.tensor(290.0), absorbed_w_m3=0.0, **STONE, **sphere(0.1), air_k=290.0, sky_k=290.0)
    assert rate.item() == 0.0


def test_a_stone_under_empty_space_cools_as_numerics_say():
    """A sphere of 10 cm at 300 K loses 18 K/h by its own radiation alone."""
    rate = heating_rate(torch.tensor(300.0), absorbed_w_m3=0.0, **STONE, **sphere(0.1), air_k=300.0)
    assert 3600 * rate.item() == pytest.approx(-18.6, abs=0.1)


def test_the_sun_warms_what_would_else_stand_still():
    """600 W/m² on the shadow of a sphere of 10 cm, πr²/V = 7.5 1/m, 0.7 of it taken in: 3.15 kW/m³ into 2.4 MJ/(m³ K)."""
    at_rest = dict(**STONE, **sphere(0.1), air_k=290.0, sky_k=290.0)
    rate = heating_rate(torch.tensor(290.0), absorbed_w_m3=0.7 * 7.5 * 600.0, **at_rest)
    assert rate.item() == pytest.approx(3150 / 2.4e6, rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    kelvin=st.floats(200, 400, width=32),
    air=st.floats(220, 330),
    absorbed=st.floats(0, 1e5, width=32),
    axis=st.floats(0.01, 10),
    sky=st.sampled_from([0.0, 230.0, 299.0]),
)
def test_rates_agree_with_fifty_digits(kelvin, air, absorbed, axis, sky):
    areas = sphere(axis)
    got = heating_rate(
        torch.tensor(kelvin), absorbed_w_m3=torch.tensor(absorbed), **STONE, **areas, air_k=air, sky_k=sky
    )
    with mpmath.workdps(50):
        exact = {name: mpmath.mpf(value.item()) for name, value in (STONE | areas).items()}
        t, radiating = mpmath.mpf(kelvin), exact["emissivity"] * exact["radiating_ratio"]
        radiated = radiating * mpmath.mpf(STEFAN_BOLTZMANN) * (t**4 - mpmath.mpf(sky) ** 4)
        convected = exact["convection"] * exact["convecting_ratio"] * (t - mpmath.mpf(air))
        truth = (mpmath.mpf(absorbed) - radiated - convected) / exact["capacity"]
        size = (mpmath.mpf(absorbed) + abs(radiated) + abs(convected) + radiating * 100) / exact["capacity"]
    # The parts may cancel, and air and sky are rounded to float32: errors count against the parts, not their sum.
    assert abs(got.item() - float(truth)) <= 2e-6 * float(size)
