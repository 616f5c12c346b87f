"""Some pixels of a view: which, and by which camera."""

import pytest
import torch
from running import TINY

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera, Frame, SceneError, View
from heatsplat.geometry.sight_lines import rays
from heatsplat.training.lattice import Lattice

CAMERA = Camera(torch.eye(4), torch.tensor([[11.0, 0.0, 6.3], [0, 12.0, 4.1], [0, 0, 1]]), 13, 9)


def view() -> View:
    pixels = torch.arange(9 * 13.0).view(9, 13, 1)
    below = pixels[..., 0] > 5
    return View(Frame("one", 0, CAMERA), pixels, pixels.expand(9, 13, 3), below, ends=below.to(torch.int8))


def test_pixels_that_are_taken_keep_their_lines_of_sight():
    schedule, starts = Lattice(rays=15), set()
    sight = rays(CAMERA)
    for step in range(40):
        part = schedule.chosen(view(), step, seed=0)
        assert part.camera.width * part.camera.height <= 15
        taken = part.thermal[..., 0].long().flatten()
        starts.add(int(taken[0]))
        assert torch.allclose(rays(part.camera).view(-1, 3), sight.view(-1, 3)[taken])
        assert torch.equal(part.rgb[..., 0], part.thermal[..., 0]) and torch.equal(part.mask, part.thermal[..., 0] > 5)
        assert torch.equal(part.ends > 0, part.mask)
    assert len(starts) == 9 and {start % 13 for start in starts} == {0, 1, 2}  # stride 3


def test_draws_are_those_of_the_seed_and_the_step():
    schedule = Lattice(rays=15)
    assert torch.equal(schedule.chosen(view(), 3, 1).thermal, schedule.chosen(view(), 3, 1).thermal)
    assert torch.equal(Lattice(rays=117).chosen(view(), 3, 1).thermal, view().thermal)
    assert Lattice(rays=1).chosen(view(), 0, 0).thermal.shape[0] == 1
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        Lattice(rays=0)


@pytest.mark.parametrize("method", ["3dgs", "scaffold_gs"])
def test_what_is_no_field_is_refused(method):
    plain = compose([*TINY, f"method={method}", "schedule=lattice"])
    with pytest.raises(SceneError, match=r"Lattice shows single pixels .* give schedule=off"):
        build(plain["module"]).attach(build(plain["data"]).scene)
