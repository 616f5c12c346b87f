"""Nested settings and their dotted keys, such as "thermal.source.frequencies"."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def walk(settings: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of every setting, those that hold others before these."""
    for name, value in settings.items():
        key = f"{path}.{name}".removeprefix(".")
        yield key, value
        if isinstance(value, Mapping):
            yield from walk(value, key)


def at(settings: Any, key: str, default: Any = None) -> Any:
    """The value at a dotted key, or ``default`` where the settings have none."""
    for name in key.split("."):
        if not isinstance(settings, Mapping) or name not in settings:
            return default
        settings = settings[name]
    return settings
