"""Tables of responses to piecewise-linear drivers, and the temperature of the sky."""

import math

import mpmath
import pytest
import torch

from heatsplat.physics import responses
from heatsplat.physics.sky import dew_point_c, sky_temperature_k, vapour_pressure_hpa


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_weights_of_a_step_add_up_and_meet_their_limits():
    for y in (0.0, 1e-12, 1e-4, 1.0, 700.0):
        decay, before, after = responses.step_weights(tensor(1.0), y)
        assert (decay + before + after).item() == pytest.approx(1.0, abs=1e-15)
        assert min(decay.item(), before.item(), after.item()) >= -1e-16
    _, before, after = responses.step_weights(tensor(1e-4), 1.0)
    assert before.item() == pytest.approx(0.5e-4 - 1e-8 / 3, rel=1e-7)
    assert after.item() == pytest.approx(0.5e-4 - 1e-8 / 6, rel=1e-7)


def test_response_to_a_ramp_is_exact_at_any_rate_and_between_samples():
    times = tensor(0.0, 700.0, 1000.0, 5000.0)  # irregular
    table = responses.ResponseTable(times, 0.01 * times[:, None])
    log_rates = tensor(-math.log(2e6), -math.log(4e3), -math.log(300.0), -math.log(5.0))
    for time in (0.0, 350.0, 1000.0, 4321.0, 5000.0):
        rates = log_rates.exp()
        truth = 0.01 * (time + torch.expm1(-rates * time) / rates)
        found = responses.interpolate(table.at(time).double(), *responses.grid_position(log_rates, table.log_rates))
        torch.testing.assert_close(found[:, 0], truth, atol=5e-4, rtol=0)  # 1e-5 of the driver's range of 50


def test_interpolation_passes_the_derivative_by_the_log_rate():
    times = torch.linspace(0, 86400, 145, dtype=torch.float64)
    table = responses.ResponseTable(times, torch.stack((torch.sin(times / 9000), torch.cos(times / 20000)), 1))
    log_rates = torch.linspace(-14, -5, 40, dtype=torch.float64, requires_grad=True)

    def response(x):
        return responses.interpolate(table.at(50000.0).double(), *responses.grid_position(x, table.log_rates))

    assert torch.autograd.gradcheck(response, log_rates, eps=1e-5, atol=1e-6)


def test_rates_beyond_the_grid_are_those_at_its_ends():
    grid = responses.log_rate_grid()
    cell, x = responses.grid_position(tensor(-50.0, 50.0), grid)
    assert cell.tolist() == [0, len(grid) - 4]
    torch.testing.assert_close(x, tensor(-1.0, 2.0))


def test_mean_of_a_driver_weighs_by_time():
    assert responses.driver_means(tensor(0, 1, 3), tensor(0, 1, 1)[:, None]).item() == pytest.approx(2.5 / 3)


def test_sky_is_colder_than_air_and_warmer_when_damp():
    air = tensor(288.15)
    assert sky_temperature_k(air, None, "swinbank").item() == pytest.approx(270.0, abs=0.1)
    for law in ("brutsaert", "brunt", "berdahl_martin"):
        dry, damp = (sky_temperature_k(air, tensor(x), law).item() for x in (30.0, 90.0))
        assert 255 < dry < damp < 288.15, law
    with pytest.raises(ValueError, match="'brunt' needs the humidity"):
        sky_temperature_k(air, None, "brunt")
    with pytest.raises(ValueError, match="must be one of brutsaert"):
        sky_temperature_k(air, None, "blue")


def test_dew_point_inverts_the_vapour_pressure():
    vapour = vapour_pressure_hpa(tensor(293.15), tensor(100.0))
    assert vapour.item() == pytest.approx(23.3, abs=0.2)
    assert dew_point_c(vapour).item() == pytest.approx(20.0, abs=1e-9)


def semi_infinite(table, a, time):
    """Responses [J] of a body without an end."""
    return responses.interpolate(table.at(time), *responses.grid_position(tensor(a).log(), table.log_rates))[0]


def test_bodies_without_an_end_follow_steps_and_ramps_as_in_closed_form():
    times = torch.linspace(0, 2e5, 401, dtype=torch.float64)
    table = responses.SemiInfiniteTable(times, torch.stack((torch.ones_like(times), times / 1e5), 1))
    for a, time in ((1e-7, 500.0), (1e-5, 4e4), (1e-4, 1.5e5), (3e-3, 1.5e5)):
        z = mpmath.sqrt(a * time)
        left = mpmath.exp(z * z) * mpmath.erfc(z)
        ramp = time - (left - 1) / a - 2 * mpmath.sqrt(time / (mpmath.pi * a))
        truth = tensor(float(1 - left), float(ramp / 1e5))
        torch.testing.assert_close(semi_infinite(table, a, time), truth, atol=1e-6, rtol=0)


def test_effusivity_sets_what_a_flux_does_to_a_massive_wall():
    """Into a wall that hardly gives heat back: 2 q √(t/π) / b after a step, q / (b √ω) of a wave, an eighth of it late."""
    b, exchange, q, omega = 1000.0, 0.2, 100.0, 2 * math.pi / 86400
    a, hours = (exchange / b) ** 2, 3600.0
    times = torch.linspace(0, 40 * 86400, 5761, dtype=torch.float64)
    table = responses.SemiInfiniteTable(times, torch.stack((q + 0 * times, q * torch.sin(omega * times)), 1) / exchange)
    step = 2 * q * math.sqrt(2 * hours / math.pi) / b
    assert float(semi_infinite(table, a, 2 * hours)[0]) == pytest.approx(step, rel=0.02)
    day = 39 * 86400 + torch.arange(0, 24, dtype=torch.float64) * hours
    wave = torch.stack([semi_infinite(table, a, float(time))[1] for time in day])
    sine, cosine = (2 / 24 * (wave * part).sum() for part in (torch.sin(omega * day), torch.cos(omega * day)))
    assert float(torch.hypot(sine, cosine)) == pytest.approx(q / (b * math.sqrt(omega)), rel=0.03)
    assert math.degrees(math.atan2(-float(cosine), float(sine))) == pytest.approx(45.0, abs=1.5)
