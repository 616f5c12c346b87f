"""A sweep over the named rows of an ablation, or over a grid alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import as_dict
from heatsplat.studies.options import listed
from heatsplat.studies.published.figures import quoted
from heatsplat.studies.sweep_plan import FolderOf, Overrides, SweepPlan
from heatsplat.studies.sweeps import write_sweep

KEYS = {"set", "printed"}  # of a row


@dataclass(frozen=True)
class Rows(SweepPlan):
    """Every row with every combination of the grid, and one table of all.

    Args:
        rows: name of a row -> {"set": overrides of the row, "printed": its setting in the paper's table}; empty for a grid alone.
        paper: the paper's table that the rows are beside: {"of": paper, "table": label, "scenes": whose figures}; None without.
        of: the method whose parts the rows are, or several; another is refused. None for any.
        method: of jobs that name none.
    """

    rows: Mapping[str, Mapping[str, Any] | None] = field(default_factory=dict)
    paper: Mapping[str, Any] | None = None
    of: str | Sequence[str] | None = None
    method: str | None = None

    def __post_init__(self) -> None:
        """Raises SceneError for rows that are none, or say what nothing reads: they would be called what they are not."""
        if not isinstance(self.rows, Mapping):
            raise SceneError(
                f"hydra.sweeper.rows={self.rows}: give rows by name, such as {{full:{{set:[]}},short:{{set:['max_steps=500']}}}}"
            )
        for name, row in self.rows.items():
            if not isinstance(row, Mapping | None) or {*(row or ())} - KEYS:
                raise SceneError(
                    f"hydra.sweeper.rows: a row has set (overrides) and printed, nothing else; {name} is {row}"
                )

    def jobs(self, grid: Sequence[Overrides], folder_of: FolderOf) -> tuple[list[Overrides], int]:
        """All rows come with one combination of the grid before the next. Raises SceneError for parts of another method."""
        if not self.rows:
            return list(grid), 0
        self._check_methods(grid)
        named = {str(name).replace("'", "\\'"): listed((row or {}).get("set")) for name, row in self.rows.items()}
        return [[*job, *own, f"row='{name}'"] for job in grid for name, own in named.items()], 0

    def _check_methods(self, grid: Sequence[Overrides]) -> None:
        """Raises SceneError where the rows would not be what they are called, for they are parts of another method."""
        if not (methods := listed(self.of)):
            return
        asked = {as_dict(job).get("method", self.method).strip("'\"") for job in grid}
        if others := sorted(asked - {*methods}):
            raise SceneError(
                f"the rows of this ablation are parts of method={' or '.join(methods)}, not of method={', '.join(others)}: leave "
                "method out, or choose an ablation of that method"
            )

    def write(self, folder: Path) -> list[Path]:
        """The table, for people and programs, and its picture."""
        return write_sweep(folder, [str(name) for name in self.rows], self._printed())

    def _printed(self) -> dict[str, dict[str, str]]:
        """What the paper prints for the rows: name of row -> score or cost -> text."""
        if self.paper is None:
            return {}
        of, table, scenes = (self.paper[key] for key in ("of", "table", "scenes"))
        settings = {str(name): row["printed"] for name, row in self.rows.items() if row and "printed" in row}
        return {name: quoted(of, table, setting, scenes) for name, setting in settings.items()}
