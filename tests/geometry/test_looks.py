"""What cameras see of points: what stands before a point hides it, and pixels come back as points."""

import torch

from heatsplat.contracts import Camera
from heatsplat.geometry.looks import Look, surface_points, values_at


def before_a_wall(x: float) -> Look:
    """A camera at x that looks along z at a wall of 10 °C in z = 4, before whose right half a screen of 30 °C hangs in z = 2."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    K = torch.tensor([[80.0, 0, 80], [0, 80.0, 40], [0, 0, 1]], dtype=torch.float64)
    columns = (torch.arange(160) + 0.5 - 80) / 80
    screen = (x + 2 * columns > 0).expand(80, 160)
    depth = torch.where(screen, 2.0, 4.0).double()
    return Look(Camera(viewmat, K, 160, 80), depth, torch.where(screen, 30.0, 10.0).double())


def test_what_hides_a_point_does_not_colour_it():
    points = torch.tensor([[-1.0, 0, 4], [1.0, 0, 4], [0.5, 0, 2], [0.5, 0, 2], [0, 0, -1]], dtype=torch.float64)
    towards, away = [0.0, 0, -1], [0.0, 0, 1]
    normals = torch.tensor([towards, towards, towards, away, towards], dtype=torch.float64)
    found = values_at([before_a_wall(0.0)], points, normals)
    assert found[0] == 10 and found[2] == 30
    assert found[[1, 3, 4]].isnan().all()  # behind the screen; turned away; behind the camera
    # from the left one looks behind the screen
    assert values_at([before_a_wall(0.0), before_a_wall(-2.0)], points, normals)[1] == 10
    assert values_at([before_a_wall(0.0)], points)[3] == 30


def test_points_of_pixels_are_seen_where_they_are():
    look = before_a_wall(0.3)
    points = surface_points(look.camera, look.depth)
    seen, values = look.sees(points.reshape(-1, 3))
    assert seen.all() and torch.equal(values.view(80, 160), look.values)
    assert torch.allclose(points[..., 2], look.depth)
