"""What a result was measured with: the code, what it stands on and the machine."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import heatsplat


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
