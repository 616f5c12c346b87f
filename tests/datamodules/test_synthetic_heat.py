"""The conduction solver against series solutions, its energy balance and its order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erfcx

from heatsplat.datamodules.synthetic_scene import presets
from heatsplat.datamodules.synthetic_scene.heat import CONSTANT, Material, Waveform, integrate, periodic, solve

DURATION_S = 1800.0
EXCESS_K, FLUX_W_M2 = 40.0, 1000.0
FOAM = Material(conductivity=0.04, heat_capacity=5e4, depth_m=0.02, exchange=20.0)
MATERIALS = [
    presets.WOOD,
    presets.ALUMINIUM,
    presets.STEEL,
    presets.CERAMIC,
    presets.RUBBER,
    presets.PLASTIC,
    presets.PLASTER,
    presets.LINOLEUM,
]
LAMP = periodic(period_s=600.0, on_s=300.0, ramp_s=120.0, duration_s=DURATION_S)


def series(material: Material, terms: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes and rates of the surface of a slab that cools through its front (Carslaw and Jaeger, section 3.11).

    θ_s(t) / θ_0 = Σ A_n exp(-r_n t) with β_n tan β_n = h L / k and r_n = α β_n² / L².
    """
    biot = material.exchange * material.depth_m / material.conductivity
    low = np.arange(terms) * np.pi
    high = low + 0.5 * np.pi
    sign = (-1.0) ** np.arange(terms)
    for _ in range(80):
        middle = 0.5 * (low + high)
        above = (middle * np.sin(middle) - biot * np.cos(middle)) * sign > 0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    beta = 0.5 * (low + high)
    amplitude = 4.0 * np.sin(beta) / (2.0 * beta + np.sin(2.0 * beta)) * np.cos(beta)
    rate = material.conductivity / material.heat_capacity * (beta / material.depth_m) ** 2
    return amplitude, rate


def cooled(material: Material, times_s: np.ndarray) -> np.ndarray:
    amplitude, rate = series(material)
    return np.exp(-np.outer(times_s, rate)) @ amplitude


def heated(material: Material, waveform: Waveform, times_s: np.ndarray) -> np.ndarray:
    """Surface under a piecewise linear flux: its slopes times the response to a ramp, which is Σ over the series."""
    amplitude, rate = series(material)

    def ramp(t: np.ndarray) -> np.ndarray:
        t = np.maximum(t, 0.0)
        return (t - (-np.expm1(-np.outer(t, rate)) / rate) @ amplitude) / material.exchange

    times, levels = np.array(waveform.times_s), np.array(waveform.levels)
    slopes = np.concatenate([[0.0], np.diff(levels) / np.diff(times), [0.0]])
    return sum(change * ramp(times_s - knot) for knot, change in zip(times, np.diff(slopes), strict=True))


def moments() -> np.ndarray:
    """Early and late moments, none of them a node of the solver."""
    return np.concatenate([np.geomspace(1e-2, 10.0, 20), np.linspace(11.3, DURATION_S, 60)])


def test_reference_series_agrees_with_the_half_space_while_the_back_is_not_reached():
    thick = Material(conductivity=1.4, heat_capacity=2e6, depth_m=0.5, exchange=15.0)
    times = np.geomspace(1.0, 3000.0, 15)
    x = thick.exchange * np.sqrt(times / (thick.conductivity * thick.heat_capacity))
    np.testing.assert_allclose(cooled(thick, times), erfcx(x), atol=1e-6)


@pytest.mark.parametrize("waveform", [CONSTANT, LAMP], ids=["constant", "periodic"])
def test_solver_agrees_with_the_series_to_a_millikelvin(waveform):
    responses = solve(MATERIALS, waveform, DURATION_S)
    assert responses.error <= 1e-3
    times = moments()
    got = responses.at(times)
    for m, material in enumerate(MATERIALS):
        u = cooled(material, times)
        v = (1.0 - u) / material.exchange if waveform is CONSTANT else heated(material, waveform, times)
        assert np.abs(got[:, m, 0] - u).max() * EXCESS_K < 1e-3
        assert np.abs(got[:, m, 1] - v).max() * FLUX_W_M2 < 1e-3


def test_solver_manages_foam_whose_surface_drops_at_once():
    responses = solve([FOAM], CONSTANT, DURATION_S)
    times = moments()
    assert np.abs(responses.at(times)[:, 0, 0] - cooled(FOAM, times)).max() * EXCESS_K < 1e-3
    assert responses.at(np.array([0.0]))[0, 0] == pytest.approx([1.0, 0.0], abs=1e-12)


def test_heat_is_conserved():
    """What a slab holds is what it held plus what passed its surface; the integral is done here, not in the solver."""
    responses = solve(MATERIALS, LAMP, DURATION_S)
    capacity = np.array([m.heat_capacity * m.depth_m for m in MATERIALS])
    exchange = np.array([m.exchange for m in MATERIALS])
    assert responses.stored[0, :, 0] == pytest.approx(capacity, rel=1e-9)
    assert np.abs(responses.stored[0, :, 1]).max() == 0.0
    fine = np.concatenate(
        [[0.0], *(a + (b - a) * np.linspace(0, 1, 4001)[1:] ** 4 for a, b in zip(*_between(responses), strict=True))]
    )
    surface = responses.at(fine)
    inflow = np.stack([np.zeros_like(fine), LAMP(fine)], axis=1)[:, None, :] - exchange[:, None] * surface
    passed = (0.5 * (inflow[1:] + inflow[:-1]) * np.diff(fine)[:, None, None]).sum(0)
    gained = responses.stored[-1] - responses.stored[0]
    assert np.abs(gained - passed)[:, 0] / capacity == pytest.approx(0.0, abs=2e-5)
    assert np.abs((gained - passed)[:, 1]).max() < 2e-5 * np.trapezoid(LAMP(fine), fine)


def _between(responses) -> tuple[np.ndarray, np.ndarray]:
    knots = responses.times_s[responses.pieces]
    return knots[:-1], knots[1:]


def test_convergence_is_of_second_order():
    times = np.linspace(30.0, DURATION_S, 50)
    truth = np.stack([np.stack([cooled(m, times), heated(m, LAMP, times)], axis=1) for m in MATERIALS], axis=1)
    errors = [np.abs(integrate(MATERIALS, LAMP, DURATION_S, n, n).at(times) - truth).max(axis=0) for n in (32, 64, 128)]
    orders = np.log2(np.stack(errors[:-1]) / np.stack(errors[1:]))
    assert orders.min() > 1.8
    assert np.median(orders) < 2.4  # not by accident of an error that is rounding already


def test_heat_that_balances_the_loss_keeps_a_surface_steady():
    responses = solve(MATERIALS, CONSTANT, DURATION_S)
    exchange = np.array([m.exchange for m in MATERIALS])
    rise = responses.surface[..., 0] + exchange * responses.surface[..., 1]
    assert np.abs(rise - 1.0).max() < 1e-5


def test_materials_do_not_influence_each_other():
    together = solve(MATERIALS, LAMP, DURATION_S, tolerance=1e-3)
    alone = solve([presets.WOOD], LAMP, DURATION_S, tolerance=1e-3)
    times = moments()
    assert np.abs(together.at(times)[:, 0] - alone.at(times)[:, 0]).max() * FLUX_W_M2 < 2e-3


def test_periodic_source_has_its_width_at_half_height():
    wave = periodic(period_s=100.0, on_s=40.0, ramp_s=10.0, duration_s=300.0)
    assert wave(np.array([0.0, 5.0, 10.0, 40.0, 45.0, 50.0, 100.0, 205.0])) == pytest.approx(
        [0, 0.5, 1, 1, 0.5, 0, 0, 0.5]
    )
    with pytest.raises(ValueError, match="no room for 95.0 s on with ramps of 10.0 s"):
        periodic(100.0, 95.0, 10.0, 300.0)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="depth_m > 0, got 0"):
        Material(1.0, 1e6, 0.0, 10.0)
    responses = integrate([presets.WOOD], CONSTANT, 100.0, 8, 8)
    with pytest.raises(ValueError, match="solved for 0 .. 100 s of this scene; asked for -1 .. 5 s"):
        responses.at(np.array([-1.0, 5.0]))
    with pytest.raises(RuntimeError, match="did not converge"):
        solve([presets.WOOD], CONSTANT, 100.0, tolerance=1e-15)
