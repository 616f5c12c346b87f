"""A small scene with weather, classes and metres, for tests of models that weather drives."""

from __future__ import annotations

from dataclasses import replace

import torch

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, ViewSet, Weather

HOUR_S = 3600.0
CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def make_weather(**without) -> Weather:
    """Two hours before the first frame to twenty after it, every 30 minutes: sun for half a day, then night."""
    times = torch.arange(-2 * HOUR_S, 20 * HOUR_S + 1, HOUR_S / 2, dtype=torch.float64)
    hours = times / HOUR_S
    elevation = torch.sin(torch.pi * hours / 10.0)
    sun = torch.stack([torch.cos(torch.pi * hours / 10.0), torch.zeros_like(hours), elevation], 1)
    whole = Weather(
        times,
        air_c=15.0 + 5.0 * torch.sin(torch.pi * (hours - 2) / 12),
        wind_m_s=1.0 + (hours / 4).sin().abs(),
        humidity_percent=60.0 - hours,
        irradiance_w_m2=800.0 * elevation.clamp(min=0),
        pressure_hpa=1013.0 + hours / 10,
        direct_w_m2=torch.where(elevation > 0, 700.0, 0.0).double(),
        diffuse_w_m2=100.0 * elevation.clamp(min=0),
        sun=sun / sun.norm(dim=1, keepdim=True),
    )
    return replace(whole, **without)


def make_scene(points: int = 60, times=(0.0, 2 * HOUR_S, 9 * HOUR_S), weather: Weather | None = None, **changed):
    """A cloud of points in the box [0, 4] x [0, 4] x [0, 1] metres, seen at these times; classes by turns."""
    frames = [Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)]
    views = ViewSet(frames, lambda index: None)
    where = torch.rand(points, 3, generator=torch.Generator().manual_seed(5)) * torch.tensor([4.0, 4.0, 1.0])
    scene = SceneData(
        "yard",
        views,
        views.subset([0]),
        views.subset([1]),
        where,
        thermal_range=ThermalRange(0.0, 50.0),
        metres_per_unit=1.0,
        weather=make_weather() if weather is None else weather,
        labels=torch.arange(points) % 10,
    )
    return replace(scene, **changed)
