"""Full balances fitted to points, beside bodies that a stiff solver integrated."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from weathered import HOUR_S, make_weather

from heatsplat.effects.full_balance import MODEL_K, WAYS, FullBalance
from heatsplat.effects.joint.held_out import WORST, compared
from heatsplat.kernels.heat_balance import COVERS_MM
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN, kelvin
from heatsplat.physics.wetness import FILM_MM, drying_mm_s_k, vapour_k

POINTS, FRAMES, NOISE_K = 24, 40, 0.1
EXCHANGE = 8.0  # W/(m² K) with the air at the mean wind, of which half comes of it
WEATHER = make_weather(direct_w_m2=None, diffuse_w_m2=None, sun=None)


def sky(clouds) -> torch.Tensor:
    """Temperature [T] of a sky of which clouds close this share."""
    return sky_temperature_k(kelvin(WEATHER.air_c), WEATHER.humidity_percent, "brutsaert", clouds)


PASSING = sky(0.5 + 0.5 * torch.sin(2.0 * torch.pi * WEATHER.times_s / (5.0 * HOUR_S)))


@cache
def seen() -> tuple[torch.Tensor, torch.Tensor]:
    """Times [F] of frames, and temperatures [P, F] of level bodies with a core under PASSING, in °C."""
    draw = np.random.default_rng(0).uniform
    moments = np.sort(draw(0.0, 18.0 * HOUR_S, FRAMES))
    times = WEATHER.times_s.numpy()
    series = [kelvin(WEATHER.air_c), PASSING, WEATHER.irradiance_w_m2, WEATHER.wind_m_s / WEATHER.wind_m_s.mean()]
    values = []
    for _ in range(POINTS):
        takes, emits, capacity, core = draw(0.3, 0.9), draw(0.8, 0.97), draw(1e4, 6e4), draw(1e5, 4e5)

        def change(time, state, takes=takes, emits=emits, capacity=capacity, core=core):
            air, sky_k, light, wind = (np.interp(time, times, one) for one in series)
            inwards = 6.0 * (state[0] - state[1])
            heat = takes * light + emits * STEFAN_BOLTZMANN * (sky_k**4 - state[0] ** 4)
            heat += EXCHANGE * (0.5 + 0.5 * wind) * (air - state[0]) - inwards
            return np.array([heat / capacity, inwards / core])

        start = np.array([290.0 + draw(-4.0, 4.0), 288.0])
        course = solve_ivp(
            change, (times[0], moments[-1]), start, "LSODA", moments, rtol=1e-7, atol=1e-5, max_step=HOUR_S / 4
        )
        values.append(course.y[0] - KELVIN_AT_0_C)
    return torch.from_numpy(moments), torch.from_numpy(np.array(values))


def under(rain_mm_h, plants=0.0) -> torch.Tensor:
    """Temperatures [P, F] in °C, with noise, of light bodies without a core that keep 0.3 mm of this rain [T] and, where they are
    dry, evaporate the share ``plants``; steps of 20 s."""
    moments, generator = seen()[0], torch.Generator().manual_seed(4)
    takes, capacity = torch.rand(2, POINTS, generator=generator, dtype=torch.float64)
    takes, capacity = 0.3 + 0.6 * takes, 1e4 + 3e4 * capacity
    series = [
        kelvin(WEATHER.air_c),
        PASSING,
        WEATHER.irradiance_w_m2,
        WEATHER.wind_m_s / WEATHER.wind_m_s.mean(),
        rain_mm_h,
    ]
    series += [vapour_k(kelvin(WEATHER.air_c), WEATHER.humidity_percent), drying_mm_s_k(WEATHER)]
    steps = np.arange(float(WEATHER.times_s[0]), float(moments[-1]) + 20.0, 20.0)
    courses = np.stack([np.interp(steps, WEATHER.times_s, one) for one in series]).T
    state, film, values = torch.full_like(takes, courses[0, 0]), torch.zeros_like(takes), []
    for air, sky_k, light, wind, rain, vapour, dries in courses.tolist():
        values.append(state)
        gap, covered = vapour_k(state, torch.full_like(state, 100.0)) - vapour, (film / COVERS_MM).clamp(max=1.0)
        heat = takes * light + 0.95 * STEFAN_BOLTZMANN * (sky_k**4 - state**4)
        heat += EXCHANGE * (0.5 + 0.5 * wind) * (air - state - (covered + (1.0 - covered) * plants) * gap)
        film = (film + 20.0 * (rain / 3600.0 - covered * dries * gap)).clamp(0.0, FILM_MM)
        state = state + 20.0 * heat / capacity
    at = np.rint((moments.numpy() - steps[0]) / 20.0)
    noise = torch.randn(POINTS, FRAMES, generator=generator, dtype=torch.float64)
    return torch.stack(values)[at].T - KELVIN_AT_0_C + NOISE_K * noise


def balance(sky_k=PASSING, weather=WEATHER, **changed) -> FullBalance:
    """Of these bodies, with noise."""
    moments, values = seen()
    noise = torch.randn(values.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ones = torch.ones_like(values)
    parts = {"values": values + NOISE_K * noise, "errors": NOISE_K * ones, "weights": ones, "normals": None}
    return FullBalance(weather, sky_k, moments, **(parts | changed))


def test_bodies_are_foreseen_within_twice_the_noise():
    left = balance().left_out
    assert left.square().mean().sqrt() < 2.0 * NOISE_K
    assert left.abs().median() < 1.2 * 0.67 * NOISE_K


def test_the_sky_that_there_was_foresees_better():
    there, clear = (balance(sky_k).left_out for sky_k in (PASSING, sky(0.0)))
    gain = compared(there**2, clear**2, torch.ones_like(there))
    assert gain.db > 1.0 and gain.sigmas > 3.0, gain


def test_what_is_not_seen_does_not_count():
    moments, values = seen()
    weights = torch.ones_like(values)
    weights[:, ::5] = 0.0
    wrong = torch.where(weights > 0, balance().values, 500.0)
    spoilt, kept = (balance(values=one, weights=weights).left_out[:, 1::5] for one in (wrong, balance().values))
    torch.testing.assert_close(spoilt, kept, rtol=0.0, atol=0.0)


def test_frames_in_any_order_and_a_long_record_before_them_change_nothing():
    order = torch.randperm(FRAMES, generator=torch.Generator().manual_seed(2))
    one = balance()
    mixed = replace(
        one, times_s=one.times_s[order], **{n: getattr(one, n)[:, order] for n in ("values", "errors", "weights")}
    )
    torch.testing.assert_close(mixed._climate.drivers.air, one._climate.drivers.air)
    numbers = one._expected
    torch.testing.assert_close(mixed._temperatures(numbers)[0], one._temperatures(numbers)[0][:, order], rtol=0, atol=0)
    days = torch.arange(-40.0, -1.0, dtype=torch.float64) * 86400.0

    def before(series):
        return torch.cat([torch.full_like(days, float(series[0])), series])

    names = ("air_c", "wind_m_s", "humidity_percent", "irradiance_w_m2")
    longer = replace(
        WEATHER,
        times_s=torch.cat([days, WEATHER.times_s]),
        pressure_hpa=None,
        **{n: before(getattr(WEATHER, n)) for n in names},
    )
    since = balance(before(PASSING), longer)._climate.drivers.times_s
    assert len(since) == len(WEATHER.times_s) + 9


def test_frames_of_one_moment_agree_and_those_beyond_the_record_are_at_its_ends():
    whole, (first, last) = balance(), WEATHER.times_s[[0, -1]].tolist()
    times = whole.times_s.clone()
    times[3], times[0], times[1], times[-1], times[-2] = times[2], first, first - 5000.0, last, last + 30 * 86400.0
    found = replace(whole, times_s=times)._temperatures(whole._expected)[0]
    for one, other in ((2, 3), (0, 1), (-1, -2)):
        assert torch.equal(found[:, one], found[:, other])
    later = replace(whole, times_s=whole.times_s + 60 * 86400.0)._temperatures(whole._expected)[0]
    assert torch.isfinite(later).all()


@pytest.mark.parametrize("without", ["wind_m_s", "irradiance_w_m2"])
def test_what_a_record_lacks_has_no_numbers(without):
    lacking = balance(weather=replace(WEATHER, **{without: None}))
    assert {"wind_m_s": "wind", "irradiance_w_m2": "sun"}[without] not in lacking._names
    assert torch.isfinite(lacking.left_out).all()


def test_beams_fall_on_points_as_they_lie():
    normals = torch.nn.functional.normalize(torch.randn(POINTS, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    lying = balance(weather=make_weather(), normals=normals)
    warm, slopes = lying._temperatures(lying._expected)
    step = torch.zeros_like(lying._expected)
    step[:, lying._names.index("sun")] = 1e-4
    more, less = (lying._temperatures(lying._expected + way * step)[0] for way in (1.0, -1.0))
    torch.testing.assert_close((more - less) / 2e-4, slopes[..., lying._names.index("sun")], rtol=5e-3, atol=5e-3)
    assert float((warm.amax(0) - warm.amin(0)).amax()) > 3.0  # those that face the sun are warmer


def test_numbers_of_the_same_fit_are_the_same_bits():
    assert torch.equal(balance().left_out, balance().left_out)


@pytest.mark.parametrize("wet", [True, False])
def test_surfaces_that_rain_wets_are_told_from_those_under_a_roof(wet):
    hours = WEATHER.times_s / HOUR_S
    showers = 2.0 * (((hours > 3) & (hours < 4)) | ((hours > 11) & (hours < 13))).double()
    weather = replace(WEATHER, rain_mm_h=showers)
    dry = balance(weather=weather, values=under(showers if wet else 0.0 * showers))
    gain = compared(replace(dry, film_mm=FILM_MM).squares, dry.squares, dry.weights)
    assert gain.exceeds(0.5, 3.0) if wet else gain.sigmas < -2.0, gain


@pytest.mark.parametrize("plants", [0.3, 0.0])
def test_surfaces_that_transpire_are_told_from_dry_ones(plants):
    dry = balance(values=under(torch.zeros_like(WEATHER.times_s), plants))
    gain = compared(replace(dry, transpires=True).squares, dry.squares, dry.weights)
    assert gain.exceeds(0.2, 3.0) if plants else gain.sigmas < 1.0, gain


@pytest.mark.parametrize(("name", "least_db"), [("solar", 5.0), ("radiation", 1.0), ("convection", 0.3)])
def test_what_drives_bodies_is_missed_where_it_is_left_out(name, least_db):
    whole = balance()
    gain = compared(whole.squares, whole.without(name).squares, whole.weights)
    assert gain.db > least_db and gain.sigmas > 3.0, gain


def test_a_steady_wind_gains_nothing():
    steady = balance(weather=replace(WEATHER, wind_m_s=torch.full_like(WEATHER.times_s, 2.0)))
    torch.testing.assert_close(steady.squares, steady.without("convection").squares)


def test_errors_of_the_balance_itself_are_expected():
    whole = balance()
    torch.testing.assert_close(whole.squares, (whole.left_out**2 / (NOISE_K**2 + MODEL_K**2)).clamp(max=WORST))


def test_ways_are_those_in_which_likely_changes_move_a_balance():
    one = balance()
    ways, (numbers, _) = one.ways(FRAMES), one._likeliest
    assert ways.shape[:2] == one.values.shape and 3 <= ways.shape[2] <= 1 + WAYS
    found = one._temperatures(numbers)[0]
    centred = found - found.mean(1, keepdim=True)
    torch.testing.assert_close(ways[..., 0], centred)
    step = (
        0.01 * one._spread * torch.randn(numbers.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    )
    moved = one._temperatures(numbers + step)[0] - found
    moved = moved - moved.mean(1, keepdim=True)
    left = moved[..., None] - ways[..., 1:] @ torch.linalg.lstsq(ways[..., 1:], moved[..., None]).solution
    assert left.norm() < 0.05 * moved.norm()


def test_fewer_ways_than_a_balance_has_are_none():
    assert balance().ways(1) is None


def test_the_likelier_of_two_skies_is_the_one_that_there_was():
    assert balance().unlikely < balance(sky(0.0)).unlikely
