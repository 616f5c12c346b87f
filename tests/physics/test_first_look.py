"""What a few looks tell of how bodies relax: against bodies that do, and those that only seem to."""

import pytest
import torch

from heatsplat.physics.first_look import RELAXES, STAYS, first_numbers, first_rates

AMBIENT = torch.tensor(0.2)
SPANS = torch.linspace(0, 1, 24, dtype=torch.float64)


def series(start, rate, noise=0.0, seed=0):
    """Looks [N, F] at bodies that start at ``start`` and relax at ``rate``, both [N]."""
    kept = torch.exp(-rate[:, None].double() * SPANS).float()
    clean = AMBIENT + (start - AMBIENT)[:, None] * kept
    return clean + noise * torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))


def test_bodies_that_relax_are_told_at_every_rate():
    rates = torch.tensor([0.5, 1.0, 3.0, 10.0, 30.0]).repeat_interleave(40)
    found = first_rates(series(torch.full_like(rates, 0.9), rates, noise=0.01), SPANS, AMBIENT)
    assert (found == RELAXES).all()


@pytest.mark.parametrize("start", [0.9, 0.2, 0.05])  # hot, as warm as what is around, colder
def test_what_does_not_change_stays(start):
    found = first_rates(series(torch.full((200,), start), torch.zeros(200), noise=0.01), SPANS, AMBIENT)
    assert (found == STAYS).float().mean() > 0.7  # noise alone may look a little like a decay


def test_what_warms_does_not_relax():
    warming = 0.3 + 0.5 * SPANS.float().expand(5, -1)
    assert (first_rates(warming, SPANS, AMBIENT) == STAYS).all()


def test_views_in_which_another_body_is_before_it_do_not_decide():
    for rate, expected in ((2.0, RELAXES), (0.0, STAYS)):
        looks = series(torch.full((40,), 0.9), torch.full((40,), rate))
        hidden = torch.rand(looks.shape, generator=torch.Generator().manual_seed(1)) < 0.2
        found = first_rates(looks.where(~hidden, 0.6), SPANS, AMBIENT)
        assert (found == expected).float().mean() > 0.9


def test_bodies_that_are_hardly_or_never_seen_stay():
    looks = series(torch.full((3,), 0.9), torch.full((3,), 4.0))
    looks[1, 3:] = torch.nan
    looks[2] = torch.nan
    assert first_rates(looks, SPANS, AMBIENT).tolist() == pytest.approx([RELAXES, STAYS, STAYS])


def test_looks_of_one_moment_tell_no_rate():
    found = first_rates(torch.full((2, 5), 0.7), torch.zeros(5, dtype=torch.float64), AMBIENT)
    assert found.tolist() == pytest.approx([STAYS] * 2)


def test_numbers_of_courses_stand_what_hid_a_body_in_some_views():
    """A fifth of the looks show something else."""
    generator = torch.Generator().manual_seed(0)
    courses = torch.randn(60, 4, generator=generator)
    courses = torch.linalg.qr(courses).Q * 60**0.5
    numbers = 0.2 * torch.randn(30, 4, generator=generator)
    looks = numbers @ courses.T + 0.003 * torch.randn(30, 60, generator=generator)
    looks[:, ::5] = 0.9
    looks[:, 1::7] = torch.nan
    found = first_numbers(looks, courses, looks.nanmedian(1).values)
    seen = ~looks[0].isnan()
    squares = torch.linalg.lstsq(courses[seen], looks[:, seen].T).solution.T
    assert (found - numbers).abs().mean() < 0.5 * (squares - numbers).abs().mean()


def test_bodies_that_are_hardly_seen_start_at_their_level():
    courses = torch.stack([torch.ones(8), torch.linspace(-1.5, 1.5, 8)], 1)
    looks = torch.full((2, 8), torch.nan)
    looks[1, 3] = 0.7
    found = first_numbers(looks, courses, torch.tensor([0.4, 0.7]))
    torch.testing.assert_close(found, torch.tensor([[0.4, 0.0], [0.7, 0.0]]), rtol=0, atol=1e-5)
