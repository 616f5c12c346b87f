"""The energy balance in closed form and along the record, against a stiff solver over 48 h of ten-minute weather."""

import math
from dataclasses import replace
from itertools import product

import mpmath
import pytest
import torch

from heatsplat.physics import marching
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.surfaces import Core, Drivers, Surface, power_excess
from heatsplat.physics.wetness import vapour_k
from tests.physics.weather_reference import drivers, showers, solved

linear_temperature = Climate.linear_temperature
MOMENTS = torch.arange(0.0, 172801.0, 7900.0, dtype=torch.float64)
FIRST_DAY = MOMENTS[MOMENTS < 86400.0]
OWN = ("start", "log_rate", "sun", "share", "wind")  # the parameters of a surface with nothing behind it
BODY = (*OWN, "normals")
TIME_CONSTANTS_S = (120.0, 600.0, 3600.0, 43200.0)  # thin sheet metal to wet ground


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def bodies(wind: bool) -> Surface:
    normals = tensor(0, 0, 1, 0.3, -0.5, 0.8, -1, 0, 0, 0, 0, 1).reshape(4, 3)
    return Surface(
        start=tensor(15, -8, 3, -2),
        log_rate=-tensor(*TIME_CONSTANTS_S).log(),
        sun=tensor(55, 45, 50, 40),
        share=tensor(0.3, 0.5, 0.4, 0.35),
        wind=tensor(0.6, 0.3, 0.5, 0.4) if wind else None,
        normals=torch.nn.functional.normalize(normals, dim=1),
    )


def course(solution, climate: Climate, surface: Surface, moments: torch.Tensor = FIRST_DAY) -> torch.Tensor:
    return torch.stack([solution(climate, surface, float(t)) for t in moments], dim=1)


def like(surface: Surface, value: float) -> torch.Tensor:
    """A number for each body. An effect that numbers switch off needs no kernel of its own, each of which takes seconds."""
    return torch.full_like(surface.log_rate, value)


@pytest.fixture(scope="module")
def climate() -> Climate:
    return Climate(drivers())


def test_linear_physics_is_exact_to_a_millikelvin(climate):
    surface = bodies(wind=True)
    truth = solved(climate.drivers, surface, FIRST_DAY, about=climate.mean_temperature(surface))
    assert (course(linear_temperature, climate, surface) - truth).abs().max() < 1e-3


def test_corrected_physics_is_exact_to_a_millikelvin_from_sheet_metal_to_wet_ground(climate):
    surface = bodies(wind=True)
    truth = solved(climate.drivers, surface, MOMENTS)
    assert truth.max() - truth.min() > 40  # the weather does heat
    assert (course(stepped_temperature, climate, surface, MOMENTS) - truth).abs().max() < 1e-3
    linear = (course(linear_temperature, climate, surface, MOMENTS) - truth).abs().amax(1)
    assert linear[0] > 1.0  # what the correction is for: sheet metal in gusts
    assert linear[3] < 1.0


def test_gusts_after_a_calm_are_those_of_a_stiff_solver():
    """Air that hardly moves and then does within ten minutes, on bodies that follow it within one."""
    given = drivers(days=0.25)
    wind = torch.full_like(given.air, 0.05)
    wind[[6, 20, 21]] = 10.0  # m/s
    climate = Climate(replace(given, wind_anomaly=wind / wind.mean() - 1))
    surface = bodies(wind=True)._replace(
        log_rate=-tensor(10.0, 30.0, 120.0, 600.0).log(), wind=tensor(0.95, 0.6, 0.8, 0.95)
    )
    moments = torch.arange(0.0, 21_601.0, 150.0, dtype=torch.float64)
    found = marching.march(climate, surface, moments)[..., 0].T
    assert (found - solved(climate.drivers, surface, moments)).abs().max() < 0.005


def test_slow_bodies_lose_nothing_between_samples_a_second_apart():
    given = drivers(days=0.1, step_s=1.0)
    climate = Climate(given)
    surface = bodies(wind=True)._replace(log_rate=tensor(1e-7, 3e-7, 1e-6, 1e-4).log())
    last = given.times_s[-1:]
    exact = marching.march(climate, surface, last)[..., :1]
    assert (exact[0, :, 0] - surface.start)[0].abs() > 0.005  # the slowest has moved, by 1e-6 K a second
    single = Surface(*(x if x is None else x.float() for x in surface[: len(BODY)]))
    found = marching.march(climate, single, last, sensitive=False)
    torch.testing.assert_close(found.double(), exact, atol=2e-5, rtol=0)


def test_wet_surfaces_are_those_of_a_stiff_solver_and_so_are_their_derivatives():
    climate, dry = Climate(showers(drivers())), Climate(drivers())
    surface = bodies(wind=True)._replace(transpires=tensor(0.3, 0.0, 0.6, 1.0))
    moments = torch.arange(0.0, 86_400.0, 900.0, dtype=torch.float64)
    truth = solved(climate.drivers, surface, moments)
    found = marching.march(climate, surface, moments)[..., 0].T
    # While a film dries within minutes, by how warm the surface was before.
    off = (found - truth).abs()
    assert off.max() < 0.4 and off.mean() < 5e-3 and off.median() < 1e-4
    without = marching.march(dry, surface._replace(transpires=None), moments)[..., 0].T
    assert (found - without).abs().max() > 5.0
    at = 20_000.0  # between the shower and the sun that dries
    for name in (*OWN, "transpires"):
        leaf = getattr(surface, name).clone().requires_grad_()
        stepped_temperature(climate, surface._replace(**{name: leaf}), at).sum().backward()
        up, down = (
            stepped_temperature(climate, surface._replace(**{name: leaf.detach() + step}), at) for step in (1e-4, -1e-4)
        )
        assert ((up - down) / 2e-4 - leaf.grad).abs().max() < 0.05 * leaf.grad.abs().max(), name


def test_films_that_dry_in_the_sun_under_hourly_weather_are_those_of_a_stiff_solver():
    given = showers(drivers(days=1.0, step_s=3600.0))
    rain = torch.zeros_like(given.times_s)
    rain[5:7], rain[15:17] = 1.0 / 3600, 2.0 / 3600
    climate, surface = Climate(replace(given, rain=rain)), bodies(wind=True)
    moments = torch.arange(0.0, 86_400.0, 900.0, dtype=torch.float64)
    exact = solved(climate.drivers, surface, moments, atol=1e-7)  # at 1e-8 LSODA gives up where films break up
    off = (marching.march(climate, surface, moments)[..., 0].T - exact).abs()
    assert off.mean() < 0.12 and off.flatten().quantile(0.98) < 1.0 and off.max() < 5.0


def test_what_evaporates_nothing_is_as_without_water():
    """Of no share of transpiration, and of rain that never falls."""
    surface = bodies(wind=True)
    given = showers(drivers())
    dry = course(stepped_temperature, Climate(drivers()), surface)
    for rain in (None, torch.zeros_like(given.rain)):
        climate = Climate(replace(given, rain=rain))
        found = course(stepped_temperature, climate, surface._replace(transpires=like(surface, 0.0)))
        torch.testing.assert_close(found, dry, atol=1e-9, rtol=0)


def test_saturated_vapour_of_the_kernel_is_that_of_the_sky_with_its_derivative():
    """Surfaces that follow the air at once settle where air - x = L (ρ_sat(x) - ρ_v)."""
    given = showers(drivers(days=0.25))
    still = replace(given, rain=None, air=given.air * 0 + 9.0, vapour=given.vapour * 0 + 20.0)
    count = 4
    surface = Surface(tensor(-30, 0, 9, 40), tensor(0.1).log().expand(count), None, transpires=tensor(1, 1, 1, 1))
    x = stepped_temperature(Climate(still), surface, 20_000.0)
    lacks = vapour_k(still.reference_k + x, torch.tensor(100.0)) - 20.0
    torch.testing.assert_close(9.0 - x, lacks.clamp(min=0.0), atol=1e-6, rtol=0)
    assert (x < 8.0).all() and (lacks > 1.0).all()


def test_both_agree_where_nothing_is_nonlinear():
    climate = Climate(drivers())
    surface = bodies(wind=True)
    surface = surface._replace(share=like(surface, 0.0), wind=like(surface, 0.0))
    torch.testing.assert_close(
        course(stepped_temperature, climate, surface),
        course(linear_temperature, climate, surface),
        atol=3e-3,
        rtol=0,
    )


@pytest.mark.parametrize("solution", [linear_temperature, stepped_temperature])
def test_derivatives_by_every_parameter_are_those_of_the_values(climate, solution):
    surface = bodies(wind=True)
    names = BODY if solution is linear_temperature else OWN
    leaves = [getattr(surface, name).clone().requires_grad_() for name in names]
    at = 40_000.0  # the start is still remembered by some
    live = surface._replace(**dict(zip(names, leaves, strict=True)))
    gradients = torch.autograd.grad(solution(climate, live, at).sum(), leaves)
    for name, gradient in zip(names, gradients, strict=True):
        for column in range(3) if name == "normals" else (0,):
            step = torch.zeros_like(getattr(surface, name))
            step[(..., column) if name == "normals" else ...] = 1e-4
            up, down = (
                solution(climate, surface._replace(**{name: getattr(surface, name) + sign * step}), at)
                for sign in (1, -1)
            )
            ours = gradient[:, column] if name == "normals" else gradient
            scale = ours.abs().max().clamp(min=1e-3)
            # Tables are float32, and sensitivities of second order.
            assert ((up - down) / 2e-4 - ours).abs().max() < 0.05 * scale, (name, column)


OFF = {  # what a balance is without, and the same said by numbers to the balance that has everything
    "share": ({"share": None}, {"share": 0.0}),
    "sun and wind": ({"sun": None, "wind": None}, {"sun": 0.0, "wind": 0.0}),
    "wind and normals": ({"wind": None, "normals": None}, {"wind": 0.0, "normals": (0.0, 0.0, 1.0)}),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if "normals" in name else pytest.mark.slow) for name in OFF]
)
def test_time_stepping_without_an_effect_is_that_with_its_parameter_at_zero_and_has_no_column_of_it(name, monkeypatch):
    gone, zeroed = OFF[name]
    if "normals" in name:  # the beam, which a surface without a normal does not see, is then in the light
        climate = Climate(replace(drivers(), beams=None))
    else:
        climate = Climate(drivers())
    columns, march = [], marching.kernels.march
    monkeypatch.setattr(marching.kernels, "march", lambda *given: (columns.append(given[2].shape[1]), march(*given)))
    whole = bodies(wind=True)
    zeros = {key: torch.zeros_like(getattr(whole, key)) + tensor(*([x] if x == 0 else x)) for key, x in zeroed.items()}
    found = []
    for surface in (whole._replace(**gone), whole._replace(**zeros)):
        leaves = [None if x is None else x.clone().requires_grad_() for x in surface[: len(BODY)]]
        x = stepped_temperature(climate, Surface(*leaves), 40_000.0)
        x.sum().backward()
        found.append((x.detach(), leaves))
    assert columns == [9 - sum(4 if key == "normals" else 1 for key in gone), 9]
    torch.testing.assert_close(found[0][0], found[1][0], atol=1e-9, rtol=0)
    for one, other in zip(found[0][1], found[1][1], strict=True):
        if one is not None and one.ndim == 1:
            torch.testing.assert_close(one.grad, other.grad, atol=1e-9, rtol=1e-9)


def test_mean_temperature_balances_the_mean(climate):
    surface = bodies(wind=False)
    mean = climate.mean_temperature(surface)
    beam = climate.beam.mean(surface.normals)
    forcing = climate.forcing(surface, climate.means.double(), beam, 0.0)
    left = (1 - surface.share) * mean + surface.share * power_excess(mean, climate.drivers.reference_k)
    torch.testing.assert_close(forcing, left, atol=1e-6, rtol=0)


def test_only_ratios_are_parameters_and_a_night_separates_convection_from_radiation(climate):
    """At night p alone says how far below the air a light surface lies: (1 - p)(air - x) = p (w(x) - s)."""
    level = tensor(0, 0, 1).expand(2, 3)
    surface = Surface(tensor(0, 0), -tensor(60, 60).log(), tensor(50, 50), tensor(0.2, 0.7), tensor(0, 0), level)
    x = stepped_temperature(climate, surface, 4 * 3600.0)
    air, sky = climate.drivers.air[24], climate.drivers.sky[24]
    rest = (1 - surface.share) * (air - x) + surface.share * (sky - power_excess(x, climate.drivers.reference_k))
    assert rest.abs().max() < 0.2
    assert (air - x)[1] > 2 * (air - x)[0] > 0


def test_cost_does_not_depend_on_the_length_of_the_record():
    """Counted in what the last hours sum, not in seconds: those depend on the machine's neighbours."""
    from heatsplat.physics import sunlight

    lengths = []
    original = sunlight._Recent.apply
    surface = bodies(wind=False)
    try:
        sunlight._Recent.apply = lambda *a: lengths.append(len(a[2])) or original(*a)
        for days in (2, 3, 5):
            climate = Climate(drivers(days=days, wind=False))
            climate.linear_temperature(surface, days * 86400.0 - 1800.0)
            table = climate.table.at(days * 86400.0 - 1800.0)
            assert table.shape == (126, 4, len(climate.columns))
    finally:
        sunlight._Recent.apply = original
    assert len(set(lengths)) == 1
    assert lengths[0] <= 144


def test_extreme_bodies_stay_finite_in_float32():
    climate = Climate(drivers())
    surface = Surface(*(x.float() for x in bodies(wind=True)[: len(BODY)]))._replace(
        log_rate=torch.tensor([math.log(1e-7), math.log(0.1), math.log(0.1), math.log(1e-7)]),
        share=torch.tensor([0.98, 0.02, 0.98, 0.02]),
        sun=torch.tensor([200.0, 200.0, 0.0, 0.0]),
        wind=torch.tensor([0.95, 0.95, 0.0, 0.95]),
    )
    for solution in (linear_temperature, stepped_temperature):
        leaves = [x.clone().requires_grad_() for x in surface[: len(BODY)]]
        x = solution(climate, Surface(*leaves), 130_000.0)
        assert x.isfinite().all()
        assert all(g.isfinite().all() for g in torch.autograd.grad(x.sum(), leaves[:-1]))
    for rate, coupling in product((1e-7, 0.1), (0.02, 50.0)):
        leaves = [torch.full((4,), value).requires_grad_() for value in (0.0, math.log(rate), coupling)]
        for solution in (linear_temperature, stepped_temperature):
            behind = {"core": Core(*leaves), "inner": like(surface, 0.0)}
            x = solution(climate, surface._replace(**behind), 130_000.0)
            assert x.isfinite().all()
            assert all(g.isfinite().all() for g in torch.autograd.grad(x.sum(), leaves))


CORES = Core(tensor(10, -3, 0, 4), -tensor(1800.0, 7200.0, 40_000.0, 300_000.0).log(), tensor(0.3, 1.5, 8.0, 0.8))


WITHIN = tensor(0.5, 2, -1, 4)
BEHIND = {  # what surfaces may have behind them
    "core": {"core": CORES},
    "heat": {"inner": WITHIN},
    "core and heat": {"core": CORES, "inner": WITHIN},
    "room": {"inner": WITHIN},
    "core and room": {"core": CORES, "inner": WITHIN},
}
ROOM_K = 6.0  # above the mean air; it lets out what surfaces take of it, -1 K stays as it is


def among(climate: Climate, name: str) -> Climate:
    return Climate(replace(climate.drivers, room=ROOM_K)) if "room" in name else climate


each_thing_behind = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if " and " in name else pytest.mark.slow) for name in BEHIND]
)


@each_thing_behind
def test_what_lies_behind_surfaces_is_that_of_a_stiff_solver(climate, name):
    climate, surface = among(climate, name), bodies(wind=True)._replace(**BEHIND[name])
    full = course(stepped_temperature, climate, surface)
    assert (full - solved(climate.drivers, surface, FIRST_DAY)).abs().max() < 1e-3
    linear = course(linear_temperature, climate, surface)
    about = solved(climate.drivers, surface, FIRST_DAY, about=climate.mean_temperature(surface))
    assert (linear - about).abs().max() < 3e-3
    plain = course(stepped_temperature, climate, bodies(wind=True))
    assert ((full - plain).abs().amax(1) > 0.3).all()  # it does something
    assert (full - linear).abs().max() > 0.5


def test_cores_from_those_that_follow_at_once_to_those_that_never_do_are_solved(climate):
    """Both nodes of the stiffest body settle within seconds, those of the slowest hardly in the record."""
    core = Core(tensor(20, -20, 20, -20), tensor(0.1, 0.1, 1e-7, 1e-7).log(), tensor(50, 0.02, 50, 0.02))
    surface = bodies(wind=True)._replace(core=core, log_rate=tensor(0.1, 1e-6, 1e-2, 1e-4).log())
    truth = solved(climate.drivers, surface, FIRST_DAY)
    surface = surface._replace(inner=like(surface, 0.0))
    found = course(stepped_temperature, climate, surface)
    assert (found - truth).abs().max() < 3e-3
    single = marching.with_parameters(surface, {k: v.float() for k, v in marching.parameters(surface).items()})
    single = single._replace(normals=surface.normals.float())
    assert (course(stepped_temperature, climate, single) - found).abs().max() < 0.02


def test_a_core_that_hardly_couples_or_follows_at_once_is_no_core(climate):
    surface = bodies(wind=True)
    plain = course(linear_temperature, climate, surface)
    faint = surface._replace(core=CORES._replace(coupling=torch.full_like(CORES.coupling, 1e-9)))
    torch.testing.assert_close(course(linear_temperature, climate, faint), plain, atol=1e-3, rtol=0)
    stepped, faint = course(stepped_temperature, climate, surface), faint._replace(inner=like(surface, 0.0))
    torch.testing.assert_close(course(stepped_temperature, climate, faint), stepped, atol=1e-6, rtol=0)


@pytest.mark.parametrize("solution", [linear_temperature, stepped_temperature])
@each_thing_behind
def test_derivatives_are_those_of_the_values_with_what_lies_behind(climate, name, solution):
    climate, surface, at = among(climate, name), bodies(wind=True)._replace(**BEHIND[name]), 40_000.0
    values = marching.parameters(surface)
    leaves = {key: value.clone().requires_grad_() for key, value in values.items()}
    solution(climate, marching.with_parameters(surface, leaves), at).sum().backward()
    for key, leaf in leaves.items():
        up, down = (
            solution(climate, marching.with_parameters(surface, values | {key: values[key] + sign * 1e-4}), at)
            for sign in (1, -1)
        )
        scale = max(float(leaf.grad.abs().max()), 1e-3)  # float32 tables; sensitivities of second order
        torch.testing.assert_close((up - down) / 2e-4, leaf.grad, atol=0.05 * scale, rtol=0.0, msg=key)


def test_the_sun_on_bodies_without_an_end_is_what_their_table_makes_of_the_same_light(climate):
    given = climate.drivers
    up = tensor(0, 0, 1)
    lit = (given.beams @ up).clamp(min=0)
    bare = {"sky": None, "around": None, "wind_anomaly": None}
    beams = Climate(replace(given, beams=lit[:, None] * up, light=None, **bare), semi_infinite=True)
    level = Climate(replace(given, beams=None, light=lit, up=None, **bare), semi_infinite=True)
    surface = Surface(tensor(0, 5, -3), tensor(1e-6, 3e-5, 1e-3).log(), tensor(60, 60, 60), normals=up.expand(3, 3))
    truth = course(linear_temperature, level, surface._replace(normals=None))
    assert truth.max() > 20
    assert (course(linear_temperature, beams, surface) - truth).abs().max() < 0.2  # K, of 60 K in full sun


@pytest.mark.parametrize("semi_infinite", [False, True])
def test_a_room_warms_cold_surfaces_more_and_its_mean_heat_is_that_of_the_mean_surface(climate, semi_infinite):
    constant, there = (Climate(replace(climate.drivers, room=room), semi_infinite) for room in (None, ROOM_K))
    surface = bodies(wind=True)._replace(inner=WITHIN)
    lost, mean = there.mean_heat_from_within(surface), there.mean_temperature(surface)
    lets = WITHIN > 0
    torch.testing.assert_close(lost[lets], (WITHIN * (1 - mean / ROOM_K))[lets])
    torch.testing.assert_close(lost[~lets], WITHIN[~lets])
    as_constant = constant.mean_temperature(surface._replace(inner=lost))
    torch.testing.assert_close(as_constant, mean, atol=1e-4, rtol=0)
    assert constant.mean_heat_from_within(surface) is surface.inner


@pytest.mark.parametrize("semi_infinite", [False, True])
def test_heat_from_within_is_a_driver_that_never_changes(climate, semi_infinite):
    there = Climate(climate.drivers, semi_infinite)
    without = bodies(wind=True)
    inner = tensor(0.5, 2, 0, 4)
    heated = without._replace(inner=inner)
    rise = there.mean_temperature(heated) - there.mean_temperature(without)
    assert (rise[[0, 1, 3]] > 0.7 * inner[[0, 1, 3]]).all() and (rise < 1.3 * inner + 1e-9).all()
    late = there.linear_temperature(heated, 172800.0) - there.linear_temperature(without, 172800.0)
    assert (late[2].abs() < 1e-9) and (late[[0, 1, 3]] > 0.2).all()
    if semi_infinite:
        with pytest.raises(ValueError, match="bodies without an end are solved about a mean only"):
            stepped_temperature(there, heated, 3600.0)


def at_rest(semi_infinite: bool) -> Climate:
    """A day on which nothing happens, so that bodies lose what they start with."""
    times = tensor(0, 43200, 86400)
    return Climate(Drivers(times, 290.0, torch.zeros_like(times)), semi_infinite)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_slope_of_what_bodies_without_an_end_keep_has_all_digits(dtype):
    """x² = a t, of which e^{x²} erfc(x) is kept; its slope is the difference of two numbers that agree in most digits."""
    x = torch.tensor([1e-3, 0.3, 3.0, 10.0, 49.0, 51.0, 294.0, 1776.0, 1e5], dtype=torch.float64)
    log_rate = (x.square() / 86400.0).log().to(dtype).requires_grad_()
    kept = at_rest(True).linear_temperature(Surface(torch.ones_like(log_rate), log_rate, None), 86400.0)
    kept.sum().backward()
    with mpmath.workdps(60):
        exact = [mpmath.sqrt(mpmath.exp(mpmath.mpf(rate)) * 86400) for rate in log_rate.tolist()]
        slopes = [float(y / 2 * (2 * y * erfcx(y) - 2 / mpmath.sqrt(mpmath.pi))) for y in exact]
        values = [float(erfcx(y)) for y in exact]
    rtol = {torch.float32: 2e-6, torch.float64: 1e-11}[dtype]  # the type's rounding of log a, times 10
    torch.testing.assert_close(kept.detach(), torch.tensor(values, dtype=dtype), rtol=rtol, atol=0)
    torch.testing.assert_close(log_rate.grad, torch.tensor(slopes, dtype=dtype), rtol=rtol, atol=0)


def erfcx(x):
    """e^{x²} erfc(x) in mpmath; by its continued fraction where e^{x²} is too large."""
    if x < 20:
        return mpmath.exp(x * x) * mpmath.erfc(x)
    below = x
    for k in range(60, 0, -1):
        below = x + mpmath.mpf(k) / 2 / below
    return 1 / (mpmath.sqrt(mpmath.pi) * below)


@pytest.mark.parametrize("coupling", [1.0, 1e4, 1e8, 1e12])
def test_float32_knows_how_slowly_a_tightly_coupled_core_cools(coupling):
    """s beside κ, which one minus a share of κ would lose; against the two roots in 60 digits."""
    rate, behind = torch.tensor([1e-3]).log(), torch.tensor([1e-5 * coupling]).log()
    core = Core(torch.ones(1), behind, torch.tensor([coupling]))
    found = at_rest(False).linear_temperature(Surface(torch.ones(1), rate, None, core=core), 86400.0)
    with mpmath.workdps(60):
        r, mu = (mpmath.exp(log.item()) for log in (rate, behind))
        half = (r * (1 + core.coupling.item()) + mu) / 2
        root = mpmath.sqrt(half**2 - r * mu)
        slow = (half + root - r) / (2 * root)  # share of what cools slowly, from x' = -r at the beginning
        kept = slow * mpmath.exp((root - half) * 86400) + (1 - slow) * mpmath.exp((-half - root) * 86400)
    assert found.item() == pytest.approx(float(kept), rel=1e-5)
