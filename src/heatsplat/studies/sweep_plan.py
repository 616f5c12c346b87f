"""What a sweep runs and what it leaves: rows of a table, a published table, or a leaderboard, one file each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

Overrides = Sequence[str]  # of a job
FolderOf = Callable[[int, Overrides], Path]  # number and overrides of a job -> where its results will be


class SweepPlan(ABC):
    """What a sweep runs, and what it writes when the last job has ended.

    Attributes:
        alike: beginnings of overrides in which jobs may differ and still be composed alike.
    """

    alike: ClassVar[tuple[str, ...]] = ("seed=",)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to run."""
        return False

    def summary(self) -> str:
        """What is told before anything runs; empty for nothing."""
        return ""

    @abstractmethod
    def jobs(self, grid: Sequence[Overrides], folder_of: FolderOf) -> tuple[list[Overrides], int]:
        """The jobs, and how many of the first are to end before any other starts.

        Args:
            grid: combinations of what the command line says.
            folder_of: says where a job's results will be.

        Raises:
            SceneError: the command line asks for what the plan is not of.
        """

    def to_compose(self, jobs: Sequence[Overrides]) -> Sequence[Overrides]:
        """Those of the jobs whose configurations show whether those of all can be composed: one of those that are ``alike``."""
        first: dict[tuple[str, ...], Overrides] = {}
        for job in jobs:
            first.setdefault(tuple(text for text in job if not text.startswith(self.alike)), job)
        return list(first.values())

    @abstractmethod
    def write(self, folder: Path) -> list[Path]:
        """Writes what the jobs in a sweep's folder found; paths of the files."""
