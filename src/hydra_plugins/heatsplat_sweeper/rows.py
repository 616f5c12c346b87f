"""The sweeper behind ``-m``, ``ablation=`` and ``experiment=``: rows of a table times a grid, and the table at the end."""

from __future__ import annotations

import hashlib
import itertools
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf

from heatsplat.errors import SceneError
from heatsplat.io.command_lines import as_dict, keys_of
from hydra_plugins.heatsplat_launchers._jobs import JobLauncher, planned

if TYPE_CHECKING:
    from heatsplat.studies.leaderboard.plan import Board
    from heatsplat.studies.published import Reproduction

log = logging.getLogger("heatsplat")

LONGEST = 120  # letters; file systems allow 255 bytes, and row, scene and number come with them


def folder_name(overrides: str) -> str:
    """Overrides of a job as a part of its folder's name: the same for the same job, another for every other job.

    What is too long loses its middle, for seeds stand at its end; what would be a folder of its own is written in one. A hash
    of the whole then stands behind.
    """
    name = re.sub(r"[/\\]", "-", overrides)
    if len(name) <= LONGEST and name == overrides:
        return name
    mark = f"-{hashlib.sha256(overrides.encode()).hexdigest()[:8]}"
    if len(name) > LONGEST - len(mark):
        half = (LONGEST - len(mark) - len("..")) // 2
        name = f"{name[:half]}..{name[-half:]}"
    return name + mark


OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)


class Batches:
    """A launcher that is handed a batch of jobs at a time. What failed is told when the last batch has ended.

    Args:
        launcher: what runs a batch.
        size: jobs in a batch; None for as many as there are.
        first: so many jobs at the beginning are to end before any other starts.
    """

    def __init__(self, launcher: Launcher, size: int | None, first: int = 0) -> None:
        self.launcher, self.size, self.first = launcher, size, first

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        """What the jobs returned, those that failed too, in their order."""
        returned: list[JobReturn] = []
        count = len(job_overrides)
        size = self.size or max(count, 1)
        bounds = [*range(0, self.first, size), *range(self.first, count, size), count]
        for start, end in itertools.pairwise(bounds):
            returned += self.launcher.launch(job_overrides[start:end], initial_job_idx=initial_job_idx + start)
        return returned


class RowSweeper(BasicSweeper):
    """Runs every row with every combination of the grid; when the last job has ended it writes the table of results.

    A job that fails leaves FAILED in its folder, the others go on, and the table names it. A sweep that is started again
    in the same folder (``hydra.sweep.dir=...``) skips the jobs that have results; the others go on from their checkpoints.

    Args:
        max_batch_size: jobs handed to the launcher at a time, all batches one after the other; None for all at once.
        params: the grid: key -> values with commas, as on the command line.
        paper: the paper's table that the rows are beside: {"of": paper, "table": label, "scenes": whose figures}; None without.
        rows: name of a row -> {"set": overrides of the row, "printed": its setting in that table}; None for a grid alone.
        of: the method whose parts the rows are, or several; another is refused. None for any.
    """

    def __init__(
        self,
        max_batch_size: int | None = None,
        params: Mapping[str, str] | None = None,
        paper: Mapping[str, Any] | None = None,
        rows: Mapping[str, Mapping[str, Any]] | None = None,
        of: str | Sequence[str] | None = None,
    ) -> None:
        if max_batch_size is not None and max_batch_size < 1:
            raise ValueError(f"hydra.sweeper.max_batch_size must be 1 or more, or null for all, got {max_batch_size}")
        # Hydra's own batches end with the first one in which a job failed, so to Hydra all jobs are one.
        super().__init__(None, None if params is None else dict(params))
        self.batch = max_batch_size
        self.paper = paper
        self.rows = rows
        self.of = of
        self.reproduction: Reproduction | None = None
        self.board: Board | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        super().setup(hydra_context=hydra_context, task_function=task_function, config=config)
        if self.batch is not None:
            self.launcher = Batches(self.launcher, self.batch)

    def split_arguments(self, overrides: list[Override], max_batch_size: int | None) -> list[list[list[str]]]:
        """All jobs as one batch, each the list of its overrides; all rows come with one seed before the next seed begins.

        Raises:
            SceneError: rows are parts of another method than a job's.
        """
        (jobs,) = BasicSweeper.split_arguments(overrides, None)
        if self.reproduction is not None:
            jobs = self._of_table(self.reproduction, jobs)
        elif self.board is not None:
            jobs = [run for given in jobs for run in self.board.jobs(given)]
        elif self.rows:
            self._check_methods(jobs)
            jobs = [[*job, *row.get("set", ()), f"row='{name}'"] for job in jobs for name, row in self.rows.items()]
        return [jobs]

    def _check_methods(self, jobs: Sequence[Sequence[str]]) -> None:
        """Raises SceneError where the rows would not be what they are called, for they are parts of another method."""
        from heatsplat.studies.options import listed

        if not (own := listed(self.of)):
            return
        chosen = self.config.hydra.runtime.choices.method
        asked = {as_dict(job).get("method", chosen).strip("'\"") for job in jobs}
        if others := sorted(asked - {*own}):
            raise SceneError(
                f"the rows of this ablation are parts of method={' or '.join(own)}, not of method={', '.join(others)}: leave "
                "method out, or choose an ablation of that method"
            )

    def _of_table(self, reproduction: Reproduction, grid: Sequence[Sequence[str]]) -> list[list[str]]:
        """The jobs of a table: those that others come after stand at the beginning, once each, and end before these start."""
        first: dict[tuple[str, ...], Path] = {}
        jobs = []
        for given in grid:
            for run in reproduction.runs:
                after = []
                if run.after is not None:
                    before = tuple(run.after.job(given))
                    if before not in first:
                        first[before] = planned(self.hydra_context, self.config, len(first), before).folder.absolute()
                    after = [f"table.after='{first[before]}/checkpoints/last.ckpt'"]
                jobs.append([*run.job(given), *after])
        if first:
            self.launcher = Batches(self.launcher, self.batch, len(first))
        return [*map(list, first), *jobs]

    def sweep(self, arguments: Sequence[str]) -> Any:
        from heatsplat.studies.sweeps import write_sweep

        folder = Path(self.config.hydra.sweep.dir)
        if self.config.get("table") is not None and not self._plan(list(arguments)):
            return None
        if self.config.get("leaderboard") is not None:
            self._plan_board(list(arguments))
        idle = (self.reproduction is not None and not self.reproduction.runs) or (self.board and not self.board.jobs())
        try:
            return None if idle else super().sweep(list(arguments))
        except BaseException:
            if any(folder.glob("*/.hydra")):  # without a job it is the command that is wrong
                log.warning(
                    "Not all jobs are done. To go on with those: the same command and hydra.sweep.dir=%s", folder
                )
            raise
        finally:
            written = [] if self.board else write_sweep(folder, list(self.rows or ()), self._printed())
            if self.board is not None:
                from heatsplat.studies.leaderboard.report import write_leaderboard

                written += write_leaderboard(folder, self.board)
            if self.reproduction is not None:
                from heatsplat.studies.published import write_comparison

                written += write_comparison(folder, self.reproduction)
                log.info("%s", written[-2].read_text(encoding="utf-8"))
            for path in written:
                log.info("%s", path)

    def _printed(self) -> dict[str, dict[str, str]]:
        """What the paper prints for the rows: name of row -> score or cost -> text."""
        from heatsplat.studies.published import quoted

        if self.paper is None:
            return {}
        of, table, scenes = (self.paper[key] for key in ("of", "table", "scenes"))
        settings = {name: row["printed"] for name, row in (self.rows or {}).items() if "printed" in row}
        return {name: quoted(of, table, setting, scenes) for name, setting in settings.items()}

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        """Composes every job before any starts, unless the launcher does so by itself: a hundred take a minute."""
        if not isinstance(self.launcher, JobLauncher):
            # Of a leaderboard one job per method and track: scenes and seeds make no other configuration.
            alike = ("data.scene=", "seed=", "callbacks.temperatures.image=")
            told = {tuple(text for text in job if not text.startswith(alike)): job for job in batch}
            super().validate_batch_is_legal(list(told.values()) if self.board else batch)

    def _plan(self, arguments: list[str]) -> bool:
        """Plans the runs of a published table and tells them, with what is missing; False where nothing is to be done.

        Exit code 1 where the table asks for what there is not, or none of its scenes is on disk.
        """
        from heatsplat.studies.published import reproduction_of

        table = OmegaConf.to_container(self.config.table)
        metrics = self.config.callbacks.get("metrics") or {}
        try:
            self.reproduction = reproduction_of(
                table,
                self.config.data.root,
                self.hydra_context.config_loader.get_group_options("method"),
                self._ablation(table["ablation"]),
                keys_of(arguments),
            )
        except SceneError as error:
            log.error("%s", error)
            sys.exit(1)
        nothing = bool(self.reproduction.missing) and not self.reproduction.runs
        told = self.reproduction.summary(metrics.get("lpips_net"), metrics.get("lpips_weights"))
        log.log(logging.ERROR if nothing else logging.INFO, "%s", told)
        if nothing:
            sys.exit(1)
        return not table["dry"]

    def _plan_board(self, arguments: list[str]) -> None:
        """Plans the runs of the leaderboard and tells how many; exit code 1 where it asks for what there is not."""
        from heatsplat.studies.leaderboard.plan import board_of

        asked = OmegaConf.to_container(self.config.leaderboard, resolve=True)
        try:
            methods = self.hydra_context.config_loader.get_group_options("method")
            self.board = board_of(asked, methods, keys_of(arguments))
        except SceneError as error:
            log.error("%s", error)
            sys.exit(1)
        log.info("%s", self.board.summary())

    def _ablation(self, name: str | None) -> Mapping[str, Mapping[str, Any]]:
        """Rows of a ready-made ablation (conf/ablation); none without a name."""
        if name is None:
            return {}
        loader = self.hydra_context.config_loader
        loaded = loader.load_configuration("train", [f"ablation={name}", "method=3dgs"], RunMode.MULTIRUN)
        return OmegaConf.to_container(loaded.hydra.sweeper.rows)
