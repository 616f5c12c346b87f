"""The sweeper behind ``-m``, ``ablation=`` and ``experiment=``: rows of a table times a grid, and the table at the end."""

from __future__ import annotations

import itertools
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf

from heatsplat.errors import SceneError
from heatsplat.io.command_lines import keys_of, setting, typed
from heatsplat.io.files import short_name
from hydra_plugins.heatsplat_launchers._jobs import MANY, JobLauncher, composed, planned

if TYPE_CHECKING:
    from heatsplat.studies.sweep_plan import SweepPlan

log = logging.getLogger("heatsplat")

LONGEST = 120  # bytes; file systems allow 255, and row, scene and number come with them


def folder_name(overrides: str) -> str:
    """Overrides of a job as a part of its folder's name: the same for the same job, another for every other job.

    What is too long loses its middle, for seeds stand at its end; what would be a folder of its own is written in one.
    """
    return short_name(re.sub(r"[/\\]", "-", overrides), LONGEST, overrides)


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
    """Runs what a plan says (``studies.sweep_plan``); when the last job has ended, the plan writes the table of results.

    The configuration chooses the plan: a published table (``table``), the leaderboard (``leaderboard``), or the rows and the grid
    that are given here.

    A job that fails leaves FAILED in its folder, the others go on, and the table names it. A sweep that is started again
    in the same folder (``hydra.sweep.dir=...``) skips the jobs that have results; the others go on from their checkpoints.

    Args:
        max_batch_size: jobs handed to the launcher at a time, all batches one after the other; None for all at once.
        params: the grid: key -> values with commas, as on the command line.
        paper: the paper's table that the rows are beside: {"of": paper, "table": label, "scenes": whose figures}; None without.
        rows: name of a row -> {"set": overrides of the row, "printed": its setting in that table}; None for a grid alone.
        of: the method whose parts the rows are, or several; another is refused. None for any.
        knobs: in place of rows, settings whose numbers are changed one at a time: {"of": settings, "factors": by which}; None
            without.
    """

    def __init__(
        self,
        max_batch_size: int | None = None,
        params: Mapping[str, str] | None = None,
        paper: Mapping[str, Any] | None = None,
        rows: Mapping[str, Mapping[str, Any]] | None = None,
        of: str | Sequence[str] | None = None,
        knobs: Mapping[str, Any] | None = None,
    ) -> None:
        if max_batch_size is not None and max_batch_size < 1:
            raise ValueError(f"hydra.sweeper.max_batch_size must be 1 or more, or null for all, got {max_batch_size}")
        # Hydra's own batches end with the first one in which a job failed, so to Hydra all jobs are one.
        super().__init__(None, None if params is None else dict(params))
        self.batch = max_batch_size
        self.paper = paper
        self.rows = rows
        self.of = of
        self.knobs = knobs
        self.plan: SweepPlan | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        super().setup(hydra_context=hydra_context, task_function=task_function, config=config)
        if self.batch is not None:
            self.launcher = Batches(self.launcher, self.batch)

    def split_arguments(self, overrides: list[Override], max_batch_size: int | None) -> list[list[list[str]]]:
        """All jobs of the plan as one batch, each the list of its overrides. Raises SceneError as the plan does."""

        def folder_of(number: int, job: Sequence[str]) -> Path:
            return planned(self.hydra_context, self.config, number, job).folder.absolute()

        (grid,) = BasicSweeper.split_arguments(overrides, None)
        jobs, first = self.plan.jobs(grid, folder_of)
        if first:
            self.launcher = Batches(self.launcher, self.batch, first)
        return [jobs]

    def sweep(self, arguments: Sequence[str]) -> Any:
        """Exit code 1 where the command asks for what there is not."""
        folder = Path(self.config.hydra.sweep.dir)
        try:
            self.plan = self._plan_of(arguments)
        except SceneError as error:
            log.error("%s", error)
            sys.exit(1)
        if summary := self.plan.summary():
            log.info("%s", summary)
        try:
            return None if self.plan.idle else super().sweep(list(arguments))
        except BaseException:
            if any(folder.glob("*/.hydra")):  # without a job it is the command that is wrong
                where = typed(setting("hydra.sweep.dir", folder))
                log.warning("Not all jobs are done. To go on with those: the same command and %s", where)
            raise
        finally:
            for path in self.plan.write(folder):
                log.info("%s", path)

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        """Composes the jobs before any starts, unless the launcher does so by itself: a hundred take a minute."""
        if isinstance(self.launcher, JobLauncher):
            return
        jobs = self.plan.to_compose(batch)
        if len(jobs) >= MANY:
            log.info(
                "composing the settings of %d jobs before the first starts, so that none fails by a name", len(jobs)
            )
        super().validate_batch_is_legal(jobs)

    def _plan_of(self, arguments: Sequence[str]) -> SweepPlan:
        """What the configuration asks for. Raises SceneError where there is no such thing, or nothing of it is on disk."""
        if self.config.get("table") is not None:
            return self._table(keys_of(arguments))
        if self.config.get("leaderboard") is not None:
            from heatsplat.studies.leaderboard.plan import board_of
            from heatsplat.studies.leaderboard.sweep import Leaderboard

            asked = OmegaConf.to_container(self.config.leaderboard, resolve=True)
            overrides = OverridesParser.create().parse_overrides([*arguments])
            several = {one.key_or_group for one in overrides if one.is_sweep_override()}
            return Leaderboard(board_of(asked, self._methods(), keys_of(arguments), several))
        if self.knobs is not None:
            from heatsplat.studies.knobs import Knobs

            return Knobs(self._numbers, self.knobs["factors"])
        from heatsplat.studies.rows import Rows

        chosen = OmegaConf.select(self.config, "hydra.runtime.choices.method")
        return Rows(self.rows or {}, self.paper, self.of, chosen)

    def _numbers(self, job: Sequence[str]) -> Mapping[str, Any]:
        """The numbers of a job that the knobs are. Raises SceneError for none."""
        from heatsplat.studies.knobs import numbers_of

        with composed(self.hydra_context, self.config, 0, job) as config:
            own = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
            written, settings = (OmegaConf.to_container(own, resolve=resolve) for resolve in (False, True))
        return numbers_of(written, settings, self.knobs["of"])

    def _table(self, given: set[str]) -> SweepPlan:
        """The plan of a published table."""
        from heatsplat.studies.published.reproduction import reproduction_of
        from heatsplat.studies.published.table import Table

        asked = OmegaConf.to_container(self.config.table)
        metrics = self.config.callbacks.get("metrics") or {}
        rows = self._ablation(asked["ablation"])
        reproduction = reproduction_of(asked, self.config.data.root, self._methods(), rows, given)
        return Table(reproduction, asked["dry"], metrics.get("lpips_net"), metrics.get("lpips_weights"))

    def _methods(self) -> list[str]:
        """Options of conf/method."""
        return self.hydra_context.config_loader.get_group_options("method")

    def _ablation(self, name: str | None) -> Mapping[str, Mapping[str, Any]]:
        """Rows of a ready-made ablation (conf/ablation); none without a name."""
        if name is None:
            return {}
        loader = self.hydra_context.config_loader
        loaded = loader.load_configuration("train", [f"ablation={name}", "method=3dgs"], RunMode.MULTIRUN)
        return OmegaConf.to_container(loaded.hydra.sweeper.rows)
