"""A run's folder: its results stay those of one configuration."""

from __future__ import annotations

from collections.abc import Mapping
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

ENDS = ("max_steps", "max_epochs", "max_time")  # of Lightning's trainer


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
        given_first([*differences(checked(config), stored), *_ended_otherwise(config, stored)], config, stored)
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


def _ended_otherwise(config: dict[str, Any], stored: Mapping[str, Any]) -> list[str]:
    """Settings by which Lightning ends one run at another step than the other. A run that was stopped so goes on with others;
    its results stay those of the steps that it took."""
    here, there = (one.get("trainer") or {} for one in (config, stored))
    return [f"trainer.{name}" for name in ENDS if here.get(name) != there.get(name)]


def _given_otherwise(folder: Path, config: dict[str, Any]) -> list[str]:
    """Settings that a command line gave otherwise to the run in a folder, which has no checkpoint to compare with."""
    if not (folder / OVERRIDES).exists():
        raise OccupiedError(
            f"{folder} holds results without a checkpoint that tells of which settings they are: give another folder with "
            "hydra.run.dir (of a sweep: hydra.sweep.dir), or delete that one"
        )
    before, now = learned_by(overrides_of(folder)), learned_by(as_dict(config["overrides"]))
    ends = {f"trainer.{name}" for name in ENDS}
    for known, given in ((before, overrides_of(folder)), (now, as_dict(config["overrides"]))):
        known.update((key, value) for key, value in given.items() if key.lstrip("+~") in ends)
    return sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
