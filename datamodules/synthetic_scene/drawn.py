"""Scenes drawn at random, with what they show: to ask of as many as are wanted whether the verdicts on effects are right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from heatsplat.datamodules.synthetic_scene.flaws import CameraFlaws, Gloss, Haze
from heatsplat.datamodules.synthetic_scene.heat import Material, periodic
from heatsplat.datamodules.synthetic_scene.outdoor import NIGHT_S, YARD, OutdoorPreset
from heatsplat.datamodules.synthetic_scene.outdoor_sky import SKIES
from heatsplat.datamodules.synthetic_scene.presets import PANE, Lamp, Pattern, Preset
from heatsplat.datamodules.synthetic_scene.rooms import room
from heatsplat.datamodules.synthetic_scene.shapes import Box
from heatsplat.training.rng import generator_for

DRAWN = "drawn_"  # what their names begin with; a number follows
OUTDOORS, NIGHT = 0.2, 0.3  # share of scenes under the sky, and of these that are filmed in one night
CAUSES = (0.15, 0.35, 0.3, 0.2)  # probability that nothing, one, two or three things are at work indoors
# What may be at work, and how often each is drawn. Of "state" and of "gloss" there is one at most.
STATES = {"cooling": 2.0, "heated": 2.0, "sheets": 1.0}
GLOSSES = {"dull": 1.0, "mirrors": 1.0}
OTHERS = {"haze": 1.5, "pane": 1.0, "blur": 1.0, "pattern": 1.5, "corners": 1.5, "drift": 1.5, "gain": 1.5, "bend": 1.0}
FLAWLESS = CameraFlaws(gain=0.0, bias=0.0, falloff=(0.0, 0.0))


@dataclass(frozen=True)
class Drawn:
    """A scene and how it is recorded.

    Args:
        preset: the scene; ``effects`` are those that it shows.
        frames: of the recording.
        noise_k: of a pixel, in kelvin.
        bits: of the stored images.
        pose_error_px: by which cameras are turned from where they looked, standard deviation along each side of the image.
    """

    preset: Preset
    frames: int
    noise_k: float
    bits: int
    pose_error_px: float


class _Dice:
    """Draws from one generator."""

    def __init__(self, number: int) -> None:
        self.generator = generator_for(number, 0, "drawn scene")

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=self.generator, dtype=torch.float64).item()

    def spread(self, low: float, high: float) -> float:
        """Between two positive numbers, as likely in every octave."""
        return math.exp(self.between(math.log(low), math.log(high)))

    def happens(self, probability: float) -> bool:
        return self.between(0.0, 1.0) < probability

    def one_of(self, weights: Mapping[str, float]) -> str:
        return list(weights)[int(torch.multinomial(torch.tensor(list(weights.values())), 1, generator=self.generator))]


def drawn(number: int) -> Drawn:
    """The scene of a number; the same bits for the same number."""
    dice = _Dice(number)
    preset = _yard(dice) if dice.happens(OUTDOORS) else _room(dice, number)
    return Drawn(
        preset,
        frames=round(dice.spread(9.0, 48.0)),
        noise_k=dice.spread(0.03, 0.3),
        bits=8 if dice.happens(0.3) else 16,
        pose_error_px=dice.between(0.0, 1.0) if dice.happens(0.6) else 0.0,
    )


def _room(dice: _Dice, number: int) -> Preset:
    chances = {"state": sum(STATES.values()), "gloss": sum(GLOSSES.values()), **OTHERS}
    causes = set()
    for _ in range(int(dice.one_of({str(n): chance for n, chance in enumerate(CAUSES)}))):
        causes.add(dice.one_of({name: chance for name, chance in chances.items() if name not in causes}))
    preset = room(number)
    if "state" in causes:
        preset = _changing(preset, dice.one_of(STATES), dice)
    if "gloss" in causes:
        preset = _glossy(preset, dice.one_of(GLOSSES), dice)
    if "haze" in causes:
        swing = dice.between(0.3, 0.9) if dice.happens(0.5) else 0.0
        haze = Haze(dice.spread(0.1, 0.5), swing, dice.between(1.0, 3.0))
        preset = _with(preset, "attenuation", haze=haze, approach_m=dice.between(0.15, 0.6))
    if "pane" in causes:
        width = dice.between(0.5, 1.1)
        pane = replace(PANE, shape=Box((dice.between(-0.3, 0.3), -0.65, 0.37), (width, 0.012, 0.74)))
        start = {**preset.start_k, "pane": Pattern(dice.between(3.0, 10.0), 2.0 * (not preset.diffusivity), 0.5)}
        preset = _with(preset, "thermal_opacity", surfaces=(*preset.surfaces, pane), start_k=start)
    return _seen_by(preset, causes, dice)


def _changing(preset: Preset, state: str, dice: _Dice) -> Preset:
    preset = _with(preset, "relaxation", held=False, duration_s=round(dice.spread(900.0, 3600.0)))
    if state == "sheets":
        # A pattern on copper levels out before the sheet is cold.
        chosen = [one for one in preset.surfaces if one.name[:6] != "object" or isinstance(one.shape, Box)]
        sheets = tuple(replace(one, material=Material(390.0, 3.4e6, 0.003, 11.0)) for one in chosen)
        start = {one.name: Pattern(dice.between(15.0, 30.0), 9.0, dice.between(0.7, 1.2)) for one in sheets}
        return _with(preset, "conduction", surfaces=sheets, start_k=start, diffusivity=dice.spread(0.8e-4, 2e-4))
    if state == "heated":
        cool = {
            name: replace(p, level=p.level / 6, swing=p.swing / 3, step=p.step / 3)
            for name, p in preset.start_k.items()
        }
        period = preset.duration_s / dice.between(1.5, 4.0)
        lamp = Lamp(
            position=(dice.between(-1.0, 1.0), -2.0, dice.between(1.5, 2.5)),
            aim=(dice.between(-0.2, 0.2), dice.between(0.0, 0.3), 0.25),
            half_angle_deg=dice.between(25.0, 45.0),
            flux_w_m2=dice.spread(500.0, 1500.0),
            waveform=periodic(period, period * dice.between(0.4, 0.6), 0.2 * period, preset.duration_s),
        )
        return _with(preset, "harmonic_source", start_k=cool, lamp=lamp)
    return preset


def _glossy(preset: Preset, gloss: str, dice: _Dice) -> Preset:
    if gloss == "dull":
        return _with(preset, "directional_emissivity", gloss=Gloss(fade=dice.between(0.2, 0.5)))
    towards = (dice.between(-1.0, 1.0), dice.between(-1.0, -0.2), dice.between(0.0, 1.0))
    mirrors = Gloss(mirrors=dice.between(0.08, 0.3), warm_k=dice.between(30.0, 80.0), towards=towards)
    return _with(preset, "reflection", gloss=mirrors)


def _seen_by(preset: Preset, causes: set[str], dice: _Dice) -> Preset:
    """The preset before a camera with the flaws among ``causes``."""
    flaws = FLAWLESS
    if "blur" in causes:
        preset, flaws = _with(preset, "point_spread"), replace(flaws, blur_px=dice.between(1.0, 2.0))
    if "pattern" in causes:
        preset = _with(preset, "fixed_pattern")
        flaws = replace(
            flaws, gain=dice.between(0.01, 0.04), bias=dice.between(0.01, 0.03), nodes=4 + int(dice.between(0, 4))
        )
    if "corners" in causes:
        preset, total = _with(preset, "vignetting"), -dice.between(0.1, 0.3)
        share = dice.between(0.4, 0.8)
        flaws = replace(flaws, falloff=(share * total, (1.0 - share) * total))
    if "bend" in causes:  # which shows only where something shifts along the curve
        preset, flaws = _with(preset, "tone"), replace(flaws, bend=dice.between(0.2, 0.4))
    if "gain" in causes:
        preset = _with(preset, "agc")
        kind, every = dice.one_of({"steps": 1.0, "walk": 1.0, "stretch": 1.0}), 3 + int(dice.between(0, 6))
        if kind == "steps":
            flaws = replace(flaws, step=dice.between(0.01, 0.04), frames_per_step=every)
        elif kind == "walk":
            flaws = replace(flaws, gain_drift=dice.between(0.005, 0.02), frames_per_step=1000)
        else:
            flaws = replace(flaws, stretch=dice.between(0.1, 0.3), shift=dice.between(0.05, 0.3))
    if causes & {"drift", "bend"}:
        flaws = replace(flaws, drift=dice.between(0.01 if "bend" in causes else 0.004, 0.02))
        if "gain" not in causes:  # whose shift takes what offsets there are
            preset = _with(preset, "frame_offset")
    return preset if flaws == FLAWLESS else replace(preset, flaws=flaws)


def _yard(dice: _Dice) -> Preset:
    """The yard of other materials under any sky: with and without wind that counts, with and without long waves."""
    windy, radiates, night = dice.happens(0.75), dice.happens(0.75), dice.happens(NIGHT)
    sky = dice.one_of(dict.fromkeys(SKIES, 1.0))

    def other(material):
        return replace(
            material,
            conductivity=material.conductivity * dice.spread(0.6, 1.6),
            heat_capacity=material.heat_capacity * dice.spread(0.8, 1.2),
            depth_m=material.depth_m * dice.spread(0.6, 1.6),
            emissivity=dice.between(0.8, 0.97) if radiates else 0.03,  # bare metal
            convection_still=dice.between(5.0, 9.0),
            convection_per_wind=dice.between(2.0, 4.0) if windy else 0.0,
        )

    surfaces = tuple(
        replace(
            one,
            material=other(one.material),
            absorbs=replace(one.absorbs, level=dice.between(0.3, 0.85), step=dice.between(0.03, 0.1)),
        )
        for one in YARD
    )
    shown = {"relaxation": True, "solar": not night, "radiation": radiates, "convection": windy and sky != "calm"}
    preset = OutdoorPreset(
        surfaces=surfaces,
        weather=sky,
        part_s=NIGHT_S if night else None,
        effects=frozenset(name for name, there in shown.items() if there),
    )
    return _seen_by(preset, {name for name in ("blur", "pattern", "corners", "drift") if dice.happens(0.15)}, dice)


def _with(preset: Preset, effect: str, **changed) -> Preset:
    """The preset that also shows an effect, and what makes it."""
    return replace(preset, effects=preset.effects | {effect}, **changed)
