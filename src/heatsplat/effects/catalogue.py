"""All effects that heatsplat can simulate, and the decision which of them a scene calls for."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

from heatsplat.contracts import SceneData, SceneError
from heatsplat.effects import physical
from heatsplat.effects.base import STAGES, WISHES, Effect, Verdict
from heatsplat.effects.look import Look

log = logging.getLogger(__name__)


def effects_in(package: ModuleType) -> tuple[Effect, ...]:
    """The effects of a package with one file each, in the order in which heat meets them."""
    names = [module.name for module in iter_modules(package.__path__)]
    effects = [import_module(f"{package.__name__}.{name}").EFFECT for name in names]
    return tuple(sorted(effects, key=lambda effect: (STAGES.index(effect.stage), effect.place)))


CATALOGUE = effects_in(physical)


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
    look = Look(scene, CATALOGUE)
    verdicts = {effect.name: _verdict(effect, look, wishes.get(effect.name, "auto")) for effect in CATALOGUE}
    for verdict in verdicts.values():
        log.debug("%s", verdict)
    return verdicts


def _verdict(effect: Effect, look: Look, wish: str) -> Verdict:
    missing = sorted(effect.needs - look.scene.metadata)
    if missing and wish != "off":
        return Verdict(effect.name, False, None, None, f"the scene lacks {', '.join(missing)}, which it needs")
    if wish == "off":
        return Verdict(effect.name, False, None, None, f"effects.{effect.name}=off")
    evidence = effect.evidence(look)
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
