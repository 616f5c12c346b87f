"""Nearest neighbours against all pairs, where centres coincide and where there are few."""

import math

import pytest
import torch

from heatsplat.geometry.neighbours import neighbour_distances, neighbour_pairs, proximity_graph


def cloud(count: int = 300) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1))


def test_the_graph_is_that_of_all_pairs():
    means = cloud()
    lengths, ends = proximity_graph(means, 4)
    pairs = torch.cdist(means.double(), means.double())
    pairs.fill_diagonal_(math.inf)
    expected, _ = pairs.topk(4, largest=False)
    assert torch.allclose(lengths.double(), expected, atol=1e-6)
    assert torch.allclose((means[ends] - means[:, None]).norm(dim=2), lengths, atol=1e-6)


def test_no_centre_is_its_own_neighbour_even_where_centres_coincide():
    means = torch.zeros(9, 3)
    lengths, ends = proximity_graph(means, 3)
    assert lengths.abs().max() == 0
    assert (ends != torch.arange(9)[:, None]).all()


def test_few_or_broken_centres():
    assert proximity_graph(torch.zeros(1, 3), 3)[0].shape == (1, 0)
    assert proximity_graph(torch.zeros(0, 3), 3)[0].shape == (0, 0)
    lengths, ends = proximity_graph(torch.tensor([[x, 0.0, 0.0] for x in (0.0, 1.0, math.nan, 3.0)]), 3)
    assert lengths[2].tolist() == [0.0, 0.0] and lengths[0].tolist() == [1.0, 3.0]
    assert 2 not in ends[[0, 1, 3]]


def test_distances_are_those_of_the_graph_and_as_many_as_there_are_others():
    means = cloud()
    torch.testing.assert_close(neighbour_distances(means), proximity_graph(means, 3)[0])
    assert neighbour_distances(means[:3]).shape == (3, 2) and neighbour_distances(means[:1]).shape == (1, 0)


@pytest.mark.parametrize("count", [1, 2, 5, 300])
def test_pairs_are_those_of_the_graph_each_once_and_in_order(count):
    means = cloud(count)
    _, ends = proximity_graph(means, 4)
    expected = {tuple(sorted((i, j))) for i, row in enumerate(ends.tolist()) for j in row}
    assert [tuple(pair) for pair in neighbour_pairs(means, 4).tolist()] == sorted(expected)
