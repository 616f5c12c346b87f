"""A sweep that fills the leaderboard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from heatsplat.studies.leaderboard.plan import Board
from heatsplat.studies.leaderboard.report import write_leaderboard
from heatsplat.studies.sweep_plan import FolderOf, Overrides, SweepPlan


@dataclass(frozen=True)
class Leaderboard(SweepPlan):
    """The runs of a board.

    Args:
        board: what is asked for.
    """

    board: Board
    alike: ClassVar[tuple[str, ...]] = ("data.scene=", "seed=", "callbacks.temperatures.image=")

    @property
    def idle(self) -> bool:
        return not self.board.jobs()

    def summary(self) -> str:
        return self.board.summary()

    def jobs(self, grid: Sequence[Overrides], folder_of: FolderOf) -> tuple[list[Overrides], int]:
        """All of the board with one combination of the grid before the next."""
        return [job for given in grid for job in self.board.jobs(given)], 0

    def write(self, folder: Path) -> list[Path]:
        """Table, CSV and page."""
        return write_leaderboard(folder, self.board)
