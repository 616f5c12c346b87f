"""Settings held against what the classes and functions that they are for declare, before any of these is built."""

from __future__ import annotations

import difflib
import inspect
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from numbers import Real
from typing import Any, get_args

from heatsplat.composition import choices_of, overlap, setters_of
from heatsplat.contracts import SceneError, as_written
from heatsplat.effects import assembly
from heatsplat.io.command_lines import key_of
from heatsplat.io.settings import walk

# Kinds of settings by the names that classes declare them with, in words. A class of ours, and what is called, is a part.
KINDS = {"float": "a number", "int": "a whole number", "bool": "true or false", "list": "a list"}
KINDS |= {"group": "settings by name", "part": "settings with a _target_", "None": "null"}
HOLDERS = {
    "list": "list",
    "Sequence": "list",
    "Collection": "list",
    "tuple": "list",
    "Mapping": "group",
    "dict": "group",
}
PART, OR_NULL = frozenset({"part"}), frozenset({"None"})


@dataclass(frozen=True)
class Declared:
    """What a class or function declares of its settings.

    Args:
        kinds: name -> what it may be, of those of ``KINDS`` alone.
        within: name -> what each entry of a list or of settings by name may be, likewise.
        names: of all settings; None where it takes any, or it cannot be had.
    """

    kinds: Mapping[str, frozenset[str]] = field(default_factory=dict)
    within: Mapping[str, frozenset[str]] = field(default_factory=dict)
    names: frozenset[str] | None = None


def check_declared(config: Mapping[str, Any]) -> None:
    """Raises SceneError for a setting that is of another kind than is asked for, or that nothing asks for, with who set it."""
    groups = {name: settings for name, settings in config.items() if isinstance(settings, Mapping)}
    if "module" in groups:  # which holds the others once more
        groups["module"] = {name: one for name, one in groups["module"].items() if not isinstance(one, Mapping)}
    callbacks = ((f"callbacks.{name}", one, PART | OR_NULL) for name, one in groups.get("callbacks", {}).items())
    for key, value, kinds in (*callbacks, *_given(groups)):
        left = value == assembly.SCENE_SAYS and key.startswith("effects.")
        if not left and not _is_of(kinds, value):
            raise SceneError(_other_kind(key, value, kinds, config))
    groups.pop("effects", None)  # its templates also hold what puts them together
    parts = ((key, value) for key, value in walk(groups) if isinstance(value, Mapping) and "_target_" in value)
    for path, settings in parts:
        names = declared(str(settings["_target_"])).names
        for name in settings:
            if names is not None and name not in names and not str(name).startswith("_"):
                raise SceneError(_unknown(f"{path}.{name}", str(settings["_target_"]), names, config))


@cache
def declared(target: str) -> Declared:
    """What a class, with its bases, or a function declares, by its dotted name; kinds of those of heatsplat alone."""
    module, _, name = target.rpartition(".")
    try:
        found = getattr(import_module(module), name)
        arguments = inspect.signature(found).parameters
    except (ImportError, AttributeError, ValueError, TypeError):
        return Declared()  # building it says what is wrong
    takes_any = any(one.kind in (one.VAR_KEYWORD, one.VAR_POSITIONAL) for one in arguments.values())
    names = None if takes_any else frozenset(arguments)
    if not module.startswith("heatsplat."):
        return Declared(names=names)  # others may not mean what they declare
    makers = [vars(base).get("__init__") for base in reversed(found.__mro__)] if isinstance(found, type) else [found]
    hints = {
        name: _kinds(_spelled(hint), getattr(maker, "__globals__", {}))
        for maker in makers
        for name, hint in getattr(maker, "__annotations__", {}).items()
        if name != "return"
    }
    kinds = {name: one for name, (one, _) in hints.items() if one <= KINDS.keys()}
    within = {name: one for name, (_, one) in hints.items() if name in kinds and one and one <= KINDS.keys()}
    return Declared(kinds, within, names)


def _spelled(hint: Any) -> str:
    """A type hint as it stands in the source, where annotations may be evaluated or not: of dotted names the last part."""
    written = hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
    return re.sub(r"\b(?:\w+\.)+(?=\w)", "", written)


def _kinds(hint: str, scope: Mapping[str, Any]) -> tuple[frozenset[str], frozenset[str]]:
    """Kinds of a setting by its type hint, and of what it holds; what is none of ``KINDS`` stands for itself."""
    kinds, within = set(), set()
    for one in re.split(r" \| (?![^\[]*\])", hint):  # outside of brackets
        name, _, inner = one.removesuffix("]").partition("[")
        if name in HOLDERS and inner:
            kinds.add(HOLDERS[name])
            held = inner.removeprefix("str, ") if HOLDERS[name] == "group" else inner.partition(", ")[0]
            within |= _kinds(held, scope)[0]
            continue
        known = scope.get(name)
        ours = isinstance(known, type) and known.__module__.startswith("heatsplat.")
        kinds.add("part" if ours or name == "Callable" else one)
    return frozenset(kinds), frozenset(within)


def _is_of(kinds: frozenset[str], value: Any) -> bool:
    if value is None:
        return "None" in kinds
    if isinstance(value, Mapping):
        return "group" in kinds or ("part" in kinds and "_target_" in value)
    if isinstance(value, list | tuple):
        return "list" in kinds
    if isinstance(value, bool):
        return "bool" in kinds
    if not isinstance(value, Real) or math.isnan(value):
        return False
    whole = math.isinf(value) or value == int(value)  # 1e5 is one, and so is no limit
    return "float" in kinds or ("int" in kinds and whole) or ("bool" in kinds and value in (0, 1))


def _given(settings: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any, frozenset[str]]]:
    """Settings of declared kinds, and what they hold: dotted key, value and kinds."""
    known = declared(str(settings.get("_target_")))
    for name, value in settings.items():
        key = f"{path}.{name}".removeprefix(".")
        if name in known.kinds:
            yield key, value, known.kinds[name]
        if name in known.within and isinstance(value, Mapping):
            yield from (
                (f"{key}.{inner}", one, known.within[name]) for inner, one in value.items() if inner != "_target_"
            )
        elif name in known.within and isinstance(value, list | tuple):
            yield from ((f"{key}[{place}]", one, known.within[name]) for place, one in enumerate(value))
        if isinstance(value, Mapping):
            yield from _given(value, key)


# What is said of it --------------------------------------------------------------------------------------------------


def _other_kind(key: str, value: Any, kinds: frozenset[str], config: Mapping[str, Any]) -> str:
    if isinstance(value, Mapping) and "part" in kinds:  # a part that is not there, of which something was set
        option, setters, remedy = _origin(key, config, f"{key}=null" if "None" in kinds else f"~{key}")
        return f"{key}{setters} has no _target_, and {option} has no such part: {remedy}"
    wanted = " or ".join(words for kind, words in KINDS.items() if kind in kinds)
    single = f"; single ones are set by {key}.*" if "part" in kinds and value is not None else ""
    return f"{key} must be {wanted}, got {as_written(value)}{single}"


def _unknown(key: str, target: str, names: frozenset[str], config: Mapping[str, Any]) -> str:
    option, setters, remedy = _origin(key, config, f"~{key}")
    near = [] if setters else difflib.get_close_matches(key.rpartition(".")[2], names, 1)
    has = f"; did you mean {near[0]}?" if near else f", which has {', '.join(sorted(names)) or 'none'}: {remedy}"
    return f"{key}{setters} is not a setting of {target.rpartition('.')[2]} ({option}){has}"


def _origin(key: str, config: Mapping[str, Any], without: str) -> tuple[str, str, str]:
    """The option that a setting is for, which files of options set it, and what takes it away."""
    choices, overrides = choices_of(config["overrides"]), config["overrides"]
    group = key.partition(".")[0]
    option = f"{group}={choices[group]}" if choices.get(group) else group
    named = {text: key_of(text) for text in overrides}
    if given := [text for text, name in named.items() if "." in name and overlap(name, key)]:
        return option, "", f"leave {' and '.join(given)} out"
    setters = setters_of(key, choices)
    groups = {group, *(other.partition("/")[0] for other, _ in setters)} - {"method"}
    leave = " or ".join(text for text, name in named.items() if name in groups)
    told = f", set by {' and '.join(f'conf/{other}/{one}.yaml' for other, one in setters)}," if setters else ""
    return option, told, f"leave {leave} out, or add {without}" if leave else f"add {without}"
