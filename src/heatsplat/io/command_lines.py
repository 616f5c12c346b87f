"""Settings as Hydra's command line reads them, whatever their text, and what such settings are for."""

from __future__ import annotations

import re
import shlex
from argparse import ArgumentParser
from collections.abc import Iterable
from pathlib import Path
from typing import Any

# Text that Hydra's grammar takes as it stands; it gives "=", ",", spaces, brackets and letters beyond ASCII a meaning or none.
PLAIN = re.compile(r"[\w./-]+", re.ASCII)
# What it takes for a number, with all that looks like one, such as the date 2024_08_07; and for nothing, true and false.
NUMBER = re.compile(r"[+-]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(e[+-]?\d[\d_]*)?|[+-]?(inf|nan)", re.ASCII | re.IGNORECASE)
NO_TEXT = re.compile(r"null|true|false", re.IGNORECASE)
# Settings that name a file, a folder or a scene, whatever it is called.
NAMES = (
    "camera_file", "check", "ckpt", "data.images", "data.masks", "data.raw", "data.rgb", "data.root", "data.scene",
    "data.split_file", "data.time_csv", "hydra.run.dir", "hydra.sweep.dir", "init.path", "poses.model", "source", "study.root",
    "study.runs", "study.submission", "study.target", "table", "target",
)  # fmt: skip


def setting(key: str, value: Any) -> str:
    """``key=value`` as an argument for Hydra: text that it would not take as it stands, such as many a path, in single quotes."""
    if value is None or isinstance(value, int | float):
        return f"{key}={'null' if value is None else str(value).lower()}"
    text = str(value)
    taken = PLAIN.fullmatch(text) and not NUMBER.fullmatch(text) and not NO_TEXT.fullmatch(text)
    return f"{key}={text if taken else _quoted(text)}"


def _quoted(text: str) -> str:
    """A text in single quotes, before which backslashes are doubled."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def typed(argument: str) -> str:
    """An argument as it is typed in a shell: in double quotes, which leave Hydra's own to Hydra, where that is needed."""
    if re.fullmatch(r"[\w./=-]+", argument, re.ASCII):
        return argument
    return shlex.quote(argument) if re.search(r'[$`"\\!]', argument) else f'"{argument}"'


def config_dirs(arguments: Iterable[str]) -> tuple[list[Path], list[str]]:
    """The folders that Hydra's --config-dir names on a command line, and its other arguments."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    found, others = parser.parse_known_args([*arguments])
    return [] if found.config_dir is None else [found.config_dir.expanduser()], others


def with_names(overrides: Iterable[str]) -> list[str]:
    """Overrides with quotes about names of files, folders and scenes (``NAMES``) that Hydra would take for numbers, such as
    data.scene=2024_08_07; of several for a sweep, where all are."""
    return [_with_names(override) for override in overrides]


def _with_names(override: str) -> str:
    key, _, value = override.partition("=")
    names = value.split(",")
    if key_of(override) not in NAMES or not all(map(NUMBER.fullmatch, names)):
        return override
    return f"{key}={','.join(map(_quoted, names))}"


def key_of(override: str) -> str:
    """What an override is for, such as "data.scene" of "data.scene=heated", "+data.scene=heated" or "~data.scene"."""
    return override.lstrip("+~").partition("=")[0]


def keys_of(overrides: Iterable[str]) -> set[str]:
    """What overrides are for, such as {"max_steps", "data.scene"}."""
    return {key_of(text) for text in overrides}


def as_dict(overrides: Iterable[str]) -> dict[str, str]:
    """Overrides as key -> text of the value; keys keep a + or ~, with which they are typed."""
    return dict(text.partition("=")[::2] for text in overrides)
