"""The catalogue and its verdicts: choices, missing metadata, and scenes in which there is nothing to see."""

from dataclasses import replace

import pytest
import torch
from weathered import make_weather

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, View, ViewSet, Weather
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects import catalogue
from heatsplat.effects.base import STAGES, Evidence
from heatsplat.effects.catalogue import CATALOGUE, decide
from heatsplat.effects.weather_record import drivers, drives

NAMES = (
    "relaxation", "harmonic_source", "semi_infinite", "solar", "radiation", "convection", "conduction", "shadows",
    "sky_view", "albedo", "directional_emissivity", "view_dependence", "reflection", "mirrored_sky", "attenuation",
    "thermal_opacity", "point_spread", "thermal_lag", "rolling_readout", "fixed_pattern", "vignetting", "frame_offset",
    "agc", "tone", "pixel_area",
)  # fmt: skip


def scene_of(images, times=None, points=0, thermal_range=None) -> SceneData:
    """A scene of these images [F, H, W] by a camera that moves sideways along a plane of points."""
    height, width = images.shape[1:]
    K = torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])
    frames = []
    for i in range(len(images)):
        viewmat = torch.eye(4)
        viewmat[0, 3] = -0.05 * i
        frames.append(Frame(f"{i:03d}.png", i, Camera(viewmat, K, width, height), None if times is None else times[i]))
    views = ViewSet(frames, lambda i: View(frames[i], images[i, ..., None].float()))
    generator = torch.Generator().manual_seed(0)
    spots = torch.rand(points, 3, generator=generator) * torch.tensor([2.0, 1.0, 0.0]) + torch.tensor([-0.5, -0.5, 2.0])
    empty = views.subset([])
    return SceneData("made", views, empty, empty, spots, thermal_range=thermal_range)


def noise(frames: int, seed: int = 0, size: tuple[int, int] = (24, 32)) -> torch.Tensor:
    return 0.5 + 0.01 * torch.randn(frames, *size, generator=torch.Generator().manual_seed(seed))


def test_the_catalogue_has_every_effect_once_and_says_all_of_it():
    assert tuple(effect.name for effect in CATALOGUE) == NAMES
    for effect in CATALOGUE:
        assert effect.stage in STAGES
        assert effect.threshold > 0
        assert all((effect.summary, effect.source, effect.null, effect.adds)), effect.name


@pytest.mark.parametrize(
    "scene",
    [
        scene_of(noise(1), [0.0], points=50),
        scene_of(noise(8), [10.0 * i for i in range(8)], points=0),
        scene_of(noise(8), None, points=50),
        scene_of(noise(8, size=(3, 4)), [10.0 * i for i in range(8)], points=50),
        scene_of(noise(8), [5.0] * 8, points=50),
        scene_of(torch.full((8, 24, 32), 0.5), [10.0 * i for i in range(8)], points=50),
    ],
    ids=["one frame", "no points", "no time", "tiny images", "one moment", "one grey"],
)
def test_where_there_is_nothing_to_see_all_is_off_with_a_reason(scene):
    verdicts = decide(scene)
    assert tuple(verdicts) == NAMES
    for verdict in verdicts.values():
        assert not verdict.on, verdict
        assert len(verdict.reason) > 10, verdict
        assert verdict.settings == {}


def test_missing_metadata_rules_out_and_is_named():
    verdicts = decide(scene_of(noise(8), None, points=50))
    assert "lacks time" in verdicts["relaxation"].reason
    assert "lacks thermal_range, time, weather" in verdicts["solar"].reason
    chosen = decide(scene_of(noise(8), None, points=50), {"solar": "on"})["solar"]
    assert not chosen.on and "lacks thermal_range, time, weather" in chosen.reason


def test_choices_win_over_evidence():
    scene = scene_of(noise(8), [10.0 * i for i in range(8)], points=50)
    verdicts = decide(scene, {"vignetting": "on", "agc": "off", "tone": "auto"})
    assert verdicts["vignetting"].on and verdicts["vignetting"].reason == "effects.vignetting=on"
    assert not verdicts["agc"].on and verdicts["agc"].reason == "effects.agc=off"
    assert not verdicts["tone"].on


def test_unknown_effects_and_choices_are_refused():
    scene = scene_of(noise(2), [0.0, 1.0])
    with pytest.raises(SceneError, match="effects.glow: there is no such effect"):
        decide(scene, {"glow": "on"})
    with pytest.raises(SceneError, match="effects.agc must be one of on, off, auto, got 'maybe'"):
        decide(scene, {"agc": "maybe"})


def test_no_verdict_looks_at_images_that_are_held_out():
    scene = scene_of(noise(8), [10.0 * i for i in range(8)], points=50, thermal_range=ThermalRange(0.0, 10.0))
    dark, bright = scene_of(torch.zeros(3, 24, 32)).train, scene_of(torch.ones(3, 24, 32)).train
    assert decide(replace(scene, test=dark, val=bright)) == decide(replace(scene, test=bright, val=dark))


def test_a_record_of_wind_and_rain_alone_hides_no_cooling():
    """Nothing follows these over time: a scene under them relaxes as it does without a record, and no source drives it."""
    cooling = Synthetic(scene="cooling", size="tiny").scene
    times_s = torch.linspace(*cooling.record, 30, dtype=torch.float64)
    ones = torch.ones_like(times_s)
    windy = Weather(times_s, wind_m_s=2.0 * ones, rain_mm_h=0.1 * ones, humidity_percent=50.0 * ones)
    assert not drives(windy) and drives(replace(windy, air_c=ones)) and not drives(None)
    assert drivers(windy, times_s) is None
    verdicts = decide(replace(cooling, weather=windy))
    assert verdicts["relaxation"].on and verdicts["relaxation"].told, verdicts["relaxation"]
    assert not verdicts["harmonic_source"].on and verdicts["harmonic_source"].told, verdicts["harmonic_source"]


@pytest.mark.parametrize(("told", "likely", "on"), [(False, True, True), (False, False, False), (True, True, False)])
def test_what_cannot_be_told_is_simulated_where_it_is_likely(told, likely, on, monkeypatch):
    found = Evidence(1.7, "gains a little", {"clouds": True}, told, 0.2, likely)
    wind = replace(CATALOGUE[NAMES.index("convection")], evidence=lambda inspected: found)
    monkeypatch.setattr(catalogue, "CATALOGUE", (wind,))
    outdoors = replace(
        scene_of(noise(8), [10.0 * i for i in range(8)], 50, ThermalRange(0.0, 10.0)), weather=make_weather()
    )
    verdict = decide(outdoors, {})["convection"]
    assert (verdict.on, verdict.told, verdict.settings) == (on, told, {"clouds": True} if on else {})
