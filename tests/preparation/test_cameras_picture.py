"""The picture of cameras over their points: whole, of either world, and with the scene upright."""

import cv2
import numpy as np
import pytest
import torch

from heatsplat.geometry.projection import look_at
from heatsplat.preparation.cameras_picture import draw_cameras, upright


@pytest.mark.parametrize("east_north_up", [True, False])
def test_a_picture_is_written(tmp_path, east_north_up):
    generator = np.random.default_rng(0)
    ground = np.concatenate([generator.uniform(-20, 20, (300, 2)), generator.normal(0, 0.5, (300, 1))], axis=1)
    down = torch.tensor([0.0, 0.0, 0.0], dtype=torch.float64)
    eyes = [torch.tensor([x, 0.0, 30.0], dtype=torch.float64) for x in (-5.0, 0.0, 5.0)]
    poses = [look_at(eye, down, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)).numpy() for eye in eyes]
    draw_cameras(tmp_path / "report" / "cameras.png", poses, ground, east_north_up)
    picture = cv2.imread(str(tmp_path / "report" / "cameras.png"))
    assert picture.shape[1] > 1000 and picture.std() > 5


def test_what_is_flat_lies_and_cameras_are_above_it():
    generator = np.random.default_rng(0)
    spin = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    flat = (generator.normal(size=(500, 3)) * [9.0, 4.0, 0.2]) @ spin.T
    sights = np.tile(-spin[:, 2], (4, 1))  # they look down
    axes = upright(flat, sights)
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) > 0
    assert axes[2] @ spin[:, 2] > 0.99 and abs(axes[0] @ spin[:, 0]) > 0.99
