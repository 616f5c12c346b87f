"""Training runs that a study starts, each in a folder of its own: a study that was stopped finds them there again."""

from __future__ import annotations

import logging
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import setting
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults
from heatsplat.studies.recorded import OVERRIDES, overrides_of

log = logging.getLogger("heatsplat")

INSTALLED = "from heatsplat.cli import train; train()"  # what heatsplat-train does
WHERE_IT_RUNS = ("threads", "budget_curves")  # overrides of which a run's results do not tell


def trained(place: Path, train: str | None, overrides: Sequence[str], study: Path) -> RunResults:
    """The results of the run in ``place``, which is trained unless it has some.

    Args:
        place: folder of the run.
        train: path of train.py; None: the installed heatsplat-train.
        overrides: what its command line says beside that folder.
        study: folder of the study, which goes on where it was stopped.

    Raises:
        SceneError: the run failed, or the folder holds a run of other settings.
    """
    if (place / METRICS_FILE).exists():
        _refuse_others(place, overrides)
        return RunResults.read(place / METRICS_FILE)
    log.info("training %s", place)
    program = [train] if train else ["-c", INSTALLED]
    command = [sys.executable, *program, *overrides, setting("hydra.run.dir", place)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        failed = place / FAILED
        raise SceneError(
            f"a run of the study failed; {failed if failed.exists() else 'its output'} says why. When that is mended, the "
            f"same command with hydra.run.dir={study} goes on with what is left.\nFolder of the run: {place}\n"
            f"Command: {shlex.join(command)}\nOutput:\n{(done.stderr or done.stdout)[-2000:]}"
        )
    return RunResults.read(place / METRICS_FILE)


def spelled(value: Any) -> str:
    """A value as an override of a run has it: null for None."""
    return "null" if value is None else str(value)


def _refuse_others(place: Path, overrides: Sequence[str]) -> None:
    if not (place / OVERRIDES).exists():
        return
    before, now = _settings(overrides_of(place).items()), _settings(text.partition("=")[::2] for text in overrides)
    if before != now:
        raise SceneError(
            f"{place} holds a run with other settings ({', '.join(sorted(before ^ now))}): delete that folder, or give the "
            "study a folder of its own with hydra.run.dir"
        )


def _settings(overrides: Iterable[tuple[str, str]]) -> frozenset[str]:
    return frozenset(f"{key}={value}" for key, value in overrides if key not in WHERE_IT_RUNS)
