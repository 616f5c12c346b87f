"""Settings as Hydra's command line reads them, whatever their text."""

from __future__ import annotations

import re
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
