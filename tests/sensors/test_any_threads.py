"""Parts of a sensor: the same bits for any number of threads."""

import pytest
import torch
from threads import with_threads

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.sensors.agc import GainControl
from heatsplat.sensors.calibration import Calibration
from heatsplat.sensors.conduction_residual import ConductionResidual
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.sensors.point_spread import PointSpread
from heatsplat.sensors.tone import Tone

HEIGHT, WIDTH = 301, 403  # more pixels than torch leaves to one thread
PARTS = {
    "offset and gain": lambda: FrameOffset(gain_max=0.1),
    "agc": GainControl,
    "calibration": Calibration,
    "tone": Tone,
    "point spread": PointSpread,
    "conduction": ConductionResidual,
}


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", PARTS)
def test_parts_of_a_sensor_give_and_learn_the_same_bits(name):
    frames = [Frame(f"{i}.png", i, Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT), float(i)) for i in range(3)]
    views = ViewSet(frames, lambda index: None)
    part = PARTS[name]()
    part.prepare(SceneData("room", views, views, views, torch.zeros(4, 3)))
    with torch.no_grad():
        for k, parameter in enumerate(part.parameters()):
            parameter.add_(0.1 * random(*parameter.shape, seed=k))
    image, pull = random(HEIGHT, WIDTH, 1), random(HEIGHT, WIDTH, 1, seed=1) - 0.5

    def results():
        part.zero_grad()
        recorded = part(image, frames[1])
        (recorded * pull).backward(torch.ones(HEIGHT, WIDTH, 1))
        return [recorded.detach(), *(parameter.grad.clone() for parameter in part.parameters())]

    one, *others = with_threads((1, 2, 3), results)
    assert all(found.any() for found in one)
    for other in others:
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))
