"""From verdicts to a configuration: the one that simulates exactly the effects that are on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from typing import Any

from heatsplat.contracts import SceneData, SceneError, check_numbers, check_option, rounded
from heatsplat.effects.base import CHOICES, SLOTS, Effect, Verdict
from heatsplat.effects.catalogue import CATALOGUE

NAMES = tuple(effect.name for effect in CATALOGUE)
SELECTIONS = {"auto": "auto", "all": "on", "none": "off"}  # what each chooses for an effect of which nothing is said
PAPERS = "etgs, ravigs, ti3dgs, thermogs, supirgs"  # selections of the group "effects" that are a paper's
SCENE_SAYS = "scene"  # value of a setting that the evidence chooses; without evidence it is the class's own default


def choices(effects: Mapping[str, Any]) -> dict[str, str]:
    """Choice for every effect, "on", "off" or "auto", of the group "effects" of a configuration.

    Raises:
        SceneError: a choice or the selection is unknown.
    """
    check_option("effects.select", effects["select"], SELECTIONS, SceneError)
    return dict.fromkeys(NAMES, SELECTIONS[effects["select"]]) | explicit_choices(effects)


def explicit_choices(effects: Mapping[str, Any]) -> dict[str, str]:
    """Choices that were given for single effects.

    Raises:
        SceneError: one is unknown.
    """
    given = {}
    for name in NAMES:
        choice = effects.get(name)
        if isinstance(choice, bool):  # YAML reads on as true
            choice = "on" if choice else "off"
        if choice is not None:
            check_option(f"effects.{name}", choice, CHOICES, SceneError)
            given[name] = choice
    return given


def chooses_effects(config: Mapping[str, Any]) -> bool:
    """Whether a run's configuration leaves the effects to be chosen.

    Raises:
        SceneError: effects are asked for of a method that has its own.
    """
    effects, method = config["effects"], config["name"]
    chosen, composed = effects["select"] != "method", "state" in config["thermal"] and "parts" in config["thermal"]
    if composed and not chosen:
        raise SceneError(
            f"effects=method leaves method={method} without effects: it has none of its own. Give effects=auto, all, none "
            f"or a paper's selection ({PAPERS})."
        )
    if chosen and not composed:
        raise SceneError(
            f"effects={effects['select']} chooses the parts of method=auto, but method={method} has its own; "
            "give method=auto, or leave effects out."
        )
    idle = {} if chosen else explicit_choices(effects)
    if idle:
        name, choice = next(iter(idle.items()))
        raise SceneError(
            f"effects.{name}={choice} is asked for, but method={method} simulates what its paper does. Give method=auto with "
            f"that paper's selection and your choice, such as method=auto effects=etgs effects.{name}={choice} ({PAPERS}), "
            "or the method's own options (thermal.*, sensor.*)."
        )
    return chosen


def least_db_per_ms(effects: Mapping[str, Any]) -> float:
    """Decibels that an effect must gain for each millisecond that a step takes longer, of the group "effects".

    Raises:
        SceneError: it is no number of 0 or more, or what effects cost is not to be measured.
    """
    least = effects["least_db_per_ms"]
    check_numbers("effects.least_db_per_ms", least, error=SceneError)
    if least < 0:
        raise SceneError(f"effects.least_db_per_ms must be 0 or more, got {least:g}; 0 asks nothing of an effect")
    if least > 0 and not effects["price"]:
        raise SceneError(
            f"effects.least_db_per_ms={least:g} asks what each effect costs, which effects.price=false does not measure; leave "
            "one of them out"
        )
    return least


def drop_impossible(verdicts: Mapping[str, Verdict], scene: SceneData) -> dict[str, Verdict]:
    """The verdicts, with those effects off for which the scene lacks more than metadata."""
    found = dict(verdicts)
    for name in _on(verdicts):
        reason = _effect(name).missing(scene)
        if reason is not None:
            found[name] = replace(found[name], on=False, reason=reason, told=True)
    return found


def reconcile(verdicts: Mapping[str, Verdict], given: Mapping[str, str] | None = None) -> dict[str, Verdict]:
    """Verdicts that can be simulated together, in the order of NAMES; what was changed says so in its reason.

    Of effects that exclude each other the one goes that the others displace, unless it was asked for and they were not.
    Then each effect brings what it stands on, or goes with it where that was refused.

    Args:
        verdicts: one for every name.
        given: choices for single effects (``explicit_choices``), which win over what the scene says.

    Raises:
        SceneError: what was asked for cannot be had in this scene, or not together.
    """
    given = given or {}
    missing = [name for name in NAMES if name not in verdicts]
    if missing:
        raise SceneError(f"there is no verdict on {', '.join(missing)}")
    found = {name: verdicts[name] for name in NAMES}
    for name, choice in given.items():
        if choice == "on" and not found[name].on:
            raise SceneError(f"effects.{name}=on is not possible: {found[name].reason}; add that, or leave it out")
    _part(found, given)
    _put_on_ground(found, given)
    return found


def _turn(found: dict[str, Verdict], given: Mapping[str, str], name: str, on: bool, reason: str) -> None:
    """Changes a verdict, whatever images tell. Raises SceneError where the contrary was asked for."""
    if given.get(name) == ("off" if on else "on"):
        raise SceneError(f"effects.{name}={given[name]} is not possible: {reason}; leave it out or change the other")
    found[name] = replace(found[name], on=on, reason=reason, told=True)


def _part(found: dict[str, Verdict], given: Mapping[str, str]) -> None:
    """Leaves on, of effects that exclude each other, those that displace the others or were asked for."""
    for name in _on(found):
        others = [other for other in _on(found) if name in _effect(other).displaces]
        if others and given.get(name) == "on" and not any(given.get(other) == "on" for other in others):
            for other in others:
                _turn(found, given, other, False, f"{name} was asked for, and the two exclude each other")
        elif others:
            _turn(found, given, name, False, _effect(others[0]).displaces[name])


def _put_on_ground(found: dict[str, Verdict], given: Mapping[str, str]) -> None:
    """Turns on what effects stand on, or those off for which that was refused."""
    barred, wanted = ({name for name, choice in given.items() if choice == said} for said in ("off", "on"))
    waiting = _on(found)
    while waiting:
        name = waiting.pop(0)
        ground = _effect(name).stands_on
        if ground is None or found[ground].on:
            continue
        if ground in barred and name not in wanted:
            _turn(found, given, name, False, f"it stands on {ground}, which is off")
            barred.add(name)
        else:
            _turn(found, given, ground, True, f"{name} stands on it")
            wanted |= {ground} if name in wanted else set()
            waiting.append(ground)


def dependents(name: str) -> frozenset[str]:
    """The effect, those that stand on it, and those that stand on these."""
    found = {name}
    while more := {effect.name for effect in CATALOGUE if effect.stands_on in found} - found:
        found |= more
    return frozenset(found)


def without(verdicts: Mapping[str, Verdict], name: str) -> dict[str, Verdict]:
    """The verdicts with one effect off, and with it those that stand on it."""
    gone = dependents(name)
    return {other: replace(verdict, on=verdict.on and other not in gone) for other, verdict in verdicts.items()}


def affordable(
    verdicts: Mapping[str, Verdict],
    prices: Mapping[str, Any],
    least: float,
    given: Mapping[str, str] | None = None,
) -> dict[str, Verdict]:
    """The verdicts without the effects that gain less on held-out observations than so many decibels per millisecond that a
    step of training takes longer (``least_db_per_ms``), and without those that stand on them; 0 keeps all, and what was asked
    for (``given``, of ``explicit_choices``) stays with what it stands on."""
    found = dict(verdicts)
    if least == 0:  # where images cannot tell, what was left out may gain less than nothing
        return found
    asked = {name for name, choice in (given or {}).items() if choice == "on"}
    for name in _on(verdicts):
        gain, price = verdicts[name].gain_db, prices.get(name)
        if gain is None or price is None or gain >= least * price.ms_per_step or not found[name].on:
            continue
        gone = [other for other in dependents(name) if found[other].on]
        if asked.intersection(gone):
            continue
        why = f"{gain:.1f} dB for {price.ms_per_step:.2f} ms a step are less than effects.least_db_per_ms={least:g}"
        found = without(found, name)
        for other in gone:
            found[other] = replace(found[other], reason=f"it stands on {name}, which is off", told=True)
        found[name] = replace(found[name], reason=why, told=True)
    return found


def assemble(verdicts: Mapping[str, Verdict], templates: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """ "thermal", "sensor" and further terms of the "loss" as plain containers, of the effects that are on; and "grid", on which
    images are compared, where they are rendered finer than they were recorded.

    Args:
        verdicts: reconciled.
        templates: every part with its settings, the group "effects" of a configuration (conf/effects/shared/parts.yaml);
            what a verdict says a part should start from stands where they say "scene".

    Raises:
        SceneError: a verdict says something of a part that is none of its settings.
    """
    templates = deepcopy(dict(templates))
    parts = {slot: _parts(slot, verdicts, templates) for slot in SLOTS}
    state = [templates["states"]["static"], *parts["state"].values()][-1]
    if parts["path"]:  # parts follow that clip
        state |= {"floor": False} if "floor" in state else {"clip": "none"}
    for around in parts["around_state"].values():
        state = around | {"state": state}
    companion = parts["companion"].get("companion")
    thermal = {
        "_target_": "heatsplat.thermal.composed.Composed",
        "state": state,
        "parts": parts["path"],
        "companion": companion,
        "clip": templates["clip"],
    }
    sensor = {"_target_": templates["sensor"]["_target_"], "parts": parts["camera"]}
    loss = templates["companion_loss"] if companion else {}
    return {"thermal": thermal, "sensor": sensor, "loss": loss, **({"grid": grid} if (grid := parts["grid"]) else {})}


def _effect(name: str) -> Effect:
    return next(effect for effect in CATALOGUE if effect.name == name)


def _on(verdicts: Mapping[str, Verdict]) -> list[str]:
    return [name for name in NAMES if verdicts[name].on]


def _parts(slot: str, verdicts: Mapping[str, Verdict], templates: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Settings of the parts of a slot that simulate effects that are on, by name, in the order of the catalogue."""
    choices = templates
    for key in SLOTS[slot]:
        templates = templates[key]
    users = [effect for effect in CATALOGUE if effect.part.slot == slot]
    chosen = {effect.name: _part_of(effect, verdicts[effect.name], choices) for effect in users}
    parts = {}
    for name in dict.fromkeys(chosen[effect.name] for effect in users if verdicts[effect.name].on):
        mine = [effect for effect in users if verdicts[effect.name].on and chosen[effect.name] == name]
        parts[name] = _set(templates[name], mine, verdicts)
        for effect in users:  # those that are off, or that another part simulates
            if effect.part.name == name and effect not in mine:
                parts[name] |= effect.part.off
    return parts


def _part_of(effect: Effect, verdict: Verdict, choices: Mapping[str, Any]) -> str:
    """Name of the part that simulates an effect."""
    if not effect.part.kinds:
        return effect.part.name
    kind = choices.get(effect.part.choice, SCENE_SAYS)
    check_option(f"effects.{effect.part.choice}", kind, (SCENE_SAYS, *effect.part.kinds), SceneError)
    if kind == SCENE_SAYS:
        kind = verdict.settings.get(effect.part.choice)
    return effect.part.kinds.get(kind, effect.part.name)


def _set(template: Mapping[str, Any], effects: Sequence[Effect], verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    """A part's settings, with what verdicts say of it where they leave that to the scene."""
    settings = dict(template)
    for effect in effects:
        for key, value in verdicts[effect.name].settings.items():
            if key not in settings and effect.part.kinds:  # of another kind
                continue
            if key not in settings:
                raise SceneError(
                    f"the evidence on {effect.name} sets '{key}', which {settings['_target_']} does not have"
                )
            if settings[key] == SCENE_SAYS:
                settings[key] = value
    return {key: value for key, value in settings.items() if value != SCENE_SAYS}


def filled(config: Mapping[str, Any], parts: Mapping[str, Any], verdicts: Mapping[str, Any]) -> dict[str, Any]:
    """A run's configuration with these parts in it and the verdicts that led to them.

    Args:
        config: as composed.
        parts: of ``assemble``.
        verdicts: as ``verdicts_as_dicts`` puts them.
    """
    thermal, sensor = deepcopy(parts["thermal"]), deepcopy(parts["sensor"])
    terms, finer = {**config["loss"]["terms"], **deepcopy(parts["loss"])}, {}
    for grid in parts.get("grid", {}).values():
        around = dict(grid)
        finer["supersample"] = around.pop("factor")
        terms = {name: term and around | {"term": term} for name, term in terms.items()}
    loss = {**deepcopy(config["loss"]), "terms": terms}
    effects = {"select": config["effects"]["select"]} | {name: verdicts[name]["on"] for name in NAMES}
    changed = {"thermal": thermal, "sensor": sensor, "loss": loss}
    return {
        **config,
        **changed,
        "module": {**config["module"], **changed, **finer},
        "effects": effects,
        "verdicts": dict(verdicts),
    }


def verdicts_as_dicts(verdicts: Mapping[str, Verdict], prices: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Verdicts as plain containers, with what the effects add where that was measured (``runs.prices``)."""
    return {name: asdict(verdict) | _plain_price(prices.get(name)) for name, verdict in verdicts.items()}


def verdict_table(verdicts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table for the log of what ``verdicts_as_dicts`` says: effect, verdict, statistic and threshold, gain, price, reason."""
    rows = [("effect", "", "statistic", "dB", "ms/step", "numbers", "reason")]
    for name, verdict in verdicts.items():
        measured = verdict["statistic"] is not None
        sign = ">" if measured and verdict["statistic"] > verdict["threshold"] else "≤"
        statistic = f"{rounded(verdict['statistic'], 3)} {sign} {verdict['threshold']:.3g}" if measured else "–"
        priced = "ms_per_step" in verdict
        numbers = f"{verdict['per_gaussian']:+d} N {verdict['shared']:+d}" if priced else ""
        milliseconds = f"{verdict['ms_per_step']:+.2f}" if priced else ""
        on = ("on" if verdict["told"] else "on?") if verdict["on"] else "off" if verdict["told"] else "?"
        gain = "" if verdict["gain_db"] is None else f"{verdict['gain_db']:+.1f}"
        rows.append((name, on, statistic, gain, milliseconds, numbers, verdict["reason"]))
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    return [
        "  ".join([*(cell.ljust(width) for cell, width in zip(row[:6], widths, strict=True)), row[6]]) for row in rows
    ]


def _plain_price(price: Any) -> dict[str, Any]:
    return {} if price is None else asdict(price)
