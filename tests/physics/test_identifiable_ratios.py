"""What temperatures over a day tell of a surface: the ratios that are its parameters are found again."""

import pytest
import torch

from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.surfaces import Surface
from tests.physics.weather_reference import drivers, solved

MOMENTS = torch.arange(1200.0, 86401.0, 2640.0, dtype=torch.float64)
TIME_CONSTANTS_S = (600.0, 3600.0, 10800.0, 43200.0)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


NORMALS = torch.nn.functional.normalize(tensor(0, 0, 1, 0.3, -0.5, 0.8, -1, 0, 0, 0, 0, 1).reshape(4, 3), dim=1)
TRUTH = Surface(
    start=tensor(-4, -8, 3, -2),
    log_rate=-tensor(*TIME_CONSTANTS_S).log(),
    sun=tensor(55, 45, 50, 40),
    share=tensor(0.3, 0.5, 0.4, 0.35),
    wind=tensor(0.6, 0.3, 0.5, 0.4),
    normals=NORMALS,
)


def surface(raw: torch.Tensor) -> Surface:
    """The surfaces of unbounded parameters [4, 5]."""
    start, log_rate, log_sun, share, wind = raw.unbind(1)
    return Surface(start, log_rate, log_sun.exp(), share.sigmoid(), wind.sigmoid(), NORMALS)


def modelled(climate: Climate, raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Temperatures [4, F] and their derivatives [4, F, 5]: a surface depends on its own row alone."""
    values, slopes = [], []
    for moment in MOMENTS.tolist():
        leaf = raw.clone().requires_grad_()
        x = stepped_temperature(climate, surface(leaf), moment)
        slopes.append(torch.autograd.grad(x.sum(), leaf)[0])
        values.append(x.detach())
    return torch.stack(values, 1), torch.stack(slopes, 1)


@pytest.fixture(scope="module")
def fitted() -> tuple[Surface, torch.Tensor, torch.Tensor]:
    """What Levenberg's method finds in temperatures by Radau, what is left of the residual [4], and the slopes there."""
    climate = Climate(drivers(days=1.0))
    seen = solved(climate.drivers, TRUTH, MOMENTS)
    raw = tensor(0.0, -8.2, 3.7, -0.4, -0.4).repeat(4, 1)  # one start for all: an hour, 40 K, 0.4 and 0.4
    damping = torch.full((4,), 1e-1, dtype=torch.float64)
    values, slopes = modelled(climate, raw)
    for _ in range(40):
        gap = seen - values
        normal = slopes.mT @ slopes
        weight = damping[:, None, None] * torch.diag_embed(normal.diagonal(dim1=1, dim2=2) + 1e-6)
        step = torch.linalg.solve(normal + weight, (slopes.mT @ gap[..., None]))[..., 0]
        tried = raw + step.clamp(-1, 1)
        new_values, new_slopes = modelled(climate, tried)
        better = (seen - new_values).square().sum(1) < gap.square().sum(1)
        raw = torch.where(better[:, None], tried, raw)
        values = torch.where(better[:, None], new_values, values)
        slopes = torch.where(better[:, None, None], new_slopes, slopes)
        damping = torch.where(better, damping / 5, damping * 4).clamp(1e-9, 1e6)
    return surface(raw), (seen - values).abs().amax(1), slopes


def test_all_ratios_are_recovered_from_temperatures_by_another_solver(fitted):
    found, left, _ = fitted
    assert (left < 0.02).all()  # kelvin
    torch.testing.assert_close(found.log_rate, TRUTH.log_rate, atol=0.02, rtol=0)
    torch.testing.assert_close(found.sun, TRUTH.sun, atol=0, rtol=0.02)
    torch.testing.assert_close(found.share, TRUTH.share, atol=0.02, rtol=0)
    torch.testing.assert_close(found.wind, TRUTH.wind, atol=0.03, rtol=0)


def test_one_day_tells_all_four_ratios_apart(fitted):
    """Singular values of the derivatives in kelvin per unit: the weakest combination still moves 33 images by 0.08 K in
    all, the strongest by 50 to 100 K; heavy ground is the hardest (measured: conditions 22, 64, 113 and 586)."""
    _, _, slopes = fitted
    values = torch.linalg.svdvals(slopes[..., 1:])
    condition = values[:, 0] / values[:, -1]
    assert (condition < torch.tensor([50, 150, 250, 1200])).all()
    assert (values[:, -1] > 0.04).all()
