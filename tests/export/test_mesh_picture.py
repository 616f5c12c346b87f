"""Pictures of meshes: what is warm is warm in them, and walls before a room are left out."""

import numpy as np
import torch
from test_made_surface import on_a_ball

from heatsplat.export.mesh_picture import LONGEST, _aslant, pictured
from heatsplat.geometry.fusion import Surface
from heatsplat.geometry.projection import to_camera, to_pixels
from heatsplat.geometry.shown_faces import shown_faces
from heatsplat.io.pictures import Bar, lut


def grid(centre, size: float, turned: bool = False) -> Surface:
    """A horizontal square of 2 x 20 x 20 triangles, seen from above or below."""
    steps = torch.linspace(-0.5, 0.5, 21, dtype=torch.float64) * size
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3) + centre
    corner = (torch.arange(20)[:, None] * 21 + torch.arange(20)).reshape(-1)
    faces = torch.cat(
        [torch.stack([corner, corner + 21, corner + 22], 1), torch.stack([corner, corner + 22, corner + 1], 1)]
    )
    return Surface(vertices, faces.flip(1) if turned else faces)


def test_a_mesh_fills_the_picture_and_has_the_colours_of_its_values(cooling):
    _, centre, radius = on_a_ball(cooling)
    scene = cooling.module.scene
    surface = grid(centre, 2 * radius)
    camera = _aslant(surface, scene)
    places = to_pixels(to_camera(surface.vertices, camera.viewmat), camera.K)
    assert max(camera.width, camera.height) == LONGEST
    assert (places > 0).all() and (places < torch.tensor([camera.width, camera.height])).all()
    values = torch.where(surface.vertices[:, 0] > centre[0], 40.0, 20.0).double()
    picture = pictured(surface, values, scene, Bar(20.0, 40.0, "°C")).reshape(-1, 3).astype(int)
    found = {tuple(colour) for colour in np.unique(picture, axis=0)}
    assert {tuple(end) for end in lut("inferno")[[0, 255]].astype(int)} <= found


def test_faces_that_are_turned_away_are_left_out(cooling):
    _, centre, radius = on_a_ball(cooling)
    scene = cooling.module.scene
    for turned in (False, True):
        surface = grid(centre, 2 * radius, turned)
        share = (shown_faces(_aslant(surface, scene), surface) >= 0).double().mean()
        assert share == 0 if turned else share > 0.4
        pictured(surface, torch.full((len(surface.vertices),), torch.nan).double(), scene, Bar(0.0, 1.0, "°C"))
