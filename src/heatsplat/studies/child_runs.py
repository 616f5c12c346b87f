"""Training runs that a study starts, each in a folder of its own: a study that was stopped finds them there again."""

from __future__ import annotations

import logging
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from heatsplat.composition import further_places
from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import as_dict, key_of, setting, typed
from heatsplat.io.recorded import OVERRIDES, overrides_of
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults

log = logging.getLogger("heatsplat")

INSTALLED = "from heatsplat.cli import train; train()"  # what heatsplat-train does
WHERE_IT_LIES = ("budget_curves",)  # overrides that say where a file is, and not what it holds


class OtherSettingsError(SceneError):
    """A folder of the study holds what was made with other settings than are asked for."""


def train_or_read(place: Path, train: str | None, overrides: Sequence[str], study: Path) -> RunResults:
    """The results of the run in ``place``, which is trained unless it has some.

    Args:
        place: folder of the run.
        train: path of train.py; None: the installed heatsplat-train.
        overrides: what its command line says beside that folder.
        study: folder of the study, which goes on where it was stopped.

    Raises:
        OtherSettingsError: the folder holds a run of other settings. Threads are some, for seconds are reported of all runs.
        SceneError: the run failed.
    """
    if (place / METRICS_FILE).exists():
        if (place / OVERRIDES).exists():
            refuse_others(place, _settings(overrides_of(place)), _settings(as_dict(overrides)))
        return RunResults.read(place / METRICS_FILE)
    log.info("training %s", place)
    program = [train] if train else ["-c", INSTALLED]
    command = [sys.executable, *program, *overrides, setting("hydra.run.dir", place), *_further_configurations()]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        failed = place / FAILED
        raise SceneError(
            f"a run of the study failed; {failed if failed.exists() else 'its output'} says why. When that is mended, the "
            f"same command with {typed(setting('hydra.run.dir', study))} goes on with what is left.\nFolder of the run: {place}\n"
            f"Command: {shlex.join(command)}\nOutput:\n{(done.stderr or done.stdout)[-2000:]}"
        )
    return RunResults.read(place / METRICS_FILE)


def _further_configurations() -> list[str]:
    """What tells a run of the configurations beside heatsplat's that the study was told of."""
    quoted = [setting("", place).removeprefix("=") for place in further_places()]
    return [f"hydra.searchpath=[{','.join(quoted)}]"] if quoted else []


def spelled(value: Any) -> str:
    """A value as an override of a run has it: null for None."""
    return "null" if value is None else str(value)


def refuse_others(place: Path, before: Iterable[str], now: Iterable[str]) -> None:
    """Raises OtherSettingsError where the settings ("key=value") with which something was made are not those of now."""
    if changed := {*before} ^ {*now}:
        raise OtherSettingsError(
            f"{place} was made with other settings ({', '.join(sorted(changed))}): give the former ones, delete it, or give "
            "the study a folder of its own with hydra.run.dir"
        )


def all_rows(overrides: Iterable[str], **found: Iterable[Any]) -> str:
    """The line of a report that says what all of its runs have.

    Args:
        overrides: of all of them.
        found: key -> its values in their results; they take the place of overrides of this key, and None tells nothing.
    """
    known = {key: sorted({value for value in values if value is not None}) for key, values in found.items()}
    kept = [text for text in overrides if not known.get(key_of(text))]
    words = [*kept, *(f"{key}={','.join(map(str, values))}" for key, values in known.items() if values)]
    return f"All rows: `{' '.join(words)}`."


def _settings(overrides: Mapping[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in overrides.items() if key_of(key) not in WHERE_IT_LIES]
