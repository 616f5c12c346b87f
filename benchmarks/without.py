"""A scene without one of the effects that it shows: what an image owes to that effect is the difference between the two."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic_scene.flaws import CameraFlaws
from heatsplat.datamodules.synthetic_scene.outdoor import OutdoorPreset, OutdoorScene, OutdoorSurface
from heatsplat.datamodules.synthetic_scene.outdoor_sky import outdoor_weather
from heatsplat.datamodules.synthetic_scene.presets import Preset
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.physics.units import STEFAN_BOLTZMANN, kelvin

NO_SUN = 1e-3  # share of its absorptivity that a surface keeps in the dark, as faces are solved for shades that differ


def without(preset: Preset, effect: str) -> Scene:
    """The scene of a preset whose truth lacks an effect, and what stands on that; else it is the same.

    Nothing changes without relaxation: all surfaces stay as they are in the middle of the record. Without radiation they lose
    as much heat per kelvin, but to the air and not to the sky; without convection the wind is always that of the mean.

    Args:
        preset: that shows the effect.
        effect: its name.

    Raises:
        SceneError: the preset does not show it, or nobody knows what it would be without.
    """
    if effect not in preset.effects:
        raise SceneError(f"the scene shows {', '.join(sorted(preset.effects)) or 'no effect'}, not {effect}")
    if effect == "relaxation":
        return _at_rest(scene_of(preset))
    known = {**_OUTSIDE, **_SURFACES, **_CAMERA}
    if effect not in known:
        raise SceneError(f"nobody knows the scene without {effect}; known are relaxation, {', '.join(known)}")
    if effect in _CAMERA:
        return scene_of(replace(preset, flaws=_CAMERA[effect](preset, preset.flaws)))
    return scene_of(known[effect](preset))


def scene_of(preset: Preset) -> Scene:
    """The solved scene of a preset, in a room or under the sky."""
    return OutdoorScene(preset) if isinstance(preset, OutdoorPreset) else Scene(preset)


def _at_rest(scene: Scene) -> Scene:
    """The scene as it is at one moment, always."""
    filmed_s = getattr(scene.preset, "part_s", None) or (0.0, scene.preset.duration_s)
    moving, middle = scene.celsius, 0.5 * sum(filmed_s)

    def celsius(heat: object, times_s: Tensor) -> Tensor:
        return moving(heat, torch.full_like(times_s, middle))

    scene.celsius = celsius
    return scene


def _no_pane(preset: Preset) -> Preset:
    panes = {one.name for one in preset.surfaces if one.transmits}
    surfaces = tuple(one for one in preset.surfaces if one.name not in panes)
    return replace(preset, surfaces=surfaces, start_k={k: v for k, v in preset.start_k.items() if k not in panes})


def _each(preset: OutdoorPreset, changed: Callable[[OutdoorSurface], OutdoorSurface]) -> OutdoorPreset:
    return replace(preset, surfaces=tuple(changed(one) for one in preset.surfaces))


def _in_the_dark(one: OutdoorSurface) -> OutdoorSurface:
    light = one.absorbs
    return replace(
        one, absorbs=replace(light, level=NO_SUN * light.level, swing=NO_SUN * light.swing, step=NO_SUN * light.step)
    )


def _no_sky(preset: OutdoorPreset) -> OutdoorPreset:
    mean_k = float(kelvin(outdoor_weather(preset.weather).air_c).mean())

    def changed(one: OutdoorSurface) -> OutdoorSurface:
        own = one.material
        lost = own.convection_still + 4.0 * own.emissivity * STEFAN_BOLTZMANN * mean_k**3
        return replace(one, material=replace(own, emissivity=0.0, convection_still=lost))

    return _each(preset, changed)


def _even_wind(preset: OutdoorPreset) -> OutdoorPreset:
    mean = float(outdoor_weather(preset.weather).wind_m_s.mean())

    def changed(one: OutdoorSurface) -> OutdoorSurface:
        own = one.material
        still = own.convection_still + mean * own.convection_per_wind
        return replace(one, material=replace(own, convection_per_wind=0.0, convection_still=still))

    return _each(preset, changed)


def _even_gain(preset: Preset, flaws: CameraFlaws) -> CameraFlaws:
    """The shift of single images takes what offsets there are, where these do not count as an effect of their own."""
    drift = flaws.drift if preset.effects & {"frame_offset", "tone"} else 0.0
    return replace(flaws, step=0.0, gain_drift=0.0, stretch=0.0, shift=0.0, drift=drift)


_OUTSIDE: Mapping[str, Callable[[OutdoorPreset], OutdoorPreset]] = {
    "solar": lambda preset: _each(preset, _in_the_dark),
    "radiation": _no_sky,
    "convection": _even_wind,
}
_SURFACES: Mapping[str, Callable[[Preset], Preset]] = {
    "harmonic_source": lambda preset: replace(preset, lamp=None),
    "conduction": lambda preset: replace(preset, diffusivity=0.0),
    "directional_emissivity": lambda preset: replace(preset, gloss=replace(preset.gloss, fade=0.0)),
    "reflection": lambda preset: replace(preset, gloss=replace(preset.gloss, mirrors=0.0)),
    "attenuation": lambda preset: replace(preset, haze=None),
    "thermal_opacity": _no_pane,
}
_CAMERA: Mapping[str, Callable[[Preset, CameraFlaws], CameraFlaws]] = {
    "point_spread": lambda preset, flaws: replace(flaws, blur_px=0.0),
    "fixed_pattern": lambda preset, flaws: replace(flaws, gain=0.0, bias=0.0, columns=0.0),
    "vignetting": lambda preset, flaws: replace(flaws, falloff=(0.0, 0.0)),
    "frame_offset": lambda preset, flaws: replace(flaws, drift=0.0),
    "agc": _even_gain,
    "tone": lambda preset, flaws: replace(flaws, bend=0.0),
}
