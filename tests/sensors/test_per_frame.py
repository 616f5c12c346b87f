"""Settings for each image: the order that they are kept in, and what an image has that was not trained on."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.sensors.agc import GainControl

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 6)


def gain_control(times, **options):
    frames = [Frame(f"{i}.png", 3 * i, CAMERA, time) for i, time in enumerate(times)]
    views = ViewSet(frames, lambda index: None)
    part = GainControl(**options)
    part.prepare(SceneData("flight", views, views, views, torch.zeros(4, 3)))
    return part, frames


def between(part, moment):
    """What is interpolated of 0, 1, 2 ... at a moment."""
    values = torch.arange(len(part.moments), dtype=torch.float64)
    return part.at(values, Frame("other.png", 1, CAMERA, moment)).item()


def test_an_image_in_between_lies_where_its_time_does_and_ends_go_on():
    part, frames = gain_control([30.0, 0.0, 10.0, 20.0, 50.0])
    assert [between(part, moment) for moment in (-5.0, 5.0, 17.5, 40.0, 99.0)] == [0.0, 0.5, 1.75, 3.5, 4.0]
    assert [part.at(torch.arange(5), frame).item() for frame in frames] == [3, 0, 1, 2, 4]
    assert all(part.trained_on(frame) for frame in frames)
    assert not part.trained_on(Frame("other.png", 1, CAMERA, 5.0))


def test_without_times_the_number_of_a_frame_orders():
    part, _ = gain_control([None] * 3)  # numbers 0, 3, 6
    assert part.at(torch.tensor([0.0, 1.0, 2.0]), Frame("other.png", 4, CAMERA)).item() == pytest.approx(4 / 3)


@pytest.mark.parametrize("known", [False, True])
def test_gain_control_of_images_in_between_is_asked_for(known):
    part, frames = gain_control([0.0, 10.0], between=known)
    with torch.no_grad():
        part.raw.copy_(torch.tensor([[0.1, 0.5], [-0.1, -0.5]]))
    image = torch.full((6, 8, 1), 0.3)
    first, second = (part(image, frame).mean().item() for frame in frames)
    seen = part(image, Frame("other.png", 1, CAMERA, 5.0))
    assert (seen is image) == (not known)
    if known:  # halfway between opposite settings lies none
        assert seen.mean().item() == pytest.approx(0.3, abs=1e-6) and (first - 0.3) * (second - 0.3) < 0
        late = part(image, Frame("other.png", 1, CAMERA, 9.0)).mean().item()
        assert abs(late - second) < abs(0.3 - second)


def test_a_view_that_no_one_took_is_in_the_middle_where_there_are_no_times():
    part, _ = gain_control([None] * 3)
    untaken, middle = Frame("orbit_0000.png", 7, CAMERA), Frame("3.png", 3, CAMERA)
    assert part.at(torch.arange(3.0), untaken) == part.at(torch.arange(3.0), middle) == 1.0
