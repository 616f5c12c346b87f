"""Columns of which an observation has few entries, beside the matrices that they stand for."""

from types import SimpleNamespace

import torch
from effects.tracks import drawn

from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.image_grid import grid_columns


def full(columns):
    """All entries of columns, [P, F, c]."""
    found = torch.zeros(*columns.slots.shape[:2], columns.count, dtype=columns.values.dtype)
    return found.scatter_add(2, columns.slots, columns.values)


def test_columns_are_scaled_joined_and_multiplied_as_matrices_are():
    points, frames = 4, 5
    image, numbers = drawn(points, frames), drawn(2 * 9 + frames, seed=1)
    grid = grid_columns(SimpleNamespace(positions=drawn(points, frames, 2, seed=4)), image, 3)
    both = Columns.joined([grid, Columns.of_images(image)])
    assert both.count == len(numbers) and full(grid)[..., :9].sum(2).allclose(torch.ones(1).double())
    torch.testing.assert_close(full(grid)[..., 9:], full(grid)[..., :9] * image[..., None])
    torch.testing.assert_close(both @ numbers, full(both) @ numbers)
    torch.testing.assert_close(full(both * image[..., None]), full(both) * image[..., None])
    torch.testing.assert_close(full(Columns.of_images(image)), image[..., None] * torch.eye(frames).double())


def test_a_grid_is_straight_between_its_nodes_and_ends_with_the_image():
    places = torch.tensor([[[-1.0, -1.0], [1.0, 1.0], [0.0, 0.5], [-7.0, 1.0]]], dtype=torch.float64)
    found = full(grid_columns(SimpleNamespace(positions=places), torch.zeros(1, 4).double(), 3))[0, :, :9].reshape(
        4, 3, 3
    )
    assert found[0, 0, 0] == 1 and found[1, 2, 2] == 1 and found[3, 0, 2] == 1
    assert found[2, 1].tolist() == [0.0, 0.5, 0.5] and found.sum() == 4
