"""Which triangle a pixel shows, against rays."""

import torch
from test_fusion import camera

from heatsplat.geometry.fusion import Surface
from heatsplat.geometry.projection import to_camera
from heatsplat.geometry.shown_faces import shown_faces
from heatsplat.geometry.sight_lines import rays
from heatsplat.training.rng import generator_for


def brute(one, surface: Surface, two_sided: bool) -> torch.Tensor:
    """The face whose ray through a pixel's middle comes first, by Cramer's rule for each pair."""
    a, b, c = to_camera(surface.vertices, one.viewmat)[surface.faces].unbind(1)
    sight = rays(one).reshape(-1, 1, 3)
    normal = torch.linalg.cross(b - a, c - a)
    t = (a * normal).sum(-1) / (sight * normal).sum(-1)
    at = t[..., None] * sight
    inside = t > 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (torch.linalg.cross((end - start).expand_as(at), at - start, dim=-1) * normal).sum(-1) >= 0
    if not two_sided:
        inside &= (sight * normal).sum(-1) < 0
    nearest, face = torch.where(inside, t, torch.inf).min(1)
    return torch.where(nearest.isfinite(), face, -1).reshape(one.height, one.width)


def test_the_nearest_face_that_is_turned_to_the_camera_is_shown():
    generator = generator_for(0, 0, "faces")
    vertices = torch.rand(60, 3, generator=generator, dtype=torch.float64) * 2 - 1
    surface = Surface(vertices, torch.randint(60, (40, 3), generator=generator))
    one = camera([0.5, -3.0, 1.0], size=64)
    for two_sided in (False, True):
        found, truth = shown_faces(one, surface, two_sided), brute(one, surface, two_sided)
        assert (truth >= 0).double().mean() > 0.1
        assert (found == truth).double().mean() > 0.9  # but along borders, where a pixel shows either
    assert (shown_faces(one, surface) != shown_faces(one, surface, True)).any()


def test_what_lies_behind_a_camera_or_beside_its_image_is_not_shown():
    one = camera([0.0, -3.0, 0.0])
    behind = Surface(torch.tensor([[0.0, -4, 0], [1, -4, 0], [0, -4, 1]]).double(), torch.tensor([[0, 1, 2]]))
    beside = Surface(torch.tensor([[90.0, 0, 0], [91, 0, 0], [90, 0, 1]]).double(), torch.tensor([[0, 1, 2]]))
    none = Surface(torch.zeros(0, 3).double(), torch.zeros(0, 3).long())
    for surface in (behind, beside, none):
        assert (shown_faces(one, surface, True) == -1).all()
