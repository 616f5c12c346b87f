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
        if self.config.get("table") is not None and not self._plan(list(arguments)):
            return None
        try:
            return super().sweep(list(arguments)) if self.plan is None or self.plan.runs else None
        except BaseException:
            log.warning("Not all jobs are done. To go on with those: the same command and hydra.sweep.dir=%s", folder)
            raise
        finally:
            paper = {name: str(row["paper"]) for name, row in (self.rows or {}).items() if row.get("paper")}
            written = write_sweep(folder, list(self.rows or ()), paper)
            if self.plan is not None:
                from heatsplat.studies.published import write_comparison

                written += write_comparison(folder, self.plan)
                log.info("%s", written[-2].read_text(encoding="utf-8"))
            for path in written:
                log.info("%s", path)

    def _plan(self, arguments: list[str]) -> bool:
        """Plans the runs of a published table and tells them, with what is missing; False where nothing is to be done.

        Exit code 1 where the table asks for what there is not, or none of its scenes is on disk.
        """
        from heatsplat.contracts import SceneError
        from heatsplat.studies.published import make_plan

        table = OmegaConf.to_container(self.config.table)
        metrics = self.config.callbacks.get("metrics") or {}
        try:
            self.plan = make_plan(
                table,
                self.config.data.root,
                self.hydra_context.config_loader.get_group_options("method"),
                self._ablation(table["ablation"]),
                {text.lstrip("+~").partition("=")[0] for text in arguments},
            )
        except SceneError as error:
            log.error("%s", error)
            sys.exit(1)
        nothing = bool(self.plan.missing) and not self.plan.runs
        told = self.plan.told(metrics.get("lpips_net"), metrics.get("lpips_weights"))
        log.log(logging.ERROR if nothing else logging.INFO, "%s", told)
        if nothing:
            sys.exit(1)
        return not table["dry"]

    def _ablation(self, name: str | None) -> Mapping[str, Mapping[str, Any]]:
        """Rows of a ready-made ablation (conf/ablation); none without a name."""
        if name is None:
            return {}
        loader = self.hydra_context.config_loader
        loaded = loader.load_configuration("train", [f"ablation={name}", "method=3dgs"], RunMode.MULTIRUN)
        return OmegaConf.to_container(loaded.hydra.sweeper.rows)
