"""Similarity between two sets of cameras, and what is left."""

import pytest
import torch

from heatsplat.geometry.alignment import pose_errors, similarity_between
from heatsplat.geometry.projection import look_at


def cameras(on_a_line: bool = False) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    eyes = (
        torch.randn(12, 3, generator=generator, dtype=torch.float64) * (torch.tensor([1.0, 0, 0]) if on_a_line else 1)
        + 5
    )
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.stack([look_at(eye, 0.1 * eye.roll(1), up) for eye in eyes])


def moved(viewmats: torch.Tensor) -> torch.Tensor:
    """The same cameras in a world that is turned, shifted and 2.5 times as large."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.det(turn)
    c2w = torch.linalg.inv(viewmats)
    c2w[:, :3, :3] = turn @ c2w[:, :3, :3]
    c2w[:, :3, 3] = 2.5 * c2w[:, :3, 3] @ turn.T + torch.tensor([3.0, -4.0, 7.0], dtype=torch.float64)
    return torch.linalg.inv(c2w)


@pytest.mark.parametrize("on_a_line", [False, True])
def test_another_world_is_no_error(on_a_line):
    true = cameras(on_a_line)
    errors = pose_errors(moved(true), true)
    assert errors.degrees.max() < 1e-5 and errors.percent.max() < 1e-6
    assert float(errors.similarity.scale) == pytest.approx(0.4)


def test_one_turned_camera_is_told_by_its_angle():
    true = cameras()
    found = moved(true)
    angle = torch.deg2rad(torch.tensor(3.0, dtype=torch.float64))
    roll = torch.eye(4, dtype=torch.float64)
    roll[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    found[4] = roll @ found[4]
    errors = pose_errors(found, true)
    assert float(errors.degrees[4]) == pytest.approx(3.0, abs=1e-6)
    assert errors.percent.max() < 1e-6  # a roll about its own centre moves no centre


def test_two_places_make_no_similarity():
    with pytest.raises(ValueError, match="three"):
        similarity_between(torch.zeros(2, 3), torch.zeros(2, 3))
