"""The box of a field: where places lie in it, and how far samples reach."""

import math
from types import SimpleNamespace

import torch

from heatsplat.contracts import Camera
from heatsplat.thermal.field import Field


class Layered(Field):
    """A density that is the height in the box."""

    def inside(self, places):
        return places[:, 2], places

    def values(self, known, directions, query):
        return known[:, :1]

    cost = 1


def camera(distance: float) -> SimpleNamespace:
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    return SimpleNamespace(camera=Camera(viewmat, torch.eye(3), 4, 4))


def test_densities_are_told_in_half_edges_and_come_back_in_world_units():
    field = Layered()
    frames = [camera(distance) for distance in (3.0, 7.0, 100.0)]
    center = torch.tensor([1.0, 0.0, 0.0])
    field.prepare(SimpleNamespace(bulk=(center, 5.0), train=SimpleNamespace(frames=frames)))
    density, known = field.density(torch.tensor([[1.0, 0.0, 3.0], [4.0, 0.0, 1.5]]))
    assert torch.allclose(known, torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.5]]))  # half edges of 1.2 * 5 / 2
    assert torch.allclose(density, torch.tensor([1.0, 0.5]) / 3)
    assert math.isclose(field.span, math.sqrt(50) + 3, rel_tol=1e-6)  # the camera in the middle is at z = -7
    assert field.opacity_channels == (1,) and field.inseparable == "it has no Gaussians"
