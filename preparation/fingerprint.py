"""What something was made of, in a few characters: the same for the same content, in whatever classes it stands."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass
from typing import Any


def fingerprint(*parts: Any) -> str:
    """32 hexadecimal digits of plain values, containers of them and dataclasses.

    Of a dataclass the values count that its ``repr`` shows, by their names; the class's own name does not, so that a renamed
    class leaves what was made of it valid.
    """
    return hashlib.sha256(json.dumps([_plain(part) for part in parts], sort_keys=True).encode()).hexdigest()[:32]


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value) if f.repr}
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value if isinstance(value, str | int | float | bool | None) else repr(value)
