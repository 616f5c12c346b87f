"""A basis of time: its error is what it says, at any moment, for smooth curves, kinks and steps."""

import math

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from heatsplat.export.basis import CHECKS, _curves, _directions, _telling, constant_basis, rounded, steps_of, time_basis

COUNT = 200


def moment_by_moment(value_at):
    """Values at moments, of all or some Gaussians, from those of all at a moment."""

    def values_at(moments, ids: torch.Tensor | None = None) -> torch.Tensor:
        every = map(value_at, moments)
        return torch.stack([values if ids is None else values[ids] for values in every])

    return values_at


def bodies(seed: int = 0):
    """Values of bodies that relax at rates of their own and are heated at two frequencies."""
    generator = torch.Generator().manual_seed(seed)
    rates = torch.logspace(-2, 1, COUNT)
    start, gains = torch.rand(COUNT, generator=generator), 0.1 * torch.randn(COUNT, 2, generator=generator)

    def value_at(time: float) -> torch.Tensor:
        return start * torch.exp(-rates * time) + gains[:, 0] * math.sin(3 * time) + gains[:, 1] * math.cos(7 * time)

    return moment_by_moment(value_at)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_the_worst_error_is_below_what_was_asked_and_is_told(tolerance):
    values_at = bodies()
    basis = time_basis(values_at, COUNT, 0.0, 4.0, tolerance)
    assert 0 < basis.worst <= tolerance
    errors = [(basis.at(time) - values_at([time])[0]).abs().max().item() for time in torch.linspace(0, 4, 321).tolist()]
    assert max(errors) <= 1.5 * tolerance  # moments at which it never looked
    assert max(errors) > 0.1 * tolerance  # and it is no larger than it must be
    assert basis.rank < 16


def test_a_kink_gets_samples_and_a_flat_stretch_does_not():
    basis = time_basis(moment_by_moment(lambda time: torch.full((3,), max(time - 0.7, 0.0))), 3, 0.0, 1.0, 1e-4)
    assert basis.rank == 1
    near = ((basis.times_s - 0.7).abs() < 0.02).sum()
    assert near >= 4 and len(basis.times_s) < 60
    assert basis.at(0.7).abs().max() < 1e-4


def test_a_jump_has_two_samples_close_together_and_ends():
    """Halved without end, samples did not run out: a middle between two neighbouring floats is one of them."""
    basis = time_basis(moment_by_moment(lambda time: torch.tensor([float(time > 0.7), 1.0])), 2, 0.0, 1.0, 1e-4)
    assert basis.times_s.diff().min() < 2e-6 and len(basis.times_s) < 80
    for time, value in ((0.0, 0.0), (0.7 - 2e-6, 0.0), (0.7 + 2e-6, 1.0), (1.0, 1.0)):
        assert basis.at(time).tolist() == pytest.approx([value, 1.0], abs=1e-4)


def test_bends_that_are_known_are_samples():
    """A record of 60 uneven samples, linear between them: with its moments known, nothing is left between."""
    generator = torch.Generator().manual_seed(0)
    at = torch.rand(60, generator=generator, dtype=torch.float64).sort().values.tolist()
    heights = torch.randn(60, generator=generator, dtype=torch.float64).tolist()

    values_at = moment_by_moment(lambda time: torch.tensor([float(np.interp(time, at, heights))]))
    known, unknown = (time_basis(values_at, 1, 0.0, 1.0, 1e-3, 170, bends=bends) for bends in (at, ()))
    assert set(at) <= set(known.times_s.tolist())
    moments = torch.linspace(0, 1, 397).tolist()
    errors = [max((b.at(t) - values_at([t])[0]).abs().item() for t in moments) for b in (known, unknown)]
    assert errors[0] < 1e-3 < 0.1 < errors[1] and unknown.worst > 0.1  # where samples run out, the error is told
    assert set(at) - set(time_basis(values_at, 1, 0.0, 1.0, 1e-3, 100, bends=at).times_s.tolist())  # too many for it


def test_errors_of_what_is_clipped_are_those_after_clipping():
    values_at = moment_by_moment(lambda time: torch.tensor([0.5 + 0.1 * time, 5.0 + math.sin(40 * time)]))
    plain, clipped = (time_basis(values_at, 2, 0.0, 1.0, 1e-4, 40, clipped=clipped) for clipped in (False, True))
    assert len(clipped.times_s) < len(plain.times_s) and clipped.worst < 1e-4 < plain.worst


def test_what_does_not_change_has_no_curve():
    values = torch.rand(5)
    for basis in (time_basis(moment_by_moment(lambda _: values), 5, 0.0, 9.0, 0.01), constant_basis(values)):
        assert (basis.rank, basis.worst) == (0, 0.0)
        assert torch.equal(basis.at(3.0), values) and torch.equal(basis.at(None), values)


def test_too_few_samples_or_curves_are_told_as_an_error():
    values_at = bodies()
    assert time_basis(values_at, COUNT, 0.0, 4.0, 1e-4, most_curves=2).worst > 1e-3
    assert time_basis(values_at, COUNT, 0.0, 4.0, 1e-6, most_times=40).worst > 1e-6


def test_coefficients_are_already_what_sixteen_bits_hold():
    basis = time_basis(bodies(), COUNT, 0.0, 4.0, 1e-3)
    for column in basis.coefficients.unbind(1):
        assert torch.allclose(rounded(column, basis.step), column, rtol=1e-6, atol=0)
    for row in basis.curves:
        assert torch.allclose(rounded(row), row, rtol=1e-6, atol=0)
    assert 0 < basis.step < 1e-3
    steps, size = steps_of(torch.tensor([0.0, -1.0, 0.5]))
    assert steps.tolist() == [0, -32767, 16384] and size == pytest.approx(1 / 32767)
    assert steps_of(torch.zeros(2))[0].tolist() == [0, 0]
    assert steps_of(torch.tensor([0.0, -1.0, 0.26]), 0.1)[0].tolist() == [0, -10, 3]


def test_curves_sought_in_a_subspace_are_the_singular_vectors():
    draws = torch.Generator().manual_seed(3)
    values = torch.randn(300, 20, generator=draws) * 0.7 ** torch.arange(20.0) @ torch.randn(20, 200, generator=draws)
    found = _directions(values, 12)
    best = torch.linalg.svdvals(values)[12:].norm()
    assert found.shape == (200, 12) and torch.allclose(found.T @ found, torch.eye(12), atol=1e-4)
    assert (values - values @ found @ found.T).norm() <= 1.001 * best


def many(count: int, odd: tuple[int, ...]):
    """Values of many bodies, smooth but for a few odd ones with a bump of their own, and how many were asked for at once."""
    generator = torch.Generator().manual_seed(2)
    rates, start = torch.rand(count, generator=generator) * 3, torch.rand(count, generator=generator)
    asked: list[int] = []

    def value_at(time: float) -> torch.Tensor:
        values = start * torch.exp(-rates * time) + 0.1 * math.sin(2 * time)
        for number, one in enumerate(odd):
            values[one] += math.exp(-((time - 0.5 - number) ** 2) / 0.01)
        return values

    def values_at(moments, ids: torch.Tensor | None = None) -> torch.Tensor:
        asked.extend([count if ids is None else len(ids)] * len(moments))
        return moment_by_moment(value_at)(moments, ids)

    return values_at, asked


def test_of_many_gaussians_few_are_sampled_and_the_odd_ones_are_found(monkeypatch):
    monkeypatch.setattr("heatsplat.export.basis.EXAMINED", 50)
    monkeypatch.setattr("heatsplat.export.basis.ADDED", 20)
    count = 3000
    values_at, asked = many(count, odd=(7, 1234, 2999))
    basis = time_basis(values_at, count, 0.0, 4.0, 1e-3, 513)
    whole = sum(number == count for number in asked)
    assert whole < 250 < len(basis.times_s) < len(asked) - whole  # most samples are of few Gaussians
    every = torch.linspace(0, 4, 801).tolist()
    errors = torch.stack([(basis.at(time) - values_at([time])[0]).abs() for time in every]).amax(0)
    assert basis.worst <= 1e-3 and errors.max() <= 1.5e-3
    alone = time_basis(many(count, odd=())[0], count, 0.0, 4.0, 1e-3, 513)
    assert alone.rank < basis.rank  # the odd ones have curves


def test_of_many_gaussians_no_table_holds_all_moments_of_all(monkeypatch):
    """Beside what is asked at each moment: for 2 million of them that took 5 GB more."""
    count, sizes = 3000, []

    class Sizes(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            found = func(*args, **(kwargs or {}))
            sizes.append(max((one.numel() for one in tree_leaves(found) if isinstance(one, torch.Tensor)), default=0))
            return found

    monkeypatch.setattr("heatsplat.export.basis.EXAMINED", 50)
    monkeypatch.setattr("heatsplat.export.basis.ROWS", 128)
    monkeypatch.setattr("heatsplat.export.basis.CELLS", count)
    with Sizes():
        found = time_basis(many(count, odd=())[0], count, 0.0, 1.0, 1e-3, most_times=65)
    assert found.rank >= 2 and max(sizes) < count * (found.rank + 2) < count * CHECKS


def test_what_is_not_found_in_time_is_told(monkeypatch):
    monkeypatch.setattr("heatsplat.export.basis.EXAMINED", 50)
    monkeypatch.setattr("heatsplat.export.basis.TURNS", 1)
    values_at, _ = many(3000, odd=(7, 1234, 2999))
    assert time_basis(values_at, 3000, 0.0, 4.0, 1e-3, 513).worst > 0.1


def test_weights_make_the_largest_error_smaller():
    values = torch.randn(400, 60, generator=torch.Generator().manual_seed(1)) * 0.6 ** torch.arange(60.0)
    values[0, 40:] += 0.05  # one row that the others hardly need
    level = values.mean(1, keepdim=True)

    def errors(found, true):
        return (found - true).abs()

    plain = _directions(values - level, 6)
    weighed = _curves(values, level, 0.1, 6, errors)
    worst = [((values - level) @ one @ one.T - (values - level)).abs().max() for one in (plain, weighed.T)]
    assert len(weighed) == 6 and worst[1] < 0.9 * worst[0]


def test_moments_that_tell_the_curves_apart():
    times = torch.linspace(0, 1, 300, dtype=torch.float64)
    curves = torch.linalg.qr(torch.stack([times**power for power in range(9)], dim=1))[0].T[1:].float()
    every = torch.cat([torch.full((1, 300), 300**-0.5), curves]).double()
    found = _telling(curves, curves[:, :0])
    assert len(set(found)) == len(found) < 60
    assert torch.linalg.svdvals(every[:, found])[-1] >= 1 / 8
    more = _telling(curves, curves[:, found[:9]])  # what is known counts
    assert len(more) <= len(found) - 9 + 2 and torch.linalg.svdvals(every[:, found[:9] + more])[-1] >= 1 / 8
