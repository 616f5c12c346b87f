"""The header and the arrays of a page, read back."""

import base64
import json
import re
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from exported import started
from swinging import frames, ready, wall

from heatsplat.contracts import Camera, Frame, SceneData
from heatsplat.export.snapshot import snapshot
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.rolling_readout import RollingReadout
from heatsplat.sensors.thermal_lag import ThermalLag
from heatsplat.viewer.page import page
from heatsplat.viewer.payload import MEAN_CODE, MOMENTS, Block, _added, _attribute, _clock, _moments, _small, payload


def back(block: bytes, place: dict) -> np.ndarray:
    kind = np.dtype(f"<{place['type']}")
    return np.frombuffer(block, kind, int(np.prod(place["shape"])), place["offset"]).reshape(place["shape"])


def in_units(block: bytes, one: dict) -> np.ndarray:
    many = back(block, one["many"]).astype(int) if "many" in one else 0
    return one["step"] * (back(block, one["rest"]).astype(int) + 256 * many)


def test_arrays_come_back_and_lie_where_any_type_may_start():
    block = Block()
    stored = [
        (np.arange(3), "u1"),
        (np.array([[0.5, -2.0]]), "f8"),
        (torch.tensor([7.5]), "f4"),
        (np.array([-3, 9]), "i2"),
    ]
    places = [block.add(values, kind) for values, kind in stored]
    for (values, _), place in zip(stored, places, strict=True):
        assert place["offset"] % 8 == 0
        assert back(block.content, place).tolist() == np.asarray(values).tolist()


def test_attributes_keep_their_values_and_name_their_unit():
    block, values = Block(), torch.logspace(-2, 3, 1001)
    told = _attribute("time_constant_h", values, block)
    assert (told["label"], told["unit"], told["log"]) == ("time constant", "h", True)
    found = 10 ** (told["low"] + back(block.content, told["values"]) / 65534 * (told["high"] - told["low"]))
    assert found[2:-2] == pytest.approx(values.numpy()[2:-2], rel=1e-3)
    plain = _attribute("wind_share", torch.linspace(0.2, 0.4, 50), Block())
    assert (plain["unit"], plain["log"]) == ("", False)
    assert _attribute("nothing", torch.full((4,), torch.nan), Block())["high"] == 1.0


def test_attributes_that_a_gaussian_lacks_are_no_low_ones():
    block = Block()
    told = _attribute("u_value_w_m2_k", torch.tensor([0.3, torch.nan, 1.3]), block)
    assert back(block.content, told["values"]).tolist() == [0, 65535, 65534]


def test_small_images_are_means():
    image = torch.arange(16.0).view(4, 4)
    assert _small(image, (2, 2)).tolist() == [[2.5, 4.5], [10.5, 12.5]]
    assert _small(image[..., None].expand(-1, -1, 3), (2, 2)).shape == (2, 2, 3)


def test_a_page_holds_what_it_was_given_whatever_a_scene_is_called():
    header = {"scene": "</script><b>", "method": "etgs"}
    text = page(header, b"12345678")
    found = re.search(r'id="header">(.*?)</script>', text, re.S)[1]
    assert json.loads(found) == header and "<b>" not in text
    packed = re.search(r'id="block">(.*?)</script>', text, re.S)[1]
    assert zlib.decompress(base64.b64decode(packed)) == b"12345678"


def test_the_same_images_tell_the_time_however_a_scene_is_split():
    def split(first, test_every):
        at = Camera(torch.eye(4), torch.eye(3), 8, 6)
        shown = [Frame(f"{i}.png", i, at, 10.0 * (i - first)) for i in range(50)]
        train, test = ([f for i, f in enumerate(shown) if (i % test_every == 0) == held] for held in (False, True))
        return SimpleNamespace(frames=train + test)

    one, other = _moments(split(0, 8)), _moments(split(3, 7))
    assert [name for name, _ in one] == [name for name, _ in other] and len(one) == MOMENTS
    assert {b - a for (_, a), (_, b) in zip(one, other, strict=True)} == {-30.0}
    assert _moments(SimpleNamespace(frames=[])) == []


@pytest.mark.parametrize(
    ("weather", "notes", "told"),
    [
        ({"utc_at_zero_s": 1.7e9}, {"clock_at_zero_s": 1.6e9}, {"start": 1.7e9, "utc": True}),
        ({"clock_at_zero_s": 30.0}, {}, {"start": None, "utc": False}),
        (None, {"clock_at_zero_s": 1.6e9}, {"start": 1.6e9, "utc": False}),
        (None, {}, {"start": None, "utc": False}),
    ],
)
def test_the_clock_is_that_of_the_weather_or_of_the_frames(weather, notes, told):
    scene = SimpleNamespace(weather=weather and SimpleNamespace(notes=weather), notes=notes)
    scene.clock_at_zero_s = SceneData.clock_at_zero_s.fget(scene)
    assert _clock(scene) == told


def test_a_page_says_that_it_shows_the_mean_of_the_codes_of_images(tmp_path):
    module = started(tmp_path, "method=wild_thermal")
    header, _ = payload(module, snapshot(module), 1)
    assert header["leftOut"][-1] == MEAN_CODE


def test_what_a_part_adds_that_needs_to_know_how_far_away_things_are():
    frame = frames()[4]
    image, depth = wall(frame.time_s)
    asked = []

    def render(frame, depth=False):
        asked.append(depth)
        return SimpleNamespace(features=image[..., None], seen_depth=wall(frame.time_s)[1])

    parts = {
        "thermal_lag": ready(ThermalLag(), raw_tau=0.3),
        "rolling_readout": ready(RollingReadout(), raw_readout=0.4),
    }
    module = SimpleNamespace(render=render, sensor=SensorChain(parts), thermal=SimpleNamespace(modality_channels=(1,)))
    block = Block()
    told = _added(module, frame, tuple(image.shape), 30.0, 0.005, block)
    assert asked == [True] and [one["name"] for one in told] == ["thermal lag", "rolling readout"]
    after = module.sensor(image[..., None], frame, depth)
    added = sum(in_units(block.content, one) for one in told).reshape(image.shape)
    np.testing.assert_allclose(added, 30.0 * (after.detach()[..., 0] - image), atol=told[0]["step"] + told[1]["step"])
    assert np.abs(added).max() > 1.0


def test_a_camera_that_was_learned_stands_beside_what_it_recorded(tmp_path):
    """Added by the sensor, and drawn beside the recorded image, is what is seen from there."""
    module = started(tmp_path, "method=3dgs", "data.scene=static", "cameras=refined")
    torch.nn.init.normal_(module.cameras.moves, std=5.0)
    header, _ = payload(module, snapshot(module), cameras=2)
    for told in header["cameras"]:
        frame = next(frame for frame in module.scene.train.frames if frame.name == told["name"])
        matrix = torch.tensor(told["viewmat"], dtype=torch.float64).view(3, 4)
        assert torch.equal(matrix, module.cameras.of(frame).viewmat[:3].detach())
        assert (matrix - frame.camera.viewmat[:3]).abs().max() > 1e-3


def test_a_page_tells_the_blur_and_how_much_finer_than_images_training_rendered(tmp_path):
    for method, finer in (("3dgs", 1), ("direct_3dgs", 4)):
        module = started(tmp_path / method, f"method={method}", "data.scene=noisy_sensor")
        header, _ = payload(module, snapshot(module), cameras=1)
        told = header["renderer"]
        assert (told["antialiased"], told["finer"]) == (True, finer) and told["eps2d"] == pytest.approx(1 / 12)
