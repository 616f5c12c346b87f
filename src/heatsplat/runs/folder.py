"""A run's folder: its results stay those of one configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from heatsplat.io.command_lines import as_dict
from heatsplat.io.recorded import OVERRIDES, overrides_of
from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.runs.checks import checked
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.resume import (
    checkpoints_in,
    differences,
    given_first,
    learned_by,
    new_in,
    shortened,
    stored_config,
)


def results_in(folder: Path, config: dict[str, Any]) -> RunResults | None:
    """The results that a run with this configuration left in a folder; None where there are none.

    Its checkpoints tell of which settings they are; where they were removed, what was given on the command line.

    Raises:
        OccupiedError: they are of a run with other settings, or of a heatsplat that did not have some, with their names; or
            nothing tells of which.
    """
    if not (folder / METRICS_FILE).exists():
        return None
    _, newest = next(checkpoints_in(folder), (None, {}))
    stored = stored_config(newest)
    changed = (
        given_first(differences(checked(config), stored), config, stored)
        if stored
        else _given_otherwise(folder, config)
    )
    if stored and changed and len(new_in(config, stored, changed)) == len(changed):
        raise OccupiedError(
            f"{folder} holds the results of an older heatsplat, which did not have {shortened(changed)}: give another folder "
            "with hydra.run.dir (of a sweep: hydra.sweep.dir), or delete that one, and it is trained anew"
        )
    if changed:
        raise OccupiedError(
            f"{folder} holds the results of a run with other settings ({shortened(changed)}): give another folder with "
            "hydra.run.dir (of a sweep: hydra.sweep.dir), or delete that one"
        )
    return RunResults.read(folder / METRICS_FILE)


def _given_otherwise(folder: Path, config: dict[str, Any]) -> list[str]:
    """Settings that a command line gave otherwise to the run in a folder, which has no checkpoint to compare with."""
    if not (folder / OVERRIDES).exists():
        raise OccupiedError(
            f"{folder} holds results without a checkpoint that tells of which settings they are: give another folder with "
            "hydra.run.dir (of a sweep: hydra.sweep.dir), or delete that one"
        )
    before, now = learned_by(overrides_of(folder)), learned_by(as_dict(config["overrides"]))
    return sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
