"""Sunlight on oriented surfaces: the sum of the last hours and the tables of what came before."""

import math
from functools import cache

import pytest
import torch

from heatsplat.physics.responses import step_weights
from heatsplat.physics.sunlight import SunlightTable
from heatsplat.training.rng import generator_for
from tests.physics.weather_reference import drivers

RECORD = drivers(days=3.0)


@cache
def table() -> SunlightTable:
    return SunlightTable(RECORD.times_s, RECORD.beams)


def surfaces(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = generator_for(0, 0, "surfaces")
    normals = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    normals[::3, 2] = 0.0  # walls
    log_rates = torch.rand(count, generator=generator, dtype=torch.float64) * math.log(2e5 / 100) - math.log(2e5)
    return torch.nn.functional.normalize(normals, dim=1), log_rates


def test_responses_are_those_of_the_whole_record():
    normals, log_rates = surfaces(1500)
    lit = (normals @ RECORD.beams.T).clamp(min=0)
    response, errors = torch.zeros(1500, dtype=torch.float64), []
    for k in range(len(RECORD.times_s) - 1):
        decay, before, after = step_weights(log_rates.exp(), 600.0)
        response = decay * response + before * lit[:, k] + after * lit[:, k + 1]
        if k % 23 == 0:
            errors.append(table().response(float(RECORD.times_s[k + 1]), normals, log_rates) - response)
    errors_mk = 60_000 * torch.stack(errors).abs()  # of surfaces that the beam heats by 60 K
    assert errors_mk.square().mean().sqrt() < 0.4
    assert errors_mk.flatten().quantile(0.999) < 4
    assert errors_mk.max() < 20


def test_the_first_day_is_exact_between_samples_too():
    normals, log_rates = surfaces(50)
    lit = (normals @ RECORD.beams.T).clamp(min=0)
    response = torch.zeros(50, dtype=torch.float64)
    for k in range(60):
        decay, before, after = step_weights(log_rates.exp(), 600.0)
        response = decay * response + before * lit[:, k] + after * lit[:, k + 1]
    decay, before, after = step_weights(log_rates.exp(), 210.0)
    end = torch.lerp(lit[:, 60], lit[:, 61], 0.35)
    truth = decay * response + before * lit[:, 60] + after * end
    torch.testing.assert_close(table().response(60 * 600.0 + 210.0, normals, log_rates), truth, atol=1e-10, rtol=0)


def test_night_is_exactly_zero():
    normals, log_rates = surfaces(50)
    dark = SunlightTable(RECORD.times_s[:20], RECORD.beams[:20])
    assert (RECORD.beams[:20] == 0).all()
    assert (dark.response(10_000.0, normals, log_rates) == 0).all()
    assert (dark.mean(normals) == 0).all()


def test_derivatives_are_those_of_the_values():
    normals, log_rates = (x.requires_grad_() for x in surfaces(30))

    def response(normals, log_rates):
        return table().response(0.7 * 86400, normals, log_rates)  # later tables are float32

    assert torch.autograd.gradcheck(response, (normals, log_rates), eps=1e-6, atol=1e-6)


def test_mean_light_of_level_surfaces_is_that_of_the_record():
    level = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    truth = torch.trapezoid(RECORD.beams[:, 2].clamp(min=0), RECORD.times_s) / (3 * 86400)
    assert table().mean(level).item() == pytest.approx(truth.item(), rel=1e-3)
