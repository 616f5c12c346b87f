"""Bodies without an end: told on walls of thick stone, and not on thin ones that are lumps or on bodies with a core."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from effects.test_weathered import recorded

from heatsplat.composition import build, compose
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.facade import BODIES, STONE, FacadeScene, effusivity
from heatsplat.effects import assembly, catalogue, weather_record
from heatsplat.effects.base import Verdict
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.semi_infinite import EFFECT
from heatsplat.effects.weathered import Weathered

FRAMES = 48
PLACES = [[x, -0.02, z] for x in (-4.5, -2.0, -1.0, 0.3, 2.0, 4.0) for z in (0.3, 0.9, 1.8, 2.8, 3.5, 4.4)]


def followed(thickness_m=None):
    """Points on the front of thick stone, or of stone of this thickness before a room of the air's mean, with noise of 0.05 K."""
    preset = STONE
    if thickness_m is not None:
        bodies = [
            replace(s.material, layers=(replace(s.material.layers[0], thickness_m=thickness_m),))
            for s in STONE.surfaces
        ]
        bodies = [replace(body, back_w_m2_k=0.0) for body in bodies]
        preset = replace(STONE, surfaces=tuple(map(lambda s, b: replace(s, material=b), STONE.surfaces, bodies)))
    world, where = FacadeScene(preset), torch.tensor(PLACES, dtype=torch.float64)
    times, _ = world.route(FRAMES, seed=0)
    times = torch.from_numpy(times)
    points, which = world.nearest(where)
    values = world.celsius(world.heat_at(points, which), times)
    values = values + 0.05 * torch.randn(values.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    front = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64).expand(len(where), 3)
    ones = torch.ones_like(values)
    return Weathered(world.weather, times, values, 0.05 * ones, ones, front)


def verdict(weathered, monkeypatch, bent=False):
    monkeypatch.setattr(weather_record, "bent", lambda obs: bent)
    return EFFECT.evidence(SimpleNamespace(weathered=weathered, obs=SimpleNamespace(why="")))


def test_walls_of_thick_stone_have_no_end(monkeypatch):
    found = verdict(followed(), monkeypatch)
    assert found.told and found.statistic > EFFECT.threshold and found.gain_db > 3.0


@pytest.mark.parametrize("depth", [0.0, 3.0], ids=["one rate", "a core"])
def test_bodies_of_one_or_two_rates_are_not_taken_for_such(depth, monkeypatch):
    found = verdict(recorded(depth=depth), monkeypatch)
    assert found.statistic <= EFFECT.threshold, found


def test_thin_slabs_are_not_taken_for_such(monkeypatch):
    found = verdict(followed(thickness_m=0.03), monkeypatch)
    assert found.statistic <= EFFECT.threshold, found


def test_walls_that_a_core_explains_as_well_are_not_taken_for_such():
    scene = Synthetic(scene="facade", size="tiny", frames=56).scene
    relaxation = next(effect for effect in catalogue.CATALOGUE if effect.name == "relaxation")
    inspected = Inspection(scene, [relaxation])
    gain, of_a_core = inspected.weathered.endless
    found = EFFECT.evidence(inspected)
    assert gain.sigmas > 3.0 and abs(of_a_core.sigmas) < 1.0  # its insulation and brick are no lump, and have an end
    assert not found.told and found.statistic <= EFFECT.threshold and "a core do as well" in found.reason


def test_where_the_fourth_power_is_bent_it_is_left_out(monkeypatch):
    found = verdict(followed(), monkeypatch, bent=True)
    assert found.statistic == 0.0 and "bent" in found.reason


def test_a_recording_of_stone_decides_for_it_and_the_model_has_it():
    scene = Synthetic(scene="stone", size="tiny", frames=FRAMES).scene
    relaxation = next(effect for effect in catalogue.CATALOGUE if effect.name == "relaxation")
    found = EFFECT.evidence(Inspection(scene, [relaxation]))
    assert found.told and found.statistic > EFFECT.threshold, found
    radiation = {"solution": "corrected", "nodes": 2}  # as its evidence could say; what has no end is heard first
    settings = {EFFECT.name: found.settings, "radiation": radiation}
    names = {"relaxation", *settings}
    on = {name: Verdict(name, name in names, None, None, "told", settings.get(name, {})) for name in assembly.NAMES}
    templates = compose(["method=auto"])["effects"]
    state = build(assembly.assemble(on, templates)["thermal"]["state"])
    assert state.options.semi_infinite and state.options.nodes == 1 and state.options.linear
    without = assembly.assemble(assembly.without(on, EFFECT.name), templates)["thermal"]["state"]
    assert without["semi_infinite"] is False and without["nodes"] == 2


def test_the_scene_tells_the_effusivity_of_what_has_no_end():
    assert effusivity(BODIES["granite"]) == pytest.approx((2.8 * 2.2e6) ** 0.5)
    assert effusivity(BODIES["wall"]) != effusivity(BODIES["wall"])
