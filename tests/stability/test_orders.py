"""Whatever is cut off or stepped through converges at the order it claims."""

import math
from collections.abc import Callable, Sequence

import pytest
import torch

from heatsplat.geometry.resampling import resampled
from heatsplat.physics import energy_balance, planck, relaxation
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.relaxation import temperature
from heatsplat.physics.responses import ResponseTable, cubics, grid_position, interpolate, log_rate_grid
from heatsplat.physics.surfaces import Drivers, Surface
from heatsplat.physics.units import celsius
from heatsplat.sensors import tone
from heatsplat.splats import Splats
from heatsplat.thermal.conduction import _ImplicitStep, laplacian
from heatsplat.thermal.ntr_gaussian import NtrGaussian

DOUBLE = torch.float64


def order(knobs: Sequence[float], error: Callable[[float], float]) -> float:
    """Exponent p of an error that falls like 1/knob^p: the slope of the line through the logarithms."""
    x = torch.tensor([math.log(k) for k in knobs], dtype=DOUBLE)
    y = torch.tensor([math.log(error(k)) for k in knobs], dtype=DOUBLE)
    x, y = x - x.mean(), y - y.mean()
    return -(x * y).sum().item() / (x * x).sum().item()


def series_error(harmonics: int, power: int) -> float:
    """Worst error of a temperature whose periodic source has Fourier coefficients 1/k^power and is cut after K."""

    def solved(count: int) -> torch.Tensor:
        k = torch.arange(1, count + 1, dtype=DOUBLE)
        gains = torch.where(k % 2 == 1, 4 / math.pi / k**power, 0.0)[None]
        rest = torch.zeros_like(gains)
        zero, rate = torch.zeros((), dtype=DOUBLE), torch.tensor([0.3], dtype=DOUBLE)
        moments = torch.linspace(0, 2 * math.pi, 97, dtype=DOUBLE)
        # A source that is even about its jump shows its tail in full; cosines add up where they are all of one sign.
        return torch.cat([temperature(t, zero, zero[None], rate, k, gains, rest) for t in moments])

    return (solved(harmonics) - solved(4096)).abs().max().item()


@pytest.mark.parametrize(("power", "claimed"), [(1, 1.0), (2, 2.0)], ids=["a source that jumps", "a source with kinks"])
def test_harmonics(power, claimed):
    """The body takes one power of k from the source; a sum beyond K then is of order K^-power."""
    assert order([16, 32, 64, 128], lambda k: series_error(k, power)) == pytest.approx(claimed, abs=0.15)


def weather(samples: int = 25) -> tuple[torch.Tensor, torch.Tensor]:
    times = torch.linspace(0, 86400, samples, dtype=DOUBLE)
    return times, 15 * torch.sin(times * 2 * math.pi / 86400) + 4 * torch.sin(times / 3000)


def rate_grid_error(count: int) -> float:
    times, air = weather()
    grid = log_rate_grid(count)
    table = ResponseTable(times, air[:, None], grid)
    log_rates = torch.linspace(math.log(1e-6), math.log(1e-2), 501, dtype=DOUBLE)
    found = interpolate(cubics(table.exact(80_000.0)), *grid_position(log_rates, grid))
    exact = ResponseTable(times, air[:, None], log_rates).exact(80_000.0)
    return (found - exact).abs().max().item()


def test_rate_grid():
    """Cubics through four neighbours: the fourth order."""
    assert order([129, 257, 513, 1025], rate_grid_error) == pytest.approx(4.0, abs=0.3)


def stepped(samples: int, share: float) -> torch.Tensor:
    """Temperatures by steps between samples of one smooth day, its drivers given at so many samples."""
    times = torch.linspace(0, 86400, samples, dtype=DOUBLE)
    air = 10 * torch.sin(times * 2 * math.pi / 86400)
    climate = Climate(Drivers(times, 288.0, air, sky=air - 20))
    rate = torch.tensor([3e-5, 1e-4], dtype=DOUBLE)
    one = torch.ones_like(rate)
    surface = Surface(60 * one, rate.log(), 0 * one, share * one)
    return stepped_temperature(climate, surface, 86400.0)


def test_weather_between_samples():
    """Drivers are taken as linear between samples: the second order in their spacing."""
    fine = stepped(6145, 0.5)
    assert order([24, 48, 96, 192], lambda n: (stepped(n + 1, 0.5) - fine).abs().max().item()) == pytest.approx(
        2.0, abs=0.25
    )


def step_error(parts: int) -> float:
    """Error of the Rosenbrock steps alone: drivers are constant, and the excess of radiation is not linear."""

    def solved(count: int) -> torch.Tensor:
        times = torch.linspace(0, 4000.0, count + 1, dtype=DOUBLE)
        level = torch.zeros(count + 1, dtype=DOUBLE)
        climate = Climate(Drivers(times, 288.0, level, sky=level))
        one = torch.ones(1, dtype=DOUBLE)
        # Four intervals and more are one substep each, so that their number is that of the steps.
        return stepped_temperature(climate, Surface(120 * one, math.log(8e-5) * one, 0 * one, one), 4000.0)

    return (solved(parts) - solved(800)).abs().item()


def test_steps_of_the_radiation_balance():
    """exprb32: the third order."""
    assert order([4, 8, 16], step_error) == pytest.approx(3.0, abs=0.5)


def test_terms_of_the_series(monkeypatch):
    """Every term is smaller than the one before by y/(j + 3): the error falls faster than any order."""
    y = torch.tensor([0.99], dtype=DOUBLE)
    exact = ((1 - y + y * y / 2) - torch.exp(-y)) / y**3

    def error(terms: int) -> float:
        monkeypatch.setattr(relaxation, "_TERMS", terms)
        return (relaxation._exponential_series(y) - exact).abs().item()

    errors = [error(n) for n in (2, 3, 4, 5, 6, 7)]
    for n, (before, after) in enumerate(zip(errors, errors[1:], strict=False), start=2):
        assert after / before == pytest.approx(0.99 / (n + 4), rel=0.15)


def test_levels_of_the_tone_curve():
    """Straight lines between levels of brightness: the second order."""
    image = torch.linspace(0, 1, 1001, dtype=DOUBLE)[None, :, None]

    def error(levels: int) -> float:
        at = torch.linspace(0, 1, levels, dtype=DOUBLE)
        found = tone.corrected(image, torch.stack([torch.sin(3 * at), torch.cos(5 * at)], 1))
        exact = image * (1 + torch.sin(3 * image)) + torch.cos(5 * image)
        return (found - exact).abs().max().item()

    assert order([17, 33, 65, 129, 257], lambda n: error(n)) == pytest.approx(2.0, abs=0.15)


def test_enlarging_an_image():
    """Bilinear and bicubic enlargement of a smooth image, away from its border: the second and the third order."""

    def error(side: int, kernel: str) -> float:
        def drawn(n: int) -> torch.Tensor:
            at = (torch.arange(n, dtype=DOUBLE) + 0.5) / n
            return (torch.sin(4 * at)[:, None] * torch.cos(3 * at))[..., None]

        found = resampled(drawn(side), 4 * side, 4 * side, kernel)
        inner = slice(side, 3 * side)
        return (found - drawn(4 * side))[inner, inner].abs().max().item()

    assert order([16, 32, 64], lambda n: error(n, "bilinear")) == pytest.approx(2.0, abs=0.2)
    assert order([16, 32, 64], lambda n: error(n, "bicubic")) > 2.7


def test_nodes_of_the_cooling_integral():
    """NTR-Gaussian's trapezoid rule over the window: the second order in the spacing of its nodes."""
    generator = torch.Generator().manual_seed(0)
    model = NtrGaussian(width=16, time_frequencies=1).double().eval()
    for parameter in model.parameters():
        parameter.data = torch.randn(parameter.shape, generator=generator, dtype=DOUBLE) * 0.3
    model.range.range_c.copy_(celsius(torch.tensor([283.0, 303.0])))
    model.clock.record.copy_(torch.tensor([0.0, 3600.0]))
    means = torch.rand(20, 3, generator=generator, dtype=DOUBLE)
    feature = torch.rand(20, 8, generator=generator, dtype=DOUBLE)
    shapes = {"log_scales": torch.zeros(20, 3), "quats": torch.ones(20, 4), "opacity_logits": torch.zeros(20, 1)}
    cloud = Splats({"means": means, "feature": feature, **shapes})

    @torch.no_grad()
    def solved(intervals: float) -> torch.Tensor:
        model.nodes = int(intervals) + 1
        return model._units(cloud, None, 3600.0)

    fine = solved(4096)
    assert order([8, 16, 32, 64], lambda n: (solved(n) - fine).norm().item()) == pytest.approx(2.0, abs=0.3)


def test_nodes_of_a_band():
    """Gauss and Legendre's rule on an analytic function: digits grow with the nodes, faster than any order."""
    cold = torch.tensor([20.0], dtype=DOUBLE)
    exact = planck.Band(nodes=64).radiance(cold)
    errors = [abs(planck.Band(nodes=n).radiance(cold) / exact - 1).item() for n in (6, 9, 12, 15)]
    assert errors[0] < 1
    for before, after in zip(errors, errors[1:], strict=False):
        assert after < 0.05 * before
    falls = [math.log(b / a) for b, a in zip(errors, errors[1:], strict=False)]
    assert falls == sorted(falls)


def quadratic(errors: Sequence[float]) -> bool:
    """Whether every error above rounding is that before it squared, times some number that stays alike."""
    factors = [after / before**2 for before, after in zip(errors, errors[1:], strict=False) if after > 1e-13]
    return len(factors) >= 2 and max(factors) < 10 * min(factors)


def test_the_table_of_temperatures_by_radiance(monkeypatch):
    kelvins = torch.logspace(1.5, 3.5, 500, dtype=DOUBLE)
    sent = planck.Band().radiance(kelvins)

    def error(entries: int) -> float:
        monkeypatch.setattr(planck, "ENTRIES", entries)
        return (planck.Band().temperature(sent) / kelvins - 1).abs().max().item()

    assert order([64, 128, 256, 512], error) == pytest.approx(4.0, abs=0.2)


def test_corrections_of_the_mean_balance(monkeypatch):
    """Newton's steps towards the temperature at which the mean balance is even, one more of which gives the result."""
    level = torch.zeros(2, dtype=DOUBLE)
    climate = Climate(Drivers(torch.tensor([0.0, 3600.0], dtype=DOUBLE), 288.0, level, sky=level - 60, light=level + 1))
    one = torch.ones(1, dtype=DOUBLE)
    surface = Surface(0 * one, 0 * one, 150 * one, 0.98 * one)

    def solved(steps: int) -> float:
        monkeypatch.setattr(energy_balance, "NEWTON_STEPS", steps)
        return climate.mean_temperature(surface).item()

    exact = solved(12)
    errors = [abs(solved(steps) - exact) / 288.0 for steps in range(5)]
    assert errors[-1] < 1e-9 and quadratic(errors)


def chain(count: int = 24) -> torch.Tensor:
    """Laplacian of Gaussians in a row."""
    edges = torch.stack([torch.arange(count - 1), torch.arange(1, count)])
    return laplacian(edges, count).double()


def test_steps_of_conduction():
    """Backward Euler: one step errs by the second power of its length, and so many over a time by the first."""
    matrix, start = chain(), torch.sin(torch.arange(24, dtype=DOUBLE) / 4)[:, None]

    def error(steps: int, time: float) -> float:
        values = start
        for _ in range(steps):
            values = _ImplicitStep.apply(values, torch.tensor(time / steps, dtype=DOUBLE), matrix)
        exact = torch.matrix_exp(-time * matrix.to_dense()) @ start
        return (values - exact).abs().max().item()

    assert order([4, 8, 16, 32], lambda n: error(int(n), 2.0)) == pytest.approx(1.0, abs=0.15)
    assert order([8, 16, 32, 64], lambda n: error(1, 2.0 / n)) == pytest.approx(2.0, abs=0.2)
