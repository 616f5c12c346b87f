"""Cubes, their numbers and middles, against what is counted by hand."""

import math

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.geometry.voxels import among, cells, middles, spacing
from heatsplat.training.init import Voxels


def test_spacing_is_the_median_of_nearest_distances():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [4.0, 0, 0], [4.0, 2.0, 0], [9.0, 9, 9]])
    assert spacing(points) == pytest.approx(2.0)  # 1, 1, 2, 2 and far
    assert spacing(points[:1]) == spacing(torch.ones(5, 3)) == 0.0


def test_points_lie_in_the_cube_whose_middle_is_nearest():
    points = torch.tensor([[0.24, -0.24, 0.26], [1.0, 1.0, -0.6]])
    numbers = cells(points, 0.5)
    assert numbers.tolist() == [[0, 0, 1], [2, 2, -1]]
    assert middles(numbers, 0.5).tolist() == [[0.0, 0.0, 0.5], [1.0, 1.0, -0.5]]
    assert among(numbers, torch.tensor([[2, 2, -1], [0, 0, 0]])).tolist() == [False, True]


class Points:
    name = "a scene"

    def __init__(self, points):
        self.points = points


def test_anchors_begin_in_cubes_that_hold_a_point():
    points = torch.tensor([[0.1, 0, 0], [0.2, 0, 0], [0.9, 0, 0], [2.2, 0, 0]])
    found = Voxels(voxel=1.0)._means(Points(points), torch.Generator(), None)
    assert found.tolist() == [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]
    assert len(Voxels(voxel=1.0)._means(Points(points), torch.Generator().manual_seed(0), 2)) == 2
    assert torch.equal(Voxels(voxel=1.0)._means(Points(points), torch.Generator(), math.inf), found)
    with pytest.raises(SceneError, match="no voxel size can be derived from them: give init.voxel"):
        Voxels()._means(Points(torch.zeros(5, 3)), torch.Generator(), None)
