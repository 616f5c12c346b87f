"""The sweeper behind ``-m``, ``ablation=`` and ``experiment=``: rows of a table times a grid, and the table at the end."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Override
from hydra.types import RunMode
from omegaconf import OmegaConf

if TYPE_CHECKING:
    from heatsplat.studies.published import Plan

log = logging.getLogger("heatsplat")


class RowSweeper(BasicSweeper):
    """Runs every row with every combination of the grid; when the last job has ended it writes the table of results.

    A job that fails leaves FAILED in its folder, the others go on, and the table names it. A sweep that is started again
    in the same folder (``hydra.sweep.dir=...``) skips the jobs that have results; the others go on from their checkpoints.

    Args:
        max_batch_size: jobs handed to the launcher at a time; None for all.
        params: the grid: key -> values with commas, as on the command line.
        rows: name of a row -> {"set": overrides of the row, "paper": what the paper prints for it}; None for a grid alone.
    """

    def __init__(
        self,
        max_batch_size: int | None = None,
        params: Mapping[str, str] | None = None,
        rows: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        super().__init__(max_batch_size, None if params is None else dict(params))
        self.rows = rows
        self.plan: Plan | None = None

    def split_arguments(self, overrides: list[Override], max_batch_size: int | None) -> list[list[list[str]]]:
        """Batches of jobs, each the list of its overrides; all rows come with one seed before the next seed begins."""
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
        if self.plan is not None:
            jobs = [[*job, *run.overrides, f"row='{run.row}'"] for job in jobs for run in self.plan.runs]
        elif self.rows:
            jobs = [[*job, *row.get("set", ()), f"row='{name}'"] for job in jobs for name, row in self.rows.items()]
        return list(self.split_overrides_to_chunks(jobs, max_batch_size))

    def sweep(self, arguments: Sequence[str]) -> Any:
        from heatsplat.studies.sweeps import write_sweep

        folder = Path(self.config.hydra.sweep.dir)
        try:
            return super().sweep(list(arguments))
        except BaseException:
            log.warning("Not all jobs are done. To go on with those: the same command and hydra.sweep.dir=%s", folder)
            raise
        finally:
            paper = {name: str(row["paper"]) for name, row in (self.rows or {}).items() if row.get("paper")}
            for path in write_sweep(folder, list(self.rows or ()), paper):
                log.info("%s", path)
