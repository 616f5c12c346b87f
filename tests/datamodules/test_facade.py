"""The front of a heated house: what its walls are, and how warm that keeps them."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.facade import BODIES, DURATION_S, FACADE, FacadeScene, u_value
from heatsplat.datamodules.synthetic_scene.layered_heat import Patches, Sky, solve

PLACES = {"wall": (0.0, -0.02, 5.2), "thin insulation": (-3.5, -0.02, 4.2), "no insulation": (3.4, -0.02, 4.2)}


def test_the_loss_of_a_wall_in_steady_weather_is_its_u_value():
    times = torch.arange(0.0, 60 * 86400.0, 3600.0).double().numpy()
    names = list(PLACES)
    none, sky = 0 * times, 0 * times + 273.15
    still = Sky(times, sky, none, none, none, 5.670374e-8 * sky**4)
    patches = Patches(torch.arange(3).numpy(), none[:3], none[:3] + 1, none[:, None] + none[:3])
    surface = solve([BODIES[name] for name in names], patches, still, 280.0, step_s=3600.0).surface_k[-1] - 273.15
    for name, warm in zip(names, surface, strict=True):
        within = 1 / u_value(BODIES[name]) - 0.04
        exchange = 5.0 + 0.95 * 5.670374e-8 * ((warm + 273.15) ** 4 - 273.15**4) / warm  # with air and sky at 0 °C
        assert exchange * warm == pytest.approx((20.0 - warm) / within, rel=0.01)


def test_defects_stay_warm_by_night_and_the_scene_tells_their_u_values():
    scene = Synthetic(scene="facade", size="tiny").scene
    assert len(scene.test) == 3 and scene.weather is not None and max(scene.train.times_s) < DURATION_S
    where = torch.tensor(list(PLACES.values()), dtype=torch.float64)
    night = scene.truth(where, torch.arange(8, 14) * 3600.0).mean(1)
    assert night[2] > night[1] + 0.5 > night[0] + 0.8
    told = scene.true_attributes(torch.cat([where, torch.tensor([[0.0, -4.0, 0.0]])]))["u_value_w_m2_k"].tolist()
    assert told[:3] == [pytest.approx(u_value(BODIES[name])) for name in PLACES] and math.isnan(told[3])


def test_it_has_one_weather():
    with pytest.raises(SceneError, match="two winter nights only"):
        FacadeScene(replace(FACADE, weather="windy"))
