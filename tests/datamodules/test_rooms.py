"""Rooms furnished at random: the same for a number, different for another, and loaded by name."""

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.rooms import number_of, room


def test_a_number_is_a_room():
    assert room(3) == room(3) != room(4)
    assert room(3).start_k["floor"] != room(4).start_k["floor"]
    counts = {len(room(number).surfaces) for number in range(12)}
    assert counts <= set(range(8, 13)) and len(counts) > 2
    assert not {room(number).surfaces for number in range(12)} & {preset.surfaces for preset in PRESETS.values()}


def test_objects_stand_on_the_floor_apart_from_each_other():
    for number in range(12):
        bounds = [surface.shape.bounds() for surface in room(number).surfaces[4:]]
        for i, (center, _) in enumerate(bounds):
            assert 0 < center[2] < 0.5
            assert all(abs(center[0] - o[0]) > 0.3 or abs(center[1] - o[1]) > 0.3 for o, _ in bounds[:i])


def test_names_of_rooms():
    assert number_of("room_17", "room_") == 17
    assert [number_of(name, "room_") for name in ("room_", "room_x", "room_-1", "static")] == [None] * 4
    with pytest.raises(SceneError, match="room_0, room_1 and so on"):
        Synthetic(scene="room_x")


def test_a_room_is_filmed():
    scene = Synthetic(scene="room_5", size="tiny", frames=4).scene
    images = torch.stack([view.thermal for view in scene.train])
    assert images.std() > 0.1 and scene.notes["source"].startswith("synthetic preset room_5")
