"""What Gaussians are told of the scene around them: filled where a model declares it, looked up when due, absent otherwise."""

import pytest
import torch

from heatsplat.splats import Splats
from heatsplat.thermal.base import NORMALS, SKY_SEEN, SUN_SEEN
from heatsplat.training.surroundings import Surroundings


class Facing:
    """In place of Normals: before training all face x, and each look turns them over."""

    refresh = frozenset({2})
    discs = "discs"

    def prepare(self, scene, renderer, means):
        return torch.tensor([[1.0, 0, 0]]).expand(len(means), 3)

    def look(self, show, normals):
        return -normals


class Seeing:
    """In place of Exposure: tells of each Gaussian its first coordinate."""

    refresh = frozenset({3})

    def prepare(self, scene, renderer, discs, names):
        assert discs == "discs"
        self.names = list(names)

    def look(self, means):
        return dict.fromkeys(self.names, means[:, 0])


class Unasked:
    refresh = frozenset()

    def prepare(self, *_):
        raise AssertionError("nobody asked")

    look = prepare


def splats(**tensors):
    count = 5
    made = {
        "means": torch.rand(count, 3, generator=torch.Generator().manual_seed(0)),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        "log_scales": torch.zeros(count, 3),
        "opacity_logits": torch.zeros(count, 1),
    }
    return Splats(made | tensors)


def test_nothing_is_looked_up_that_no_model_asks_for():
    shown = splats()
    around = Surroundings(Unasked(), Unasked())
    around.prepare(None, None, shown, None)
    for step in range(5):
        around.after_step(step, shown, None)
    assert NORMALS not in shown and SUN_SEEN not in shown


def test_normals_are_looked_up_before_training_and_when_due():
    shown = splats(**{NORMALS: torch.zeros(5, 3)})
    around = Surroundings(Facing(), Unasked())
    around.prepare(None, None, shown, None)
    assert torch.equal(shown[NORMALS][:, 0], -torch.ones(5))  # of the points, then as the splats show them
    turned = []
    for step in range(4):
        around.after_step(step, shown, None)
        turned.append(shown[NORMALS][0, 0].item())
    assert turned == [-1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("name", [SUN_SEEN, SKY_SEEN])
def test_shares_of_light_follow_gaussians_that_moved(name):
    shown = splats(**{NORMALS: torch.zeros(5, 3), name: torch.zeros(5)})
    around = Surroundings(Facing(), Seeing())
    around.prepare(None, None, shown, None)
    assert torch.equal(shown[name], shown.means[:, 0])
    with torch.no_grad():
        shown.means.add_(1.0)
    before = shown[name].clone()
    around.after_step(1, shown, None)
    assert torch.equal(shown[name], before)
    around.after_step(2, shown, None)
    assert torch.equal(shown[name], shown.means[:, 0])
