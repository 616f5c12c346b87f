"""Marches along the record that are kept: what lies between two of them, what comes and goes, and views in order."""

from functools import cache

import pytest
import torch

from heatsplat.kernels import marching as kernels
from heatsplat.physics import marching
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import (
    CHANGE,
    UNITS,
    Course,
    Kept,
    learned,
    march,
    parameters,
    stepped_temperature,
    with_parameters,
)
from heatsplat.physics.surfaces import Core, Surface
from tests.physics.weather_reference import drivers, showers

MOMENTS = torch.arange(1000.0, 80_000.0, 5300.0, dtype=torch.float64)
COUNT = 200


WET = "rain and plants"


@pytest.fixture(params=["one node", "core and heat", WET])
def case(request) -> str:
    return request.param


@cache
def climate_of(wet: bool, days: float = 1.0) -> Climate:
    given = drivers(days=days)
    return Climate(showers(given) if wet else given)


@pytest.fixture
def climate(case) -> Climate:
    return climate_of(case == WET)


@pytest.fixture
def surface(case) -> Surface:
    """Sheet metal to wet ground, turned all ways, in float32 as training has them; with a core and heat behind them, or with
    water on them, or not."""
    generator = torch.Generator().manual_seed(0)

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(COUNT, generator=generator)

    turned = torch.randn(COUNT, 3, generator=generator)
    found = Surface(
        start=between(-10, 15),
        log_rate=between(-11.5, -6.0),
        sun=between(10, 70),
        share=between(0.1, 0.8),
        wind=between(0.05, 0.9),
        normals=torch.nn.functional.normalize(turned, dim=1),
    )
    if case == "one node":
        return found
    if case == WET:
        return found._replace(transpires=between(0.05, 0.9))
    core = Core(between(-10, 15), between(-13.0, -7.0), between(-3.0, 2.0).exp())
    return found._replace(core=core, inner=between(-1, 5))


def moved(surface: Surface, share: float, seed: int = 1) -> Surface:
    """The surfaces with every parameter off by a share of itself (of 1 in logarithms), either way."""
    values, generator = parameters(surface), torch.Generator().manual_seed(seed)
    signs = torch.randn(len(values), COUNT, generator=generator).sign() * share
    changed = {
        name: value + sign if name.startswith(("log", "core_log")) else value * (1 + sign)
        for (name, value), sign in zip(values.items(), signs, strict=True)
    }
    return with_parameters(surface, changed)


def rows(surface: Surface, ids: torch.Tensor) -> Surface:
    return marching.rows_of(surface, ids)


def test_what_is_found_of_one_depends_neither_on_the_others_nor_on_other_moments(climate, surface):
    ids = torch.randperm(COUNT)[:37]
    whole, alone = march(climate, surface, MOMENTS), march(climate, rows(surface, ids), MOMENTS[4:5])
    assert torch.equal(whole[4:5, ids], alone)
    torch.testing.assert_close(
        march(climate, surface, MOMENTS, sensitive=False)[..., 0], whole[..., 0], atol=1e-5, rtol=0
    )


def test_moments_a_few_samples_apart_need_no_kernel_of_their_own(climate, surface):
    alone, of_samples = march(climate, surface, MOMENTS[::2].contiguous()), list(kernels.march.compiled.signatures)
    assert torch.equal(march(climate, surface, MOMENTS[::2]), alone)
    assert kernels.march.compiled.signatures == of_samples


def test_between_two_marches_temperatures_are_right_to_first_order(climate, surface):
    ids, names = torch.arange(COUNT), parameters(surface)
    kept, marched_at = Kept(climate, MOMENTS), torch.zeros(COUNT, len(names))

    def error(now: Surface) -> torch.Tensor:
        found = [kept.temperature(now, t, ids, (now.normals,), marched_at) for t in MOMENTS.tolist()]
        return torch.stack(found) - march(climate, now, MOMENTS, sensitive=False)[..., 0]

    assert error(surface).abs().max() < 1e-4
    assert torch.equal(marched_at, learned(surface))
    near = moved(surface, 0.02)
    # When water has dried is told by the parameters that were marched.
    assert 1e-4 < error(near).square().mean().sqrt() < (3e-3 if surface.transpires is None else 0.03)
    assert torch.equal(marched_at, learned(surface))
    far = moved(surface, 2 * CHANGE)  # in the logarithm of the rate, so that all are marched anew
    assert error(far).abs().max() < 1e-4
    assert torch.equal(marched_at, learned(far))
    drifting = learned(surface)  # as far as it may be without a new march
    units = drifting.new_tensor([UNITS[name] for name in names])
    signs = torch.randn(drifting.shape, generator=torch.Generator().manual_seed(2)).sign()
    drifting = drifting + 0.99 * CHANGE * units * signs
    marched_at.copy_(learned(surface))
    off = error(with_parameters(surface, dict(zip(names, drifting.unbind(1), strict=True))))
    assert torch.equal(marched_at, learned(surface))
    # Of five numbers at once, of nine, or of six with water.
    assert off.square().mean().sqrt() < (0.03 if surface.core is surface.transpires is None else 0.08)
    assert off.abs().max() < (0.5 if surface.transpires is None else 2.0)


def test_splits_and_a_checkpoint_find_the_bits_that_were_there(climate, surface):
    ids = torch.arange(COUNT)
    kept, marched_at = Kept(climate, MOMENTS), torch.zeros(COUNT, len(parameters(surface)))
    time = MOMENTS[3].item()
    kept.temperature(surface, time, ids, (surface.normals,), marched_at)
    now = moved(surface, 0.02)
    here = kept.temperature(now, time, ids, (now.normals,), marched_at)

    again = Kept(climate, MOMENTS).temperature(now, time, ids, (now.normals,), marched_at.clone())
    assert torch.equal(again, here)
    children = torch.cat((ids[::2], ids[:30]))  # half of them leave, and some are split
    theirs = rows(now, children)
    for holds in (kept, Kept(climate, MOMENTS)):
        found = holds.temperature(theirs, time, torch.arange(130), (theirs.normals,), marched_at[children].clone())
        assert torch.equal(found, here[children])
    turned = now._replace(normals=now.normals.roll(1, 0))
    found = kept.temperature(turned, time, ids, (turned.normals,), marched_at)
    assert (found - here).abs().max() > 1


def test_of_moments_that_do_not_fit_in_memory_the_latest_are_kept(climate, surface, monkeypatch):
    names = parameters(surface)
    whole, marched_at = Kept(climate, MOMENTS), torch.zeros(COUNT, len(names))
    monkeypatch.setattr(marching, "KEPT_BYTES", 4 * COUNT * (1 + len(names)) * marched_at.element_size())
    some = Kept(climate, MOMENTS)
    for count, fit in ((COUNT, 4), (COUNT // 2, 8), (COUNT // 20, len(MOMENTS)), (COUNT, 4)):  # as they come and go
        ids = torch.arange(count)
        near, at = rows(moved(surface, 0.02), ids), learned(rows(surface, ids))
        assert [some.has(t, at) for t in MOMENTS.tolist()] == [False] * (len(MOMENTS) - fit) + [True] * fit
        for time in MOMENTS[-fit:].tolist():
            found, expected = (kept.temperature(near, time, ids, (near.normals,), at) for kept in (some, whole))
            assert torch.equal(found, expected)
        assert some._table.shape[0] == fit


def test_derivatives_reach_the_parameters_through_what_is_kept(climate, surface):
    ids, names = torch.arange(COUNT), parameters(surface)
    columns = [value.clone().requires_grad_() for value in names.values()]
    live = with_parameters(surface, dict(zip(names, columns, strict=True)))
    marched_at, time = torch.zeros(COUNT, len(names)), MOMENTS[-1].item()
    kept = Kept(climate, MOMENTS)
    ours = torch.autograd.grad(
        kept.temperature(live, time, ids, (surface.normals,), marched_at).sum(), columns, retain_graph=True
    )
    alone = torch.autograd.grad(stepped_temperature(climate, live, time).sum(), columns)
    for one, other in zip(ours, alone, strict=True):
        torch.testing.assert_close(one, other)
    assert not kept.has(time + 1.0, marched_at)
    assert not kept.has(time, marched_at.new_zeros(1, 1).expand(1 << 32, 5))  # as much does not fit


@pytest.mark.parametrize("room", [marching.COURSE_BYTES, 20_000])
def test_views_in_any_order_see_what_a_march_of_their_own_finds(climate, surface, monkeypatch, room):
    monkeypatch.setattr(marching, "COURSE_BYTES", room)
    ids = torch.arange(0, COUNT, 3)
    course = Course(climate, surface)
    for time in (0.0, 5000.0, 5000.0, 40_000.0, 9000.0, 86_400.0):
        alone = stepped_temperature(climate, rows(surface, ids), time)
        torch.testing.assert_close(course.temperatures([time], ids)[0], alone, atol=2e-4, rtol=0)


@pytest.mark.parametrize("room", [marching.COURSE_BYTES, 20_000])
def test_moments_that_are_asked_for_together_see_the_same(climate, surface, monkeypatch, room):
    """Some side by side, some far apart, the first and the last of the record."""
    monkeypatch.setattr(marching, "COURSE_BYTES", room)
    times = climate.drivers.times_s.tolist()
    times = [times[0], 5000.0, 5100.0, 5900.0, 40_000.0, 40_001.0, *times[80:90], times[-1]]
    for ids in (None, torch.arange(1, COUNT, 4)):
        found = Course(climate, surface).temperatures(times, ids)
        course = Course(climate, surface)
        alone = torch.cat([course.temperatures([time], ids) for time in times])
        torch.testing.assert_close(found, alone, atol=2e-4, rtol=0)
        assert (found[1:] - found[:-1]).abs().amax(1).min() > 0  # they differ


def test_what_surfaces_have_forgotten_of_a_long_record_is_not_marched(surface, monkeypatch):
    """Under a record of a year training took four times as long, and found the same."""
    climate, marched = climate_of(surface.transpires is not None, days=40.0), []
    moments = 35 * 86_400.0 + MOMENTS[:4]
    ids, names = torch.arange(COUNT), parameters(surface)
    kept, march_now = Kept(climate, moments), marching.march

    def counted(*args, first=0, **more):
        marched.append((first, len(args[1].log_rate)))
        return march_now(*args, first=first, **more)

    monkeypatch.setattr(marching, "march", counted)
    found = torch.stack(
        [
            kept.temperature(surface, t, ids, (surface.normals,), torch.zeros(COUNT, len(names)))
            for t in moments.tolist()
        ]
    )
    whole = march_now(climate, surface, moments)
    torch.testing.assert_close(found, whole[..., 0], atol=1e-4, rtol=0)
    late = sum(count for first, count in marched if first > 35 * 144 / 2) / sum(count for _, count in marched)
    assert late > (0.7 if surface.core is None else 0.1), marched
