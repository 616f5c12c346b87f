"""All effects that heatsplat can simulate, and the decision which of them a scene calls for."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

from heatsplat.contracts import SceneData, SceneError, check_option
from heatsplat.effects import physical
from heatsplat.effects.base import CHOICES, STAGES, Effect, Verdict
from heatsplat.effects.inspection import Inspection

log = logging.getLogger(__name__)


def effects_in(package: ModuleType) -> tuple[Effect, ...]:
    """The effects of a package with one file each, in the order in which heat meets them."""
    names = [module.name for module in iter_modules(package.__path__)]
    effects = [import_module(f"{package.__name__}.{name}").EFFECT for name in names]
    return tuple(sorted(effects, key=lambda effect: (STAGES.index(effect.stage), effect.place)))


CATALOGUE = effects_in(physical)


def decide(scene: SceneData, choices: Mapping[str, str] = {}) -> dict[str, Verdict]:  # noqa: B006
    """A verdict on every effect of the catalogue, in its order.

    Args:
        scene: looked at through its training views only; of the others count the sizes.
        choices: "on", "off" or "auto" by name of effect; auto where nothing is said. An effect for which the scene lacks
            metadata is off, whatever is chosen, and its reason names what is missing.

    Raises:
        SceneError: a choice is for an unknown effect, or is none of on, off and auto.
    """
    names = [effect.name for effect in CATALOGUE]
    for name, choice in choices.items():
        if name not in names:
            raise SceneError(f"effects.{name}: there is no such effect; the catalogue has {', '.join(names)}")
        check_option(f"effects.{name}", choice, CHOICES, SceneError)
    inspected = Inspection(scene, CATALOGUE)
    verdicts = {effect.name: _verdict(effect, inspected, choices.get(effect.name, "auto")) for effect in CATALOGUE}
    for verdict in verdicts.values():
        log.debug("%s", verdict)
    return verdicts


def _verdict(effect: Effect, inspected: Inspection, choice: str) -> Verdict:
    missing = sorted(effect.needs - inspected.given.metadata)
    if missing and choice != "off":
        return Verdict(effect.name, False, None, None, f"the scene lacks {', '.join(missing)}, which it needs")
    if choice == "off":
        return Verdict(effect.name, False, None, None, f"effects.{effect.name}=off")
    evidence = effect.evidence(inspected)
    if evidence.statistic is None and inspected.blind and evidence.reason == inspected.obs.why:
        evidence = replace(evidence, told=False)
    if choice == "on":
        return Verdict(effect.name, True, None, None, f"effects.{effect.name}=on", evidence.settings)
    known = evidence.statistic is not None and math.isfinite(evidence.statistic)
    # What was taken in without being certain is still the best explanation of the images that there is.
    on = known and evidence.statistic > effect.threshold and (evidence.told or evidence.gain_db is not None)
    on |= evidence.likely and not evidence.told
    statistic = float(evidence.statistic) if known else None
    return Verdict(
        effect.name,
        on,
        statistic,
        effect.threshold if known else None,
        evidence.reason,
        evidence.settings if on else {},
        evidence.told,
        evidence.gain_db,
    )
