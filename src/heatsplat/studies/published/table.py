"""A sweep that fills a published table."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from heatsplat.contracts import SceneError
from heatsplat.studies.published.comparison import write_comparison
from heatsplat.studies.published.reproduction import Reproduction
from heatsplat.studies.sweep_plan import FolderOf, Overrides, SweepPlan
from heatsplat.studies.sweeps import write_sweep

log = logging.getLogger("heatsplat")


@dataclass(frozen=True)
class Table(SweepPlan):
    """The runs of a published table.

    Args:
        reproduction: the table and its runs.
        dry: nothing is run or written.
        lpips_net, lpips_weights: settings of the metrics callback, to say beforehand whether there will be LPIPS.

    Raises:
        SceneError: none of its scenes is on disk; the message says what is missing and where it is got.
    """

    reproduction: Reproduction
    dry: bool = False
    lpips_net: str | None = None
    lpips_weights: str | None = None

    def __post_init__(self) -> None:
        if self.reproduction.missing and not self.reproduction.runs:
            raise SceneError(self.summary())

    @property
    def idle(self) -> bool:
        return self.dry or not self.reproduction.runs

    def summary(self) -> str:
        return self.reproduction.summary(self.lpips_net, self.lpips_weights)

    def jobs(self, grid: Sequence[Overrides], folder_of: FolderOf) -> tuple[list[Overrides], int]:
        """Those that others come after stand at the beginning, once each."""
        first: dict[tuple[str, ...], Path] = {}
        jobs = []
        for given in grid:
            for run in self.reproduction.runs:
                after = []
                if run.after is not None:
                    before = tuple(run.after.job(given))
                    if before not in first:
                        first[before] = folder_of(len(first), before)
                    after = [f"table.after='{first[before]}/checkpoints/last.ckpt'"]
                jobs.append([*run.job(given), *after])
        return [*map(list, first), *jobs], len(first)

    def write(self, folder: Path) -> list[Path]:
        """The table of the runs, and that beside the paper's figures, which is logged, too."""
        if self.dry:
            return []
        runs_alone = write_sweep(folder)
        comparison = write_comparison(folder, self.reproduction)
        log.info("%s", comparison[0].read_text(encoding="utf-8"))
        return [*runs_alone, *comparison]
