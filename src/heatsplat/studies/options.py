"""Options of studies as they are typed on a command line: lists of any length, and numbers that count."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from heatsplat.contracts import SceneError, as_written, check_count, check_option


def listed(value: Any) -> list[Any]:
    """The values of an option: those of a list, a word or number that stands alone, none for null."""
    if value is None:
        return []
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]


def of_runs(overrides: Any, threads: int | None) -> list[str]:
    """Overrides of the runs of a study (``listed``), with the number of their CPU threads before them; None leaves it to them."""
    return [*([] if threads is None else [f"threads={threads}"]), *listed(overrides)]


def non_empty(key: str, value: Any) -> list[Any]:
    """``listed``, where nothing can be done without a value.

    Args:
        key: of the option, such as "study.seeds".
        value: of it.

    Raises:
        SceneError: there is none.
    """
    if not (found := listed(value)):
        raise SceneError(f"{key}={as_written(value)} has nothing in it: give at least one value")
    return found


def subset_of(key: str, value: Any, known: Iterable[Any]) -> list[Any]:
    """``non_empty``, where every value is one of those that are known. Raises SceneError where one is not."""
    found, known = non_empty(key, value), list(known)
    for one in found:
        check_option(f"each of {key}", one, known, SceneError)
    return found


def whole_numbers(key: str, value: Any, least: int = 1) -> list[int]:
    """``non_empty``, where every value is a whole number, ``least`` or more. Raises SceneError where one is not."""
    found = non_empty(key, value)
    for one in found:
        check_count(key, one, least)
    return found
