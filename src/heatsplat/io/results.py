"""The result of a run: what metrics.json holds, how it is written and read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from heatsplat.errors import is_number
from heatsplat.io.files import write_atomically
from heatsplat.metrics.definitions import COSTS, DEFINITIONS

# What a run leaves in its folder, beside checkpoints and pictures.
METRICS_FILE = "metrics.json"
CURVE_FILE = "curve.csv"  # its validations
FAILED = "FAILED"  # why it has no results
LAST_CHECKPOINT = Path("checkpoints", "last.ckpt")

SECTIONS = ("run", "test", "cost", "effects", "data", "versions", "definitions")


def checkpoint_of(path: str | Path) -> Path:
    """The file that a checkpoint's path means: the last checkpoint where it is a run's folder, or its folder of checkpoints.

    Raises:
        ValueError: it is no path, such as a list of several.
    """
    if not isinstance(path, str | PathLike):
        raise ValueError(f"ckpt must be one checkpoint or the folder of one run, got {path}")
    path = Path(path).expanduser()
    lasts = (path / LAST_CHECKPOINT, path / LAST_CHECKPOINT.name)
    return next((last for last in lasts if last.is_file()), path)


@dataclass
class RunResults:
    """What a run found, on which the callbacks of a run also tell each other what they measured.

    A value that cannot be had is null, and ``reasons`` says why under "section.name". JSON has no infinity: an infinite
    value is null too, with the reason "infinite".

    Args:
        run: what was run: method, scene, seed, steps and the like.
        test: scores on the test views, named as in ``heatsplat.metrics.definitions``.
        cost: what the run took: seconds, steps and frames per second, memory in MB (10^6 bytes), number of Gaussians.
        effects: which physical effects were simulated, each with its settings.
        data: what the loader found and assumed.
        versions: of the code and of what it stands on.
        definitions: what each score means, in one sentence each.
        reasons: why a value is null.
    """

    run: dict[str, Any] = field(default_factory=dict)
    test: dict[str, float | None] = field(default_factory=dict)
    cost: dict[str, float | None] = field(default_factory=dict)
    effects: dict[str, Any] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, Any] = field(default_factory=dict)
    definitions: dict[str, Any] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)

    def put(self, section: str, name: str, value: float | None, reason: str | None = None) -> None:
        """Sets a number of ``section`` ("test" or "cost"), or None with the reason.

        Raises:
            ValueError: None without a reason, or NaN.
        """
        if value is None and not reason:
            raise ValueError(f"{section}.{name} is null: say why (reason=...)")
        if value is not None and math.isnan(value):
            raise ValueError(f"{section}.{name} is NaN; a value that cannot be had is None with a reason")
        getattr(self, section)[name] = value
        if value is None:
            self.reasons[f"{section}.{name}"] = reason
        else:
            self.reasons.pop(f"{section}.{name}", None)

    def as_json(self) -> dict[str, Any]:
        """All sections as plain JSON values; missing and infinite numbers are null and listed in ``reasons``."""
        reasons = dict(self.reasons)
        plain = {section: _plain(getattr(self, section), section, reasons) for section in SECTIONS}
        for section, names in (("test", DEFINITIONS), ("cost", COSTS)):
            found = plain[section]
            plain[section] = {name: found.pop(name, None) for name in names} | found  # always in one order
            for name, value in plain[section].items():
                if value is None:
                    reasons.setdefault(f"{section}.{name}", "not measured in this run")
        return {**plain, "reasons": reasons}

    def write(self, path: str | Path) -> None:
        """Writes metrics.json as a whole or not at all: a reader never sees half a file."""
        write_atomically(path, json.dumps(self.as_json(), indent=2, ensure_ascii=False, allow_nan=False) + "\n")

    @classmethod
    def read(cls, path: str | Path) -> RunResults:
        """The results in a metrics.json.

        Raises:
            ValueError: the file is not one, naming it and what is wrong.
        """
        sections = (*SECTIONS, "reasons")
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            lacking = [name for name in sections if not isinstance(dict(content).get(name), dict)]
            if lacking:
                raise ValueError(f"sections are missing or no mappings: {', '.join(lacking)}")
            for section in ("test", "cost"):
                for name, value in content[section].items():
                    if value is not None and not is_number(value):
                        raise ValueError(f"{section}.{name} is neither a number nor null: {value!r}")
        except (ValueError, TypeError) as error:  # of JSON and UTF-8, too
            raise ValueError(f"{path} is not a metrics.json of heatsplat: {error}") from error
        return cls(**{name: content[name] for name in sections})


def _plain(value: Any, path: str, reasons: dict[str, str]) -> Any:
    """``value`` as JSON can hold it: arrays become lists, what is not finite null with a reason under ``path``."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{path}.{key}", reasons) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        items = sorted(value, key=str) if isinstance(value, (set, frozenset)) else value
        return [_plain(item, f"{path}.{i}", reasons) for i, item in enumerate(items)]
    if hasattr(value, "tolist"):  # tensors, arrays and their scalars
        return _plain(value.tolist(), path, reasons)
    if isinstance(value, float) and not math.isfinite(value):
        reasons.setdefault(path, "not a number" if math.isnan(value) else "infinite")
        return None
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)
