"""Offsets per image: the identity at first, gauge and bounds, what an image in between gets, recovery of a known drift."""

import math

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.frame_offset import FrameOffset

HEIGHT, WIDTH = 6, 8
CAMERA = Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
TIMES = [30.0, 0.0, 10.0, 20.0, 50.0]


def make_scene(times=TIMES):
    frames = [Frame(f"{i}.png", 3 * i, CAMERA, time) for i, time in enumerate(times)]
    views = ViewSet(frames, lambda index: None)
    return SceneData("flight", views, views, views, torch.zeros(4, 3))


def ready(values=None, scene=None, **options):
    part = FrameOffset(**options)
    part.prepare(scene or make_scene())
    if values is not None:
        with torch.no_grad():
            part.raw_offset.copy_(torch.tensor(values))
            if part.raw_gain is not None:
                part.raw_gain.copy_(torch.tensor(values))
    return part


def noise(seed=0):
    return torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("gain_max", [0.0, 0.1])
def test_a_new_part_is_exactly_the_identity(gain_max):
    part = ready(gain_max=gain_max)
    for frame in make_scene().train.frames:
        assert torch.equal(part(noise(), frame), noise())
    assert part.regulariser().item() == 0


def test_there_is_one_parameter_per_training_image_and_no_gain_unless_asked_for():
    assert {name: parameter.shape for name, parameter in ready().named_parameters()} == {"raw_offset": (5,)}
    assert len(list(ready(gain_max=0.1).parameters())) == 2


def test_the_mean_belongs_to_the_scene_and_offsets_are_bounded():
    part = ready([3.0, 100.0, -2.0, 0.5, 50.0], gain_max=0.1)
    assert abs(part.offsets().mean().item()) < 1e-7 and abs(part.gains().mean().item()) < 1e-7
    assert part.offsets().abs().max() <= 2 * part.offset_max
    shifted = part(noise(), make_scene().train.frames[2]) - noise()
    assert shifted.abs().max() <= 2 * (part.offset_max + part.gain_max)


def test_every_training_image_has_its_own_and_others_lie_between_their_neighbours():
    part = ready([0.1, -0.4, 0.3, 0.2, 0.6])  # in order of time: 0, 10, 20, 30, 50 s
    offsets = part.offsets()
    frames = make_scene().train.frames
    seen = {frame.time_s: (part(noise(), frame) - noise()).mean() for frame in frames}
    assert torch.allclose(torch.stack([seen[time] for time in sorted(seen)]), offsets, atol=1e-6)
    for time, expected in (
        (15.0, (offsets[1] + offsets[2]) / 2),
        (45.0, 0.25 * offsets[3] + 0.75 * offsets[4]),
        (-5.0, offsets[0]),
        (99.0, offsets[4]),
    ):
        got = (part(noise(), Frame("new", 100, CAMERA, time)) - noise()).mean()
        assert got.item() == pytest.approx(expected.item(), abs=1e-6)


def test_without_time_the_number_of_the_frame_orders_images():
    part = ready([0.1, -0.4, 0.3, 0.2, 0.6], make_scene([None] * 5))
    between = part(noise(), Frame("new", 4, CAMERA, None)) - noise()  # a third of the way from frame 3 to frame 6
    expected = torch.lerp(part.offsets()[1], part.offsets()[2], 1 / 3)
    assert torch.allclose(between, expected.expand_as(between), atol=1e-6)


def test_a_known_drift_is_found_and_the_scene_is_left_alone():
    times = [float(t) for t in range(0, 40, 2)]
    drift = torch.tensor([0.05 * math.sin(t / 6) + 0.001 * t for t in times])
    scene, clean = make_scene(times), noise()
    part = ready(scene=scene)
    optimizer = torch.optim.Adam(part.parameters(), lr=part.lr)
    for _ in range(60):
        loss = sum(
            (part(clean, frame) - clean - drift[i]).square().mean() for i, frame in enumerate(scene.train.frames)
        )
        optimizer.zero_grad()
        (loss + part.regulariser()).backward()
        optimizer.step()
    assert (part.offsets() - (drift - drift.mean())).abs().max() < 3e-3  # of 4e-2


def test_a_checkpoint_restores_moments_and_offsets():
    part, other = ready([0.1, -0.4, 0.3, 0.2, 0.6], gain_max=0.05), ready(gain_max=0.05)
    other.load_state_dict(part.state_dict())
    frame = Frame("new", 100, CAMERA, 17.0)
    assert torch.equal(other(noise(), frame), part(noise(), frame))


def test_the_chain_tells_the_effect():
    assert SensorChain({"drift": ready(), "none": None}).effects() == {
        "frame_offset": {"per_frame": "offset", "frames": 5}
    }


@pytest.mark.parametrize("options", [{"offset_max": 0.0}, {"gain_max": 1.0}, {"gain_max": -0.1}])
def test_bounds_out_of_range_are_refused(options):
    with pytest.raises(ValueError, match="offset_max must be positive and gain_max lie in"):
        FrameOffset(**options)
