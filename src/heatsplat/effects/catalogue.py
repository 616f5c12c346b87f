"""All effects that heatsplat can simulate, and the decision which of them a scene calls for."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

from heatsplat.contracts import SceneData, SceneError
from heatsplat.effects.base import WISHES, Effect, Verdict
from heatsplat.effects.evidence import blur, conduction, joint_fit, see_through, weather
from heatsplat.effects.observations import Observations, observe

log = logging.getLogger(__name__)

_TIME, _WEATHER = frozenset({"time"}), frozenset({"time", "thermal_range", "weather"})

CATALOGUE: tuple[Effect, ...] = (
    Effect(
        name="relaxation",
        stage="state",
        summary="every surface tends to the temperature of its surroundings",
        source="ETGS, Eq. 3",
        needs=_TIME,
        null="every point keeps its level through the record",
        threshold=joint_fit.OWN_HURDLE,
        adds="a level and a rate for each Gaussian, an exponential at each time",
        evidence=joint_fit.relaxation,
    ),
    Effect(
        name="harmonic_source",
        stage="state",
        summary="heat that is switched on and off, as a sum of K harmonics",
        source="ETGS, Eq. 4, 7, 8",
        needs=_TIME,
        null="what changes is a mixture of relaxations",
        threshold=joint_fit.OWN_HURDLE,
        adds="2 K amplitudes for each Gaussian, 11 K operations",
        evidence=joint_fit.harmonic_source,
    ),
    Effect(
        name="solar",
        stage="state",
        summary="sunlight that a surface absorbs",
        source="ThermoGS, Eq. 4",
        needs=_WEATHER,
        null="temperatures follow the air, not the irradiance",
        threshold=weather.HURDLE,
        adds="an absorptivity for each Gaussian, one driver",
        evidence=weather.solar,
    ),
    Effect(
        name="radiation",
        stage="state",
        summary="long waves to and from the sky, beyond their linear part",
        source="ThermoGS, Eq. 5",
        needs=_WEATHER,
        null="over the span of temperatures T⁴ is a straight line to within the noise",
        threshold=weather.BENT,
        adds="an emissivity for each Gaussian, one driver",
        evidence=weather.radiation,
    ),
    Effect(
        name="convection",
        stage="state",
        summary="air that carries heat away, faster in wind",
        source="ThermoGS, Eq. 6, 7",
        needs=_WEATHER,
        null="what the recorded wind changes of surfaces' excess over the air is below the noise",
        threshold=1.0,
        adds="exchange with the air that depends on wind, one driver",
        evidence=weather.convection,
    ),
    Effect(
        name="conduction",
        stage="state",
        summary="heat that flows between neighbouring parts of a surface",
        source="Fourier's law on the graph of nearest Gaussians",
        needs=_TIME,
        null="contrasts between neighbours fade as fast as levels do",
        threshold=conduction.HURDLE,
        adds="a diffusivity and a linear solve over neighbours",
        evidence=conduction.conduction,
    ),
    Effect(
        name="view_dependence",
        stage="emission",
        summary="emission that depends on the direction of view",
        source="3DGS, spherical harmonics",
        needs=frozenset(),
        null="a point looks the same from every side",
        threshold=joint_fit.OWN_HURDLE,
        adds="harmonics for each Gaussian",
        evidence=joint_fit.view_dependence,
    ),
    Effect(
        name="reflection",
        stage="emission",
        summary="surroundings seen as in a mirror",
        source="RaViGS, Eq. 4",
        needs=frozenset(),
        null="what depends on direction does not follow the mirrored ray",
        threshold=joint_fit.SHARED_HURDLE,
        adds="a reflectivity for each Gaussian, one map of the surroundings",
        evidence=joint_fit.reflection,
    ),
    Effect(
        name="attenuation",
        stage="path",
        summary="air that swallows heat over distance and sends its own",
        source="TI-3DGS, Eq. 6; Beer and Lambert",
        needs=frozenset(),
        null="a point looks the same from near and far",
        threshold=joint_fit.SHARED_HURDLE,
        adds="one extinction, or a curve of it over time",
        evidence=joint_fit.attenuation,
    ),
    Effect(
        name="thermal_opacity",
        stage="visibility",
        summary="matter that one modality passes and the other does not",
        source="RaViGS, Eq. 6",
        needs=frozenset(),
        null="of two points behind one pixel both modalities show the nearer one",
        threshold=see_through.HURDLE,
        adds="a second opacity for each Gaussian, the visible image beside the thermal one",
        evidence=see_through.thermal_opacity,
    ),
    Effect(
        name="frame_offset",
        stage="sensor",
        summary="a level of the sensor that drifts from image to image",
        source="drift of uncooled cameras between shutters",
        needs=frozenset(),
        null="the images have no offset in common with all their points",
        threshold=joint_fit.SHARED_HURDLE,
        adds="one number for each training image",
        evidence=joint_fit.frame_offset,
    ),
    Effect(
        name="agc",
        stage="sensor",
        summary="contrast that the camera stretches from image to image",
        source="SupIR-GS, Eq. 5",
        needs=frozenset(),
        null="the images have one gain",
        threshold=joint_fit.SHARED_HURDLE,
        adds="a stretch and a shift for each training image, a logit and a sigmoid",
        evidence=joint_fit.agc,
    ),
    Effect(
        name="fixed_pattern",
        stage="sensor",
        summary="uneven gain and offset of the pixels",
        source="SupIR-GS, Eq. 4",
        needs=frozenset(),
        null="residuals average to nothing at every place of the image",
        threshold=joint_fit.OWN_HURDLE,
        adds="two coarse grids over the image",
        evidence=joint_fit.fixed_pattern,
    ),
    Effect(
        name="vignetting",
        stage="sensor",
        summary="falloff of the lens towards the corners",
        source="SupIR-GS, Eq. 6",
        needs=frozenset(),
        null="residuals do not depend on the distance from the middle of the image",
        threshold=joint_fit.SHARED_HURDLE,
        adds="two numbers",
        evidence=joint_fit.vignetting,
    ),
    Effect(
        name="tone",
        stage="sensor",
        summary="a bent curve from heat to grey",
        source="SupIR-GS, Eq. 7, 8",
        needs=frozenset(),
        null="what a common change of an image does to its greys is a straight line of them",
        threshold=joint_fit.SHARED_HURDLE,
        adds="a small network of one number, kept as 256 levels",
        evidence=joint_fit.tone,
    ),
    Effect(
        name="point_spread",
        stage="sensor",
        summary="blur of lens and detector",
        source="SupIR-GS, degradation model",
        needs=frozenset(),
        null="edges are as wide as a pixel",
        threshold=1.0,
        adds="a Gaussian blur of the rendered image",
        evidence=blur.point_spread,
    ),
)


def decide(scene: SceneData, wishes: Mapping[str, str] = {}) -> dict[str, Verdict]:  # noqa: B006
    """A verdict on every effect of the catalogue, in its order.

    Args:
        scene: looked at through its training views only.
        wishes: "on", "off" or "auto" by name of effect; auto where nothing is said. An effect for which the scene lacks
            metadata is off, whatever is wished, and its reason names what is missing.

    Raises:
        SceneError: a wish is for an unknown effect, or is none of on, off and auto.
    """
    names = [effect.name for effect in CATALOGUE]
    for name, wish in wishes.items():
        if name not in names:
            raise SceneError(f"effects.{name}: there is no such effect; the catalogue has {', '.join(names)}")
        if wish not in WISHES:
            raise SceneError(f"effects.{name} must be one of {', '.join(WISHES)}, got '{wish}'")
    seen: list[Observations] = []  # made when the first effect asks for evidence
    verdicts = {}
    for effect in CATALOGUE:
        verdicts[effect.name] = _verdict(effect, scene, wishes.get(effect.name, "auto"), seen)
        log.debug("%s", verdicts[effect.name])
    return verdicts


def _verdict(effect: Effect, scene: SceneData, wish: str, seen: list[Observations]) -> Verdict:
    missing = sorted(effect.needs - scene.metadata)
    if missing and wish != "off":
        return Verdict(effect.name, False, None, None, f"the scene lacks {', '.join(missing)}, which it needs")
    if wish == "off":
        return Verdict(effect.name, False, None, None, f"effects.{effect.name}=off")
    if not seen:
        seen.append(observe(scene))
    evidence = effect.evidence(seen[0])
    if wish == "on":
        return Verdict(effect.name, True, None, None, f"effects.{effect.name}=on", evidence.settings)
    known = evidence.statistic is not None and math.isfinite(evidence.statistic)
    on = known and evidence.statistic > effect.threshold
    statistic = float(evidence.statistic) if known else None
    return Verdict(
        effect.name,
        on,
        statistic,
        effect.threshold if known else None,
        evidence.reason,
        evidence.settings if on else {},
    )
