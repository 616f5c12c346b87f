import pytest

from heatsplat.training.sampler import StepSampler


def test_every_pass_sees_each_view_once_in_another_order():
    seen = list(StepSampler(7, seed=0, steps=21))
    passes = [seen[i : i + 7] for i in (0, 7, 14)]
    assert all(sorted(p) == list(range(7)) for p in passes)
    assert len({tuple(p) for p in passes}) == 3


@pytest.mark.parametrize("start", [0, 1, 7, 13, 30])
def test_a_resumed_run_sees_what_an_uninterrupted_one_sees(start):
    whole = list(StepSampler(7, seed=3, steps=30))
    assert list(StepSampler(7, seed=3, start_step=start, steps=30)) == whole[start:]


def test_the_seed_decides_the_order():
    assert list(StepSampler(20, seed=0)) != list(StepSampler(20, seed=1))


def test_the_length_is_that_of_the_whole_run_wherever_it_starts():
    assert len(StepSampler(7, seed=0, start_step=25, steps=30)) == 30
    assert len(StepSampler(7, seed=0, steps=-1)) == 7


def test_no_views_is_an_error():
    with pytest.raises(ValueError, match="at least one view"):
        StepSampler(0, seed=0)
