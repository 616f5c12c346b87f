"""The course of one source from the temperatures of many surfaces, which a stiff solver integrates."""

import numpy as np
import pytest
import torch
from scipy.integrate import odeint, solve_ivp

from heatsplat.physics.common_course import BEND, RATES, common_course, least_squares, response_table

DOUBLE = torch.float64
SPANS = torch.linspace(0, 1, 70, dtype=DOUBLE)


def power(at):
    """On for a third of each half of the record, with ramps."""
    return np.interp(np.mod(at, 0.5), [0, 0.05, 0.15, 0.2, 0.5], [0.2, 1, 1, 0.0, 0.2])


def walls(count=60, layers=12):
    """Excess [P, F] of slabs of many depths that are heated from the front and lose heat there, in layers."""
    generator = np.random.default_rng(0)
    found = []
    for _ in range(count):
        flow, loss, gain = 10 ** generator.uniform(2, 3), 10 ** generator.uniform(-0.3, 0.5), generator.uniform(0.2, 1)
        start = generator.uniform(0, 0.3)

        # Heat flows between neighbouring layers; the first is heated, and loses heat.
        neighbours = np.eye(layers, k=1) + np.eye(layers, k=-1)
        slopes = flow * (neighbours - np.diag(neighbours.sum(0)))
        slopes[0, 0] -= layers * 3 * loss
        heated = layers * 3 * gain * np.eye(layers)[0]

        def rates(at, x, slopes=slopes, heated=heated):
            return slopes @ x + heated * power(at)

        options = {
            "tfirst": True,
            "Dfun": lambda at, x, slopes=slopes: slopes,
            "rtol": 1e-7,
            "atol": 1e-9,
            "hmax": 0.01,
        }
        found.append(odeint(rates, np.full(layers, start), SPANS.numpy(), **options)[:, 0])
    return torch.from_numpy(np.stack(found))


def bodies(count=40):
    """Excess [P, F] of bodies of one rate each, none of which is one of ``RATES``, from a start of their own."""
    generator = torch.Generator().manual_seed(0)
    rates, gains, starts = (
        10 ** (0.4 + torch.rand(count, dtype=DOUBLE, generator=generator)),
        *torch.rand(2, count, dtype=DOUBLE, generator=generator),
    )
    table = response_table(rates, 401)
    driven = torch.stack([table.exact(float(at)) for at in SPANS], 1) @ torch.from_numpy(power(np.linspace(0, 1, 401)))
    return 0.3 * starts[:, None] * torch.exp(-rates[:, None] * SPANS) + gains[:, None] * driven


@pytest.fixture(scope="module")
def excess():
    return walls()


def test_the_course_is_found_from_bodies_of_any_rates():
    values = bodies()
    noise = 0.002 * torch.randn(values.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    course, left = common_course(values + noise, torch.ones_like(values), SPANS)
    truth = torch.from_numpy(power(np.linspace(0, 1, len(course))))
    assert torch.corrcoef(torch.stack([course, truth]))[0, 1] > 0.95
    assert left.square().mean().sqrt() < 0.0025  # of noise 0.002; temperatures reach 0.8


def test_walls_with_a_depth_answer_it_too(excess):
    """To 3 % of their changes. What heat takes to get through all their surfaces looks like the source's own course."""
    course, left = common_course(excess, torch.ones_like(excess), SPANS)
    truth = torch.from_numpy(power(np.linspace(0, 1, len(course))))
    assert torch.corrcoef(torch.stack([course, truth]))[0, 1] > 0.85
    assert left.square().mean().sqrt() < 0.035 * excess.std(1).mean()


def test_a_surface_that_is_not_seen_changes_nothing(excess):
    values, weights = (
        torch.cat([excess, torch.full_like(excess[:2], torch.nan)]),
        torch.ones(len(excess) + 2, len(SPANS)),
    )
    weights[-2:] = 0
    course, left = common_course(values, weights.to(DOUBLE), SPANS)
    alone, _ = common_course(excess, torch.ones_like(excess), SPANS)
    torch.testing.assert_close(course, alone, rtol=0, atol=1e-9)
    assert left[:-2].isfinite().all()


def test_a_gap_in_the_record_is_bridged(excess):
    """Between 0.42 and 0.58 of the record, where the power goes up again."""
    seen = ((SPANS < 0.42) | (SPANS > 0.58)).to(DOUBLE)
    _, left = common_course(excess, seen.expand_as(excess).contiguous(), SPANS)
    truth = excess[:, seen == 0]
    off = truth + left[:, seen == 0]  # what was not seen counts as 0
    first, last = excess[:, SPANS < 0.42][:, -1:], excess[:, SPANS > 0.58][:, :1]
    straight = truth - torch.lerp(first, last, torch.linspace(0, 1, truth.shape[1], dtype=DOUBLE))
    assert off.square().mean() < 0.7 * straight.square().mean()


def test_a_course_to_start_from_ends_where_one_that_is_found_anew_does(excess):
    weights = torch.ones_like(excess)
    course, _ = common_course(excess, weights, SPANS)
    weights[:, ::4] = 0.0
    found, left = common_course(excess, weights, SPANS, start=course)
    anew, left_anew = common_course(excess, weights, SPANS)
    assert torch.corrcoef(torch.stack([found, anew]))[0, 1] > 0.95
    # What was not seen counts as 0.
    off, off_anew = ((excess + rest)[:, ::4].abs().mean() for rest in (left, left_anew))
    assert float(off) == pytest.approx(float(off_anew), rel=0.15)


def test_the_fewer_the_images_the_less_a_course_bends(excess):
    """18 images foresee others more than 1.5 times as well as with a course that may bend as that of all 70."""
    few, spans = excess[:, ::4], SPANS[::4]
    noise = 0.01 * torch.randn(few.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))

    def foreseen(smooth):
        off = []
        for k in range(4):
            known = (torch.arange(len(spans)) % 4 != k).to(DOUBLE)
            _, left = common_course(few + noise, known.expand_as(few).contiguous(), spans, smooth=smooth)
            off.append((few + left)[:, known == 0])  # what was not seen counts as 0
        return torch.cat(off, 1).abs().mean()

    assert 1.5 * foreseen(BEND) < foreseen(BEND * ((len(spans) - 1) / (len(SPANS) - 1)) ** 4)


def test_scenes_in_which_nothing_happens_give_finite_courses():
    nothing = torch.zeros(5, len(SPANS), dtype=DOUBLE)
    for weights in (torch.ones_like(nothing), nothing):
        course, left = common_course(nothing, weights, SPANS)
        assert course.isfinite().all() and left.abs().max() < 1e-9


def test_responses_are_those_of_a_body_to_hats_between_moments():
    table = response_table(torch.tensor(RATES, dtype=DOUBLE), 9)
    at, rate = 0.7, RATES[1]

    def driven(k):
        hat = np.eye(9)[k]
        body = lambda t, x: rate * (np.interp(t, np.linspace(0, 1, 9), hat) - x)  # noqa: E731
        return solve_ivp(body, (0, at), [0.0], "DOP853", rtol=1e-10, atol=1e-12, max_step=0.01).y[0, -1]

    expected = torch.tensor([driven(k) for k in range(9)], dtype=DOUBLE)
    torch.testing.assert_close(table.exact(at)[1], expected, rtol=0, atol=1e-8)


def test_least_squares_are_those_of_each_surface():
    generator = torch.Generator().manual_seed(1)
    values, basis = (
        torch.randn(3, 9, dtype=DOUBLE, generator=generator),
        torch.randn(9, 2, dtype=DOUBLE, generator=generator),
    )
    weights = torch.rand(3, 9, dtype=DOUBLE, generator=generator)
    numbers, explained = least_squares(values, weights, basis)
    damped, _ = least_squares(values, weights, basis, ridge=10.0)
    assert (damped.norm(dim=1) < 0.5 * numbers.norm(dim=1)).all()
    for k in range(3):
        root = weights[k].sqrt()
        expected = torch.linalg.lstsq(root[:, None] * basis, root * values[k]).solution
        torch.testing.assert_close(numbers[k], expected, rtol=1e-5, atol=1e-6)
        assert explained[k] == pytest.approx(float((weights[k] * (basis @ expected) ** 2).sum()), rel=1e-5)
