from itertools import islice

import pytest

from heatsplat.training.sampler import StepSampler


def views(count, start, steps, **options):
    return list(islice(StepSampler(count, start_step=start, **options), steps))


def test_every_pass_sees_each_view_once_in_another_order():
    seen = views(7, 0, 21, seed=0)
    passes = [seen[i : i + 7] for i in (0, 7, 14)]
    assert all(sorted(p) == list(range(7)) for p in passes)
    assert len({tuple(p) for p in passes}) == 3


@pytest.mark.parametrize("start", [0, 1, 7, 13, 30])
def test_a_resumed_run_sees_what_an_uninterrupted_one_sees(start):
    assert views(7, start, 40 - start, seed=3) == views(7, 0, 40, seed=3)[start:]


@pytest.mark.parametrize("start", [0, 9, 10, 11, 23, 24, 26])
def test_a_pass_begins_with_each_round(start):
    seen = views(7, 0, 45, seed=3, restarts=(10, 24))
    whole = [seen[i : i + 7] for i in (0, 10, 17, 24, 31, 38)]
    assert all(sorted(p) == list(range(7)) for p in whole)
    assert len({tuple(p) for p in [*whole, seen[7:10]]}) == 7
    assert seen[:10] == views(7, 0, 10, seed=3)
    assert views(7, start, 45 - start, seed=3, restarts=(10, 24)) == seen[start:]


def test_the_seed_decides_the_order():
    assert views(20, 0, 20, seed=0) != views(20, 0, 20, seed=1)


def test_no_views_is_an_error():
    with pytest.raises(ValueError, match="at least one view"):
        StepSampler(0, seed=0)
