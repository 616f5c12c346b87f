"""What may be built from a checkpoint, which may be anybody's: parts that heatsplat's own configurations name."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from heatsplat.composition import CONF
from heatsplat.contracts import SceneError

ENTRY_POINTS = "heatsplat.parts"  # under which an installed package registers its classes: mine = my_package.heat:Mine
COMMANDS = {"study", "launcher", "hydra", "callbacks", "logger"}  # groups of which nothing is built from a checkpoint
NOT_BUILT = {"callbacks", "logger", "overrides", "composed"}  # entries of a configuration of which nothing is
TARGET = re.compile(r"""_target_:\s*["']?([\w.]+)""")


def vocabulary() -> set[str]:
    """The ``_target_`` that may stand in a checkpoint, fully dotted. Nothing is imported to find them."""
    return _own() | {entry.value.replace(":", ".") for entry in entry_points(group=ENTRY_POINTS)}


@cache  # some two hundred files
def _own() -> frozenset[str]:
    files = (path for path in Path(CONF).rglob("*.yaml") if path.relative_to(CONF).parts[0] not in COMMANDS)
    return frozenset(target for path in files for target in TARGET.findall(path.read_text(encoding="utf-8")))


def trusted(config: Any, path: Path | str, trust: Collection[str] = ()) -> dict[str, Any]:
    """The configuration of a checkpoint without what nothing is built of, once nothing in it can run code but known parts.

    A part is known if heatsplat's configurations name it, an installed package registers it under the entry points
    "heatsplat.parts", or it is in ``trust``. Functions are only taken as they are (``_partial_``), never called.

    Args:
        config: as the checkpoint holds it.
        path: of the checkpoint, for messages.
        trust: further classes, fully dotted.

    Raises:
        SceneError: the configuration holds anything else: another ``_target_`` or key of Hydra's, an interpolation, or what is no
            plain value. Nothing was imported or built by then.
    """
    if not isinstance(config, dict):
        raise SceneError(f"{path} holds no configuration to build from; is it a checkpoint of heatsplat?")
    kept = {key: value for key, value in config.items() if key not in NOT_BUILT}
    unknown: dict[str, str] = {}
    try:
        found = list(_foreign(kept, "", vocabulary() | set(trust), unknown))
    except RecursionError:
        found = ["its configuration contains itself"]
    if found:
        raise SceneError(f"{path} is not loaded: {found[0]}")
    if unknown:
        key, target = next(iter(unknown.items()))
        raise SceneError(
            f"{path} is not loaded: {key}._target_ is {target!r}. From a checkpoint come only classes that heatsplat's "
            f"configurations name, or that an installed package registers under the entry points '{ENTRY_POINTS}'; if you know "
            f"these and who sent them: trust=[{','.join(dict.fromkeys([*trust, *unknown.values()]))}]"
        )
    return kept


def _foreign(value: Any, key: str, allowed: Collection[str], unknown: dict[str, str]) -> Iterator[str]:
    """What is wrong with a value and all in it, in words; classes that are not allowed go to ``unknown``, by key."""
    if isinstance(value, Mapping):
        target = value.get("_target_")
        if "_target_" in value and not isinstance(target, str):
            yield f"{key}._target_ is {target!r}"
        elif "_target_" in value and target not in allowed:
            unknown[key] = target
        elif "_target_" in value and target.rpartition(".")[2][0].islower() and value.get("_partial_") is not True:
            yield f"{key}._target_ is the function {target}, which would be called"
        for name, item in value.items():
            if not isinstance(name, str | int):
                yield f"{key} has the key {name!r}"
            elif str(name).startswith("_") and name not in ("_target_", "_partial_"):
                yield f"{key}.{name} is no setting of a part"
            else:
                yield from _foreign(item, f"{key}.{name}".lstrip("."), allowed, unknown)
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _foreign(item, f"{key}[{i}]", allowed, unknown)
    elif isinstance(value, str):
        if "${" in value:
            yield f"{key} is the interpolation {value!r}"
    elif not (value is None or isinstance(value, bool | int | float)):
        yield f"{key} is no plain value but {type(value).__name__}"
