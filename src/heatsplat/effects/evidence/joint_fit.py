"""Evidence that comes out of the joint fit: what changes over time, with direction, along the path and in the sensor."""

from __future__ import annotations

from dataclasses import replace

import torch

from heatsplat.effects.base import Evidence
from heatsplat.effects.evidence import harmonics, record, surface
from heatsplat.effects.evidence.joint import OWN_HURDLE, SHARED_HURDLE, Joint, Model
from heatsplat.effects.observations import Observations

__all__ = ["OWN_HURDLE", "SHARED_HURDLE"]

WELL_OUTDONE = 1.0  # share of others' size below which an effect makes up for what they lack
LEAST_FALLOFF = -0.04  # in the corners; blur at the border of an image passes for half of that


def joint(obs: Observations) -> tuple[Joint, Model] | None:
    """The joint fit of a scene and what it selects; made once. None where there are no tracks."""
    if obs.tracks is None:
        return None
    if "joint" not in obs.found:
        fit = Joint(obs.tracks, obs.times_s, obs.ambient, obs.noise, surface.normals(obs), record.drivers(obs))
        obs.found["joint"] = (fit, fit.selected()) if fit.observations > 0 else None
    return obs.found["joint"]


def relaxation(obs: Observations) -> Evidence:
    """Whether points tend to another temperature as time goes by."""
    return _evidence(obs, "relaxation", "points change over time by")


def harmonic_source(obs: Observations) -> Evidence:
    """Whether something drives the scene, and how many harmonics say how."""
    beside = "any relaxation" if obs.scene.weather is None else "what the weather does"
    evidence = _evidence(obs, "harmonic_source", f"points depart from {beside} by")
    found = joint(obs)
    if found is None or "harmonic_source" not in found[1].own:
        return evidence
    return replace(evidence, settings={"frequencies": harmonics.needed(found[0], found[1], obs)})


def view_dependence(obs: Observations) -> Evidence:
    """Whether points look different from different sides.

    Beside mirrors it only makes up for their normals, which are known roughly.
    """
    if _outdone(obs, "view_dependence", {"reflection"}):
        return Evidence(0.0, "what depends on direction is mirrors, as far as their normals are known")
    return _evidence(obs, "view_dependence", "points change with the direction of view by")


def reflection(obs: Observations) -> Evidence:
    """Whether one map of the surroundings, mirrored in the surfaces, explains a part of the images."""
    return _evidence(obs, "reflection", "mirrored surroundings add")


def attenuation(obs: Observations) -> Evidence:
    """Whether points lose contrast to the surroundings with distance."""
    if obs.ambient is None:
        return Evidence(None, "without the temperature of the surroundings nobody knows what haze fades to")
    evidence = _evidence(obs, "attenuation", "the path changes values by")
    found = joint(obs)
    if found is None or not found[1].attenuation:
        return evidence
    fit, model = found
    passing, count = fit.transmission(model)
    depth = max(-float(torch.log(passing[fit.weights > 0]).median()), 0.02)
    settings = {"depth": round(depth, 3)}
    return replace(evidence, settings=settings | {"moments": 0 if count == 1 else max(2, min(count // 2, 16))})


def frame_offset(obs: Observations) -> Evidence:
    """Whether each image has an offset that all its points share. Where gains change, their shift takes it."""
    found = joint(obs)
    if (
        found is not None
        and {"agc", "frame_offset"} <= found[1].shared
        and not _outdone(obs, "agc", {"frame_offset", "tone"})
    ):
        return Evidence(0.0, "gains change from image to image, and their shift takes what offsets there are")
    return _evidence(obs, "frame_offset", "images differ from each other by an offset of")


def agc(obs: Observations) -> Evidence:
    """Whether each image has a gain of its own; beside a bent curve it only makes up for how that one is bent."""
    if _outdone(obs, "agc", {"frame_offset", "tone"}):
        return Evidence(0.0, "what looks like gains of single images is a bent curve along which they shift")
    return _evidence(obs, "agc", "gains of single images change values by")


def tone(obs: Observations) -> Evidence:
    """Whether what moves a whole image moves its dark and bright parts by amounts that a bent curve explains.

    A curve that never changes over a scene that never changes only renames its levels: nothing shows it, and nothing is
    lost without it. It shows where an offset moves all levels along it.
    """
    return _evidence(obs, "tone", "offsets act on dark and bright parts differently by")


def fixed_pattern(obs: Observations) -> Evidence:
    """Whether places in the image have an offset or gain of their own that is not radial."""
    return _pattern(obs, "fixed_pattern", "places in the image differ by")


def vignetting(obs: Observations) -> Evidence:
    """Whether the image fades towards its corners."""
    return _pattern(obs, "vignetting", "distance from the middle of the image changes values by")


def _outdone(obs: Observations, name: str, others: set[str]) -> bool:
    """Whether an effect was only taken in beside others that explain the same kind of change, and more of it."""
    found = joint(obs)
    if found is None or not {name, *others} <= found[1].names():
        return False
    fit, model = found
    beside = model.without(name)
    return all(_size(fit, model, name) < WELL_OUTDONE * _size(fit, beside, other) for other in others)


def _size(fit: Joint, model: Model, name: str) -> float:
    return fit.effect_size(model, model.without(name))


def _pattern(obs: Observations, name: str, sentence: str) -> Evidence:
    """A pattern can be radial as well: the radial part is left to vignetting where it is a good part of the whole."""
    found = joint(obs)
    if found is None:
        return Evidence(None, obs.why)
    fit, model = found
    if not fit.sees_pattern:
        return Evidence(None, "a camera that stands still cannot tell its pattern from the scene")
    both = {"fixed_pattern", "vignetting"}
    none = replace(model, shared=model.shared - both)
    radial = replace(none, shared=none.shared | {"vignetting"})
    uneven = replace(none, shared=none.shared | {"fixed_pattern"})
    whole = replace(none, shared=none.shared | both)
    falloff, radially = fit.falloff(model)
    fades = falloff < LEAST_FALLOFF and radially > SHARED_HURDLE
    if name == "vignetting":
        size = fit.effect_size(radial, none)
        why = f"{sentence} {_beside(size)} ({100 * falloff:+.0f} % in the corners)"
        if falloff >= LEAST_FALLOFF:
            return Evidence(0.0, f"{why}, which is no falloff")
        return Evidence(radially if fit.worthwhile(radial, none, name) else 0.0, why)
    more, less = (whole, radial) if fades else (uneven, none)
    size = fit.effect_size(more, less)
    return Evidence(
        fit.gain(more, less) if fit.worthwhile(more, less, name) else 0.0,
        f"{sentence} {_beside(size)}" + (" beside the falloff" if fades else ""),
    )


def _evidence(obs: Observations, name: str, sentence: str) -> Evidence:
    """What an effect gains in the presence of those that were selected."""
    found = joint(obs)
    if found is None:
        return Evidence(None, obs.why or "no point can be followed through the images")
    fit, model = found
    if name in model.names():
        less = model.without(name)
        gain, size = fit.gain(model, less), fit.effect_size(model, less)
        return Evidence(gain, f"{sentence} {_beside(size)}; {gain:.1f} times what its parameters cost")
    tried = [one for other, one in fit.candidates(model) if other == name]
    if not tried:
        return Evidence(None, f"the training views do not allow to look for it: {fit.why_not(name)}")
    best = max(tried, key=lambda one: fit.gain(one, model))
    gain, size = fit.gain(best, model), fit.effect_size(best, model)
    if gain > 1.0 and not fit.worthwhile(best, model, name):
        return Evidence(0.0, f"{sentence} {_beside(size)}, too little beside the noise or the changes of the scene")
    if fit.earns(best, model, name):
        return Evidence(0.0, f"{sentence} {_beside(size)}, which the effects that are on explain as well")
    return Evidence(gain, f"{sentence} {_beside(size)}; {gain:.1f} times what its parameters cost")


def _beside(size: float) -> str:
    return f"{size:.2g} times the error expected of an observation"
