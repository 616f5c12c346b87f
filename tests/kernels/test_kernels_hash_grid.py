"""Interpolation in hash grids: the kernel beside its plain-torch twin in double precision."""

import pytest
import torch

from heatsplat.geometry.hash_grid import interpolated, interpolated_reference, sizes
from heatsplat.kernels.scheduling import thread_count, use_threads

CELLS = (*sizes(5, 3, 500), 512)  # some with an entry for each node, others with shared ones


def given(count=5000):
    """Tables and places, among them corners and faces of the cube and places a little beyond it."""
    generator = torch.Generator().manual_seed(0)
    tables = torch.randn(len(CELLS), 1024, 2, generator=generator)
    places = torch.rand(count, 3, generator=generator)
    places[:4] = torch.tensor([[0.0, 0, 0], [1.0, 1, 1], [1.0, 0.5, 0], [-1e-4, 0.5, 1 + 1e-4]])
    return tables, places


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_the_kernel_is_its_twin(count):
    tables, places = given()
    places = places[:count]
    weights = torch.randn(count, 2 * len(CELLS), generator=torch.Generator().manual_seed(1))
    found = []
    for function, kind in ((interpolated, torch.float32), (interpolated_reference, torch.float64)):
        inputs = tables.to(kind, copy=True).requires_grad_()
        # Products of float32 places and cells round differently from those of float64, which moves a place by 3e-5 cells.
        result = function(inputs, CELLS, places.to(kind))
        (result * weights).sum().backward()
        found.append((result, inputs.grad))
    (result, gradient), (expected, wanted) = found
    assert result.shape == expected.shape and (result - expected).abs().le(5e-4).all()
    assert (gradient - wanted).norm() <= 1e-4 * wanted.norm()


def test_in_single_precision_both_agree_to_the_last_digits():
    tables, places = given()
    found, expected = (function(tables, CELLS, places) for function in (interpolated, interpolated_reference))
    assert (found - expected).abs().max() < 5e-6


def test_entries_of_other_than_two_numbers_and_other_precisions_have_the_twin():
    tables, places = given(100)
    wide = tables.repeat(1, 1, 2)
    assert torch.equal(interpolated(wide, CELLS, places), interpolated_reference(wide, CELLS, places))
    double = tables.double(), CELLS, places.double()
    assert torch.equal(interpolated(*double), interpolated_reference(*double))


def test_a_place_that_is_no_number_gives_none_and_reads_nothing_beyond_the_tables():
    tables, places = given(10)
    places[3, 1], places[5] = torch.nan, torch.inf
    found = interpolated(tables, CELLS, places)
    assert found[3].isnan().all()
    assert found[[0, 1, 2, 4, 6, 7, 8, 9]].isfinite().all()


def test_the_number_of_threads_changes_no_bit():
    tables, places = given(50_000)
    before, found = thread_count(), []
    try:
        for threads in (1, 2):
            use_threads(threads)
            inputs = tables.clone().requires_grad_()
            result = interpolated(inputs, CELLS, places)
            result.square().sum().backward()
            found.append((result.detach(), inputs.grad))
    finally:
        use_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
