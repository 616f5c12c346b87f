"""A prior of few materials, beside k-means in numpy."""

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneError, as_written
from heatsplat.thermal.materials import Materials, divided, moved, nearest

CENTRES = np.array([[-9.0, -1.5, -0.5], [-6.0, -1.0, 0.5], [-10.5, 0.5, -1.0], [-8.0, -2.5, -0.2]])


def gathered(spread: float = 0.05, each: int = 40, seed: int = 0) -> tuple[torch.Tensor, np.ndarray]:
    """Parameters [N, 3] of surfaces about CENTRES, and of which they are."""
    drawn = np.random.default_rng(seed)
    which = drawn.permutation(np.repeat(np.arange(len(CENTRES)), each))
    return torch.tensor(CENTRES[which] + spread * drawn.standard_normal((len(which), 3))).float(), which


def test_materials_are_found_where_there_are_some():
    values, which = gathered()
    means = divided(values.T, 4)
    members = nearest(values.T, means).numpy()
    assert len({*zip(which.tolist(), members.tolist(), strict=True)}) == 4  # one each
    for k in range(4):
        np.testing.assert_allclose(means[k], values.numpy()[members == k].mean(0), rtol=1e-6)
    order = members[[int(np.flatnonzero(which == k)[0]) for k in range(4)]]
    np.testing.assert_allclose(means.numpy()[order], CENTRES, atol=0.05)


@pytest.mark.parametrize("count", [1, 3, 8])
def test_the_distance_is_that_to_the_nearest_mean_after_it_has_moved(count):
    values, _ = gathered(spread=0.5)
    prior = Materials(count, 6)
    columns = [column.clone().requires_grad_() for column in values.unbind(1)]
    for _ in range(3):
        distance = prior(columns)
    means, exact = prior.means[:, :3].double().numpy(), values.double().numpy()
    squares = ((exact[:, None] - means) ** 2).sum(2)
    members = nearest(values.T, prior.means[:, :3]).numpy()
    np.testing.assert_allclose(squares[np.arange(len(members)), members], squares.min(1), rtol=1e-4, atol=1e-5)
    # The means are those of the members of a step before, of which few have changed since.
    assert float(distance.detach()) == pytest.approx(squares.min(1).mean(), rel=0.02)
    distance.backward()
    for i, column in enumerate(columns):
        pull = 2 * (exact[:, i] - means[members, i]) / len(exact)
        differ = np.abs(column.grad.numpy() - pull) > 1e-5
        assert differ.mean() < 0.1  # those that have changed
    assert prior.means[:, 3:].isnan().all() and prior.means.shape == (count, 6)


def test_means_follow_their_members_and_stay_without_any():
    values = torch.tensor([[0.0], [1.0], [10.0]])
    found = moved(values.T, torch.tensor([0, 0, 2]), torch.tensor([[5.0], [6.0], [7.0]]))
    assert found.tolist() == [[0.5], [6.0], [10.0]]


def test_fewer_surfaces_than_materials_are_each_their_own():
    values = torch.tensor([[0.0, 1.0], [4.0, -1.0]])
    prior = Materials(5, 2)
    assert float(prior(list(values.unbind(1)))) == 0.0 and not prior.means.isnan().any()
    one = Materials(3, 2)
    assert float(one([torch.tensor([2.0]), torch.tensor([3.0])])) == 0.0


def test_what_was_found_goes_on_from_a_checkpoint():
    values, _ = gathered(spread=0.5)
    first, second = Materials(4, 6), Materials(4, 6)
    first(list(values.unbind(1)))
    second.load_state_dict(first.state_dict())
    assert torch.equal(first(list(values.unbind(1))), second(list(values.unbind(1))))


@pytest.mark.parametrize("count", [0, 2.5, True])
def test_what_is_no_number_of_materials_is_refused(count):
    with pytest.raises(
        SceneError, match=f"thermal.materials must be a whole number, 1 or more, got {as_written(count)}"
    ):
        Materials(count, 3)
