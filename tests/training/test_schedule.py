"""The schedule: shares of a run and of its rounds, an end that moves, and what is shifted so as not to meet a reset."""

import json

import pytest

from heatsplat.density.adaptive import Adaptive
from heatsplat.training.schedule import Schedule


def test_progress_is_the_share_of_the_run_to_the_last_bit():
    schedule = Schedule(30_000)
    assert schedule.end == 30_000
    assert all(schedule.progress(step) == step / 30_000 for step in range(30_001))
    assert schedule.progress(40_000) == 1.0


def test_rounds_of_any_number_and_without():
    three, one = Schedule(100, [10, 40]), Schedule(100)
    assert [three.round_step(step) for step in (0, 9, 10, 39, 40, 99)] == [0, 9, 0, 29, 0, 59]
    assert [three.round_progress(step) for step in (0, 5, 10, 25, 40, 70, 100, 120)] == [0, 0.5, 0, 0.5, 0, 0.5, 1, 1]
    for step in (0, 3, 50, 100, 130):
        assert one.round_step(step) == step and one.round_progress(step) == one.progress(step) == min(step / 100, 1.0)
    for wrong in ([0], [5, 5], [7, 3]):
        with pytest.raises(ValueError, match="stages.restarts must be increasing steps from 1 on"):
            Schedule(100, wrong)
    with pytest.raises(ValueError, match="max_steps must be at least 1, got 0"):
        Schedule(0)


def test_what_is_left_is_of_the_last_round_and_follows_an_end_that_moves():
    rounds, one = Schedule(100, [10, 40]), Schedule(100)
    assert [rounds.left(step) for step in (0, 25, 40, 70, 100)] == [1, 1, 1, 0.5, 0]
    assert [one.left(step) for step in (0, 90, 100)] == [1, pytest.approx(0.1), 0]
    one.end_at(50, 150)
    assert one.left(100) == pytest.approx(0.25) and one.left(150) == 0


@pytest.mark.parametrize(("end", "steps"), [(900.4, 900), (520.0, 520), (500.0, 500)])
def test_what_is_left_is_spread_over_the_steps_that_are_left(end, steps):
    schedule = Schedule(600, [300])
    before = schedule.progress(400)
    schedule.end_at(400, end)
    assert schedule.end == steps
    assert schedule.progress(400) == before == pytest.approx(4 / 6)
    assert schedule.progress(steps) == pytest.approx(1.0, abs=1e-3) == schedule.round_progress(steps)
    half = (400 + end) / 2
    assert schedule.progress(half) == pytest.approx(5 / 6) and schedule.round_progress(half) == pytest.approx(2 / 3)
    schedule.end_at(half, 10_000)  # and once more
    assert schedule.progress(half) == pytest.approx(5 / 6) and schedule.end == 10_000


def test_an_end_at_once_leaves_the_rest_undone():
    schedule = Schedule(600)
    schedule.end_at(400, 100)
    assert schedule.end == 400 and schedule.progress(400) == schedule.progress(500) == pytest.approx(4 / 6)


def test_its_state_is_plain_and_a_run_of_another_length_keeps_its_own_end():
    moved, again, longer = Schedule(600), Schedule(600), Schedule(1000)
    moved.end_at(333, 777.7)
    state = json.loads(json.dumps(moved.state_dict()))
    for other in (again, longer):
        other.load_state_dict(state)
    assert again.end == 778 and all(again.progress(step) == moved.progress(step) for step in range(800))
    assert longer.end == 1000 and longer.progress(500) == 0.5


@pytest.mark.parametrize("steps", [7000, 30_000, 31_234])
def test_an_even_interval_keeps_clear_of_resets(steps):
    density = Adaptive(stop=steps // 2, every=max(50, steps // 300), reset_every=max(3000, steps // 10))
    interval = Schedule(steps).interval(steps // 10, lambda step: density.settled(step - 1))
    assert steps // 40 < interval <= steps // 10 and -steps % interval < interval / 10  # as good as to the end
    resets = range(density.reset_every, density.stop, density.reset_every)
    assert min(step - reset for step in range(interval, steps, interval) for reset in resets if step >= reset) >= (
        10 * density.every
    )


def test_an_interval_that_suits_is_left_alone_and_one_that_cannot_too():
    assert Schedule(30_000).interval(3000, lambda step: True) == 3000
    assert Schedule(30_000).interval(50, lambda step: False) == 50
    assert Schedule(40).interval(1000, lambda step: False) == 1000
