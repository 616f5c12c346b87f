"""Cameras as nerfstudio has them: what its own conventions say of one, and that they are read back as they were."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from heatsplat.contracts import Camera
from heatsplat.datamodules.formats.nerfstudio import Transforms, viewmat_of
from heatsplat.geometry.transforms import camera_entry

K = torch.tensor([[50.0, 0, 20.5], [0, 51.0, 15.0], [0, 0, 1]], dtype=torch.float64)


def test_a_camera_at_a_place_looks_down_its_negative_z():
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([-1.0, -2.0, -3.0])  # it stands at (1, 2, 3), looks along z, and has y down
    entry = camera_entry(Camera(viewmat, K, 40, 30))
    assert np.array(entry["transform_matrix"]) == pytest.approx(
        np.array([[1.0, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
    )
    assert {key: value for key, value in entry.items() if key != "transform_matrix"} == {
        "w": 40, "h": 30, "fl_x": 50.0, "fl_y": 51.0, "cx": 20.5, "cy": 15.0,
    }  # fmt: skip


def test_what_is_written_is_read_back_with_the_origin_of_its_data_set(tmp_path):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, -0.7, 0.2]).as_matrix())
    viewmat[:3, 3] = torch.tensor([0.4, 0.1, 2.0])
    origin = np.array([5e5, 4e6, 30.0])
    entry = {"file_path": "a.png"} | camera_entry(Camera(viewmat, K, 40, 30), origin.tolist())
    read = viewmat_of(Transforms(tmp_path, {}, [entry]), entry, opengl=True)
    point = np.array([0.2, -0.4, 1.0])
    assert read[:3, :3] @ (point + origin) + read[:3, 3] == pytest.approx(
        viewmat[:3, :3].numpy() @ point + viewmat[:3, 3].numpy(), abs=1e-8
    )
