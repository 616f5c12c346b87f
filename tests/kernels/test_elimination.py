"""Inner products from entries that are not zero, beside those of whole matrices whose points are solved one by one."""

from types import SimpleNamespace

import pytest
import torch
from effects.test_joint_columns import full
from effects.tracks import drawn

from heatsplat.effects.joint import least_squares
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.image_grid import grid_columns


@pytest.mark.parametrize("at_once", [100, 400_000])
@pytest.mark.parametrize("common", [True, False])
def test_columns_of_few_entries_count_as_any_others_do(at_once, common, monkeypatch):
    monkeypatch.setattr(least_squares, "_AT_ONCE", at_once)
    points, frames = 7, 9
    basis, weights = drawn(points, frames, 2), drawn(points, frames, seed=3).abs()
    basis[..., 0] = 1.0  # a level, which every offset together says too
    if common:
        basis = basis[:1].expand(points, -1, -1)
    weights[2, 4], weights[5] = 0.0, 0.0
    values = drawn(points, frames, 1, seed=2)
    offsets, gains = Columns.of_images(torch.ones(points, frames).double()), Columns.of_images(values[..., 0])
    grid = grid_columns(SimpleNamespace(positions=drawn(points, frames, 2, seed=4)), values[..., 0], 3)
    rest = Columns.dense(torch.cat([basis[..., 1:], values], 2))
    columns = Columns.joined([offsets, Columns.dense(drawn(points, frames, 3, seed=1)), gains, grid, rest])
    root, wanted = weights.sqrt()[..., None], full(columns)
    own, wanted = root * basis, root * wanted
    left = (wanted - own @ torch.linalg.lstsq(own, wanted, driver="gelsd").solution).flatten(0, 1)
    found = least_squares.gram(basis, columns, weights)
    torch.testing.assert_close(found, left.T @ left, rtol=0, atol=1e-7)
    # What the points' own bases say is none of the shared ones'.
    assert (found[-2] == 0).all() and (found[:, -2] == 0).all()
    products = torch.cat([found[-1:], found[:-1]])[:, [-1, *range(len(found) - 1)]]
    assert least_squares.shared_weights(products).isfinite().all()
