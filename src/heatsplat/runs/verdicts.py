"""Which effects a run simulates, where its configuration leaves that to the scene."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from heatsplat.composition import build
from heatsplat.contracts import SceneData, counted
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.runs.device import device_of
from heatsplat.runs.prices import prices

log = logging.getLogger("heatsplat")


def decided(config: dict[str, Any], scene: SceneData) -> dict[str, Any]:
    """The configuration with "verdicts": on every effect, why, and what each that is on costs (unless effects.price=false);
    and "choosing_seconds", which that took.

    The same configuration where nothing is left to be chosen, or an earlier run has chosen.
    """
    if "verdicts" in config or not assembly.chooses_effects(config):
        return config
    least = assembly.least_db_per_ms(config["effects"])
    began = time.perf_counter()
    verdicts, costs = decide_effects(config["effects"], scene), {}
    if config["effects"]["price"]:

        def maker(chosen: Mapping[str, Verdict]) -> Callable[[], Any]:
            return lambda: build(with_verdicts(config | {"verdicts": assembly.verdicts_as_dicts(chosen, {})})["module"])

        on = [name for name, verdict in verdicts.items() if verdict.on]
        leaving = {name: maker(assembly.without(verdicts, name)) for name in on}
        log.info("measuring the cost of %s", counted(len(on), "effect"))
        costs = prices(
            maker(verdicts),
            leaving,
            scene,
            config["max_steps"],
            device_of(config["trainer"]["accelerator"], config["renderer"]),
        )
        given = assembly.explicit_choices(config["effects"])
        verdicts = assembly.affordable(verdicts, costs, least, given)
    found = assembly.verdicts_as_dicts(verdicts, costs)
    for line in assembly.verdict_table(found):
        log.info("%s", line)
    return config | {"verdicts": found, "choosing_seconds": time.perf_counter() - began}


def decide_effects(effects: Mapping[str, Any], scene: SceneData) -> dict[str, Verdict]:
    """Verdicts on all effects in a scene that can be simulated together, as the group "effects" of a configuration chooses."""
    from heatsplat.effects.catalogue import (
        decide,  # here, because it is many modules and most runs leave nothing to choose
    )

    log.info("looking at scene %s for the effects that it calls for", scene.name)
    seen = decide(scene, assembly.choices(effects))
    return assembly.reconcile(assembly.drop_impossible(seen, scene), assembly.explicit_choices(effects))


def with_verdicts(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration with thermal model, sensor and loss as its verdicts choose them; the same without verdicts."""
    if "verdicts" not in config:
        return config
    names = [field.name for field in fields(Verdict)]
    verdicts = {
        name: Verdict(**{key: said[key] for key in names if key in said}) for name, said in config["verdicts"].items()
    }
    return assembly.filled(config, assembly.assemble(verdicts, config["effects"]), config["verdicts"])
