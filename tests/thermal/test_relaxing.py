"""What relaxing models have in common: the temperature of the surroundings, and the range of the image."""

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet
from heatsplat.thermal.base import Query, Rate
from heatsplat.thermal.relaxing import Relaxing

RANGE = ThermalRange(20.0, 70.0)


class Halfway(Relaxing):
    """Gaussians that are at the middle between the surroundings and twice the image's range."""

    cost = 1

    def __init__(self, **options):
        super().__init__(**{"ambient": "measured", "clip": "hard", "lr_ambient": 0.1, "lr_end": 0.5} | options)

    def _state(self, splats, time_s, ids):
        return (self.ambient + 2.0) / 2.0 * torch.ones(3)


def scene(ambient_c=25.0, thermal_range=RANGE):
    frames = [Frame(f"{t}.png", t, Camera(torch.eye(4), torch.eye(3), 4, 4), 10.0 * t) for t in range(3)]
    views = ViewSet(frames, lambda i: None)
    return SceneData("room", views, views, views, torch.zeros(4, 3), None, thermal_range, ambient_c)


def ready(scene_data=None, **options):
    model = Halfway(**options)
    model.prepare(scene_data or scene())
    return model


def test_a_measured_ambient_temperature_stays():
    model = ready()
    assert model.ambient.item() == pytest.approx(0.1) and model.ambient_is == "fixed" and not list(model.parameters())
    torch.testing.assert_close(model.temperature(None, 0.0), torch.full((3,), 273.15 + 20.0 + 50.0 * 1.05))
    assert model.features(None, Query(time_s=0.0)).eq(1.0).all()  # clipped, [n, 1]


def test_an_unknown_one_is_learned_from_where_most_of_the_scene_is():
    model = ready(scene(ambient_c=None))
    assert model.ambient_is == "learned" and model.rate_of("ambient") == Rate(0.1, 0.5)
    model.guess_ambient(torch.tensor([0.2, 0.3, 0.9]))
    assert model.ambient.item() == pytest.approx(0.3)


def test_a_known_one_is_not_guessed_though_it_is_learned():
    model = ready(ambient="learned")
    model.guess_ambient(torch.tensor([0.9]))
    assert model.ambient_is == "learned" and model.ambient.item() == pytest.approx(0.1)


def test_a_number_is_in_celsius():
    assert ready(ambient=45.0).ambient.item() == pytest.approx(0.5)
    with pytest.raises(SceneError, match="ambient=45.0 is in °C, but scene 'room' has no temperature range"):
        ready(scene(thermal_range=None), ambient=45.0)


def test_without_a_range_there_are_no_kelvin():
    assert ready(scene(thermal_range=None)).temperature(None, 0.0) is None


@pytest.mark.parametrize(("options", "said"), [({"ambient": "warm"}, "ambient must be"), ({"clip": "soft"}, "clip")])
def test_unknown_options_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        Halfway(**options)
