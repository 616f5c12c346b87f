"""The result of a run: what metrics.json holds, how it is written and read."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import heatsplat
from heatsplat.metrics.definitions import COSTS, DEFINITIONS

# What a run leaves in its folder, beside checkpoints and pictures.
METRICS_FILE = "metrics.json"
CURVE_FILE = "curve.csv"  # its validations
FAILED = "FAILED"  # why it has no results

SECTIONS = ("run", "test", "cost", "effects", "data", "versions", "definitions")


@dataclass
class RunResults:
    """What a run found, on which the callbacks of a run also tell each other what they measured.

    A value that cannot be had is null, and ``reasons`` says why under "section.name". JSON has no infinity: an infinite
    value (the PSNR of identical images) is null too, with the reason "infinite".

    Args:
        run: what was run: method, scene, seed, steps and the like.
        test: scores on the test views, named as in ``heatsplat.metrics.DEFINITIONS``.
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
                    if value is not None and not (_is_number(value) and math.isfinite(value)):
                        raise ValueError(f"{section}.{name} is neither a number nor null: {value!r}")
        except (ValueError, TypeError) as error:  # of JSON and UTF-8, too
            raise ValueError(f"{path} is not a metrics.json of heatsplat: {error}") from error
        return cls(**{name: content[name] for name in sections})


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def write_atomically(path: str | Path, content: str | bytes | memoryview) -> None:
    """Writes a file through a temporary one beside it, which is on the disk before it gets the name; makes its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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


def collect_versions() -> dict[str, Any]:
    """Versions of heatsplat, of what it stands on and of its source tree: commit, and whether files differ from it."""
    found: dict[str, Any] = {"heatsplat": heatsplat.__version__, "python": platform.python_version()}
    for name, package in (
        ("torch", "torch"),
        ("numba", "numba"),
        ("lightning", "pytorch-lightning"),
        ("numpy", "numpy"),
    ):
        try:
            found[name] = version(package)
        except PackageNotFoundError:
            found[name] = None
    found["platform"] = platform.platform()
    found["git_commit"] = found["git_dirty"] = None
    here = Path(heatsplat.__file__).resolve()
    # An installed copy may lie inside another project's repository; that one's commit says nothing about this code.
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is not None:
        found["git_commit"] = _git(here.parent, "rev-parse", "HEAD")
        status = _git(here.parent, "status", "--porcelain", "--untracked-files=no")
        found["git_dirty"] = None if status is None else bool(status)
    return found


def processor() -> str:
    """Name of this machine's processor and its number of cores, such as "AMD EPYC 7R13, 2 cores"."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")  # Linux, where ``platform`` knows the architecture only
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {os.cpu_count()} cores"


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command in ``folder``, or None where git or the repository is not there."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
