"""Rays through media of which the answer is known, and where samples fall."""

import math

import pytest
import torch

from heatsplat.geometry.volume import contracted, drawn, reached, weights


def test_weights_of_a_homogeneous_slab_are_those_of_beer_and_lambert():
    """A slab of density 0.7 from 2 to 5 in an empty ray: 1 - e^{-2.1} of what it sends, however it is parted."""
    edges = torch.tensor([[0.0, 1.0, 2.0, 2.5, 3.5, 3.6, 5.0, 9.0]], dtype=torch.float64)
    densities = torch.tensor([[0.0, 0.0, 0.7, 0.7, 0.7, 0.7, 0.0]], dtype=torch.float64)
    found = weights(densities, edges.diff(dim=1))
    passed = torch.exp(-0.7 * (edges - 2).clamp(0, 3))
    assert torch.allclose(found, passed[:, :-1] - passed[:, 1:], atol=1e-15)
    assert found.sum().item() == pytest.approx(1 - math.exp(-2.1))
    # A source that falls as e^{-x} from the face sends 0.7 / 1.7 (1 - e^{-5.1}).
    many = torch.linspace(0, 3, 3001, dtype=torch.float64)[None]
    middles = 0.5 * (many[:, 1:] + many[:, :-1])
    sent = (weights(torch.full_like(middles, 0.7), many.diff(dim=1)) * torch.exp(-middles)).sum()
    assert sent.item() == pytest.approx(0.7 / 1.7 * (1 - math.exp(-5.1)), rel=1e-6)


def test_what_lies_behind_a_wall_has_no_weight_and_a_wall_no_more_than_one():
    found = weights(torch.tensor([[0.0, 1e6, 1e6]]), torch.ones(1, 3))
    assert found.tolist() == [[0.0, 1.0, 0.0]]
    assert weights(torch.full((1, 3), 1e-9), torch.ones(1, 3)).allclose(torch.full((1, 3), 1e-9), rtol=1e-5)


def test_all_of_space_is_contracted_into_a_cube():
    points = torch.tensor([[0.5, -1.0, 0.2], [4.0, 0.0, -2.0], [0.0, 1e9, 0.0]])
    expected = torch.tensor([[0.5, -1.0, 0.2], [1.75, 0.0, -0.875], [0.0, 2.0, 0.0]])
    assert torch.allclose(contracted(points), expected)


def test_samples_lie_evenly_up_to_the_span_and_far_beyond_it():
    found = reached(torch.tensor([0.0, 0.4, 0.8, 0.9, 1.0]), near=0.5, span=4.5)
    assert torch.allclose(found, torch.tensor([0.5, 2.5, 4.5, 4.5 / 0.525, 90.0]))


def test_samples_are_drawn_where_weights_are():
    edges = torch.linspace(0, 10, 11)[None].double()
    found = torch.zeros(1, 10, dtype=torch.float64)
    found[0, 6] = 1.0  # spread to its neighbours: a quarter, a half and a quarter of what is in 5..8
    places = drawn(edges, found, 399, torch.full((1, 1), 0.5, dtype=torch.float64))[0]
    assert (places.diff() > 0).all() and len(places) == 400
    shares = [((places >= low) & (places < high)).double().mean().item() for low, high in ((5, 6), (6, 7), (7, 8))]
    assert shares == pytest.approx([0.2485, 0.496, 0.2485], abs=0.004)  # the hundredth that is left falls evenly
    even = drawn(edges, torch.zeros(1, 10, dtype=torch.float64), 9, torch.full((1, 1), 0.5, dtype=torch.float64))
    assert torch.allclose(even, torch.arange(10).double()[None] + 0.5)
