"""Sums over an image: right, and the same bits for any number of threads; and so are gradients of the parts that need them."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.sensors.agc import GainControl
from heatsplat.sensors.calibration import Calibration
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.sensors.point_spread import PointSpread
from heatsplat.sensors.sums import ROW, everywhere, total
from heatsplat.sensors.tone import Tone

HEIGHT, WIDTH = 301, 403  # more pixels than torch leaves to one thread
PARTS = {
    "offset and gain": lambda: FrameOffset(gain_max=0.1),
    "agc": GainControl,
    "calibration": Calibration,
    "tone": Tone,
    "point spread": PointSpread,
}


def random(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def with_threads(numbers, function):
    """What a function gives with each of these numbers of threads."""
    before, found = torch.get_num_threads(), []
    try:
        for number in numbers:
            torch.set_num_threads(number)
            found.append(function())
    finally:
        torch.set_num_threads(before)
    return found


@pytest.mark.parametrize("count", [0, 1, ROW - 1, ROW, 20 * ROW + 7])
def test_a_total_is_the_sum(count):
    values = random(count).double()
    assert total(values).item() == pytest.approx(values.sum().item(), rel=1e-14)
    assert total(values.reshape(1, -1, 1)).shape == ()


def test_a_total_has_the_same_bits_for_any_number_of_threads():
    values = random(HEIGHT, WIDTH, 3)
    assert len({total(values.transpose(0, 1)).item() for _ in range(3)}) == 1
    assert len(set(with_threads((1, 2, 3, 7), lambda: total(values).item()))) == 1


def test_a_number_everywhere_has_the_gradient_of_one_that_is_broadcast():
    image = random(HEIGHT, WIDTH, 1).double()
    gradients = []
    for spread in (everywhere, lambda value, image: value):
        value = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
        (image * spread(value, image)).sin().sum().backward()
        gradients.append(value.grad)
    torch.testing.assert_close(*gradients, rtol=1e-13, atol=0)
    assert everywhere(torch.tensor(2.0), image).shape == image.shape


@pytest.mark.parametrize("name", PARTS)
def test_parts_of_a_sensor_learn_the_same_bits_with_any_number_of_threads(name):
    frames = [Frame(f"{i}.png", i, Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT), float(i)) for i in range(3)]
    views = ViewSet(frames, lambda index: None)
    part = PARTS[name]()
    part.prepare(SceneData("room", views, views, views, torch.zeros(4, 3)))
    with torch.no_grad():
        for k, parameter in enumerate(part.parameters()):
            parameter.add_(0.1 * random(*parameter.shape, seed=k))
    image, pull = random(HEIGHT, WIDTH, 1), random(HEIGHT, WIDTH, 1, seed=1) - 0.5

    def gradients():
        part.zero_grad()
        (part(image, frames[1]) * pull).backward(torch.ones(HEIGHT, WIDTH, 1))
        return [parameter.grad.clone() for parameter in part.parameters()]

    one, *others = with_threads((1, 2, 3), gradients)
    assert all(gradient.any() for gradient in one)
    for other in others:
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))
