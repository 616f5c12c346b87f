"""Settings as Hydra's command line reads them, whatever their text, and what such settings are for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

# Text that Hydra's grammar takes as it stands; it gives "=", ",", spaces, brackets and letters beyond ASCII a meaning or none.
PLAIN = re.compile(r"[\w./-]+", re.ASCII)


def setting(key: str, value: Any) -> str:
    """``key=value`` as an argument for Hydra: text that it would not take as it stands, such as many a path, in single quotes."""
    text = str(value)
    if PLAIN.fullmatch(text):
        return f"{key}={text}"
    escaped = text.replace("'", "\\'")
    return f"{key}='{escaped}'"


def typed(argument: str) -> str:
    """An argument as it is typed in a shell: in double quotes, which leave Hydra's own to Hydra, where that is needed."""
    return argument if re.fullmatch(r"[\w./=-]+", argument, re.ASCII) else f'"{argument}"'


def key_of(override: str) -> str:
    """What an override is for, such as "data.scene" of "data.scene=heated", "+data.scene=heated" or "~data.scene"."""
    return override.lstrip("+~").partition("=")[0]


def keys_of(overrides: Iterable[str]) -> set[str]:
    """What overrides are for, such as {"max_steps", "data.scene"}."""
    return {key_of(text) for text in overrides}


def as_dict(overrides: Iterable[str]) -> dict[str, str]:
    """Overrides as key -> text of the value; keys keep a + or ~, with which they are typed."""
    return dict(text.partition("=")[::2] for text in overrides)
