"""The sky in a mirror: what a closed form says of level ground, walls and the horizon."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet, Weather
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.splats import Splats
from heatsplat.thermal.base import SKY_SEEN, Query, Seeds
from heatsplat.thermal.mirrored_sky import MirroredSky

AIR_C, HUMIDITY = 12.0, 55.0
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def weather(air_c: float | None = AIR_C) -> Weather:
    level = torch.ones(2, dtype=torch.float64)
    air = None if air_c is None else air_c * level
    return Weather(
        torch.tensor([0.0, 3600.0], dtype=torch.float64), air_c=air, humidity_percent=HUMIDITY * level, up=UP
    )


def looking_down(position=(0.0, 0.0, 10.0)) -> Camera:
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(position)
    return Camera(viewmat, torch.eye(3), 4, 4)


def scene(record: Weather) -> SceneData:
    views = ViewSet([Frame("0.png", 0, looking_down(), 0.0)], lambda i: None)
    return SceneData("ground", views, views, views, torch.zeros(2, 3), None, ThermalRange(-40.0, 60.0), weather=record)


def ready(
    normal=(0.0, 0.0, 1.0), share: float = 0.2, closed: float | None = None, **extra
) -> tuple[MirroredSky, Splats]:
    record = weather()
    if closed is not None:
        record = replace(record, clouds=torch.full_like(record.times_s, closed))
    part = MirroredSky(reflectance=share, clouds=closed is not None)
    part.check(scene(record))
    part.prepare(scene(record))
    seeds = Seeds(torch.zeros(1, 3), torch.zeros(1, 1), torch.Generator())
    declared = {name: item.initial for name, item in part.per_gaussian(seeds).items()}
    tensors = {"means": torch.zeros(1, 3), "log_scales": torch.zeros(1, 3), "quats": torch.ones(1, 4)}
    declared["normals"] = torch.tensor([normal])
    return part, Splats(tensors | {"opacity_logits": torch.zeros(1, 1)} | declared | extra)


def shown(part, splats, celsius: float, camera=None) -> float:
    unit = torch.tensor([[(celsius + 40.0) / 100.0]])
    found = part(unit, splats, Query(camera=camera or looking_down(), time_s=600.0))
    return -40.0 + 100.0 * found.item()


def test_level_ground_shows_the_zenith_and_a_roof_under_trees_the_air():
    air = torch.tensor(AIR_C + 273.15, dtype=torch.float64)
    sky_k = float(sky_temperature_k(air, torch.tensor(HUMIDITY, dtype=torch.float64), "brutsaert"))
    depth = -math.log(1 - (sky_k / float(air)) ** 4) / 1.66
    zenith = float(air) ** 4 * (1 - math.exp(-depth))
    part, splats = ready()
    expected = (0.8 * (20.0 + 273.15) ** 4 + 0.2 * zenith) ** 0.25 - 273.15
    assert shown(part, splats, 20.0) == pytest.approx(expected, abs=1e-3)
    assert expected < 13.0  # colder by the sky
    slanting = shown(part, splats, 20.0, looking_down((9.0, 0.0, 2.0)))
    assert expected + 1.0 < slanting < 20.0  # towards the horizon air is thick
    part, splats = ready(**{SKY_SEEN: torch.zeros(1)})
    hidden = (0.8 * (20.0 + 273.15) ** 4 + 0.2 * float(air) ** 4) ** 0.25 - 273.15
    assert shown(part, splats, 20.0) == pytest.approx(hidden, abs=1e-3)
    part, splats = ready(normal=(1.0, 0.0, 0.0))  # a wall seen from above and aside mirrors the ground
    assert shown(part, splats, 20.0, looking_down((5.0, 0.0, 5.0))) == pytest.approx(hidden, abs=1e-3)
    part, splats = ready(share=1e-6)
    assert shown(part, splats, 20.0) == pytest.approx(20.0, abs=1e-3)


def test_under_clouds_a_mirror_shows_the_warmth_of_the_air():
    clear, half, closed = (shown(*ready(closed=share), 20.0) for share in (0.0, 0.5, 1.0))
    assert clear == pytest.approx(shown(*ready(), 20.0), abs=1e-4) and clear + 0.5 < half < closed - 0.5
    air = (0.8 * (20.0 + KELVIN_AT_0_C) ** 4 + 0.2 * (AIR_C + KELVIN_AT_0_C) ** 4) ** 0.25 - KELVIN_AT_0_C
    assert closed == pytest.approx(air, abs=0.05)
    with pytest.raises(SceneError, match="weather of scene 'ground' tells no clouds, which clouds=true needs"):
        MirroredSky(clouds=True).prepare(scene(weather()))


def test_its_share_is_learned_and_what_it_needs_is_asked_for():
    part, splats = ready()
    part(torch.tensor([[0.6]]), splats, Query(camera=looking_down(), time_s=0.0)).sum().backward()
    assert splats["sky_reflectance_logit"].grad.abs().min() > 0
    assert part.attributes(splats, Query())["sky_reflectance"].item() == pytest.approx(0.2)
    assert part.effects() == {"mirrored_sky": {"law": "auto"}}
    with pytest.raises(ValueError, match="give a camera"):
        part(torch.zeros(1, 1), splats, Query(time_s=0.0))
    with pytest.raises(SceneError, match="has no air_c"):
        MirroredSky().prepare(scene(weather(None)))
    with pytest.raises(ValueError, match=r"reflectance must lie in \(0, 1\)"):
        MirroredSky(reflectance=0.0)
