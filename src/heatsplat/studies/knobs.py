"""A sweep over every number of a recipe, one at a time: what half of it and twice of it are worth, and what they cost."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from heatsplat.contracts import SceneError
from heatsplat.io.pictures import literal
from heatsplat.io.settings import at, walk
from heatsplat.studies.finished import Runs, seeds_of
from heatsplat.studies.options import listed
from heatsplat.studies.sweep_plan import FolderOf, Overrides, SweepPlan
from heatsplat.studies.sweeps import collect, write_sweep

DEFAULT = "default"  # name of the row in which nothing is changed

# Settings that are null where the thermal model has a number of its own, and the attribute that has it.
OF_THE_MODEL = {"init.opacity": "start_opacity", "optim.averaged": "averaged"}

DIGITS = 4  # of a number in an override and in the name of its row

Number = int | float | list[int | float]


@dataclass(frozen=True)
class Knobs(SweepPlan):
    """A recipe as it is, then with each of its numbers changed alone, and one table of all.

    Args:
        numbers: those of a job, from its overrides: setting -> number (``numbers_of``).
        factors: by which each is multiplied (``scaled``).
    """

    numbers: Callable[[Overrides], Mapping[str, Number]]
    factors: Sequence[float]

    def __post_init__(self) -> None:
        """Raises SceneError for factors that change nothing or turn a sign."""
        if not listed(self.factors) or not all(_is_number(x) and 0 < x != 1 for x in listed(self.factors)):
            raise SceneError(
                f"hydra.sweeper.knobs.factors={self.factors}: give numbers above 0 other than 1, such as [0.5,2]"
            )

    def jobs(self, grid: Sequence[Overrides], folder_of: FolderOf) -> tuple[list[Overrides], int]:
        """Each combination of the grid as it is, then with one number changed. Raises SceneError where ``numbers`` does."""
        return [[*job, *row] for job in grid for row in self._rows(self.numbers(job))], 0

    def _rows(self, numbers: Mapping[str, Number]) -> list[list[str]]:
        changed = [(key, x, spelled(scaled(value, x))) for key, value in numbers.items() for x in listed(self.factors)]
        rows = [
            [f"{key}={text}", f"row='{key} {text} (x{x:g})'"]
            for key, x, text in changed
            if text != spelled(numbers[key])
        ]
        return [[f"row={DEFAULT}"], *rows]

    def write(self, folder: Path) -> list[Path]:
        """The table, the number that matters most on top, and a picture of what each is worth and costs."""
        rows = collect(folder)
        most = dict.fromkeys((knob(row.name) for row in rows), 0.0)
        for row in rows:
            most[knob(row.name)] = max(most[knob(row.name)], abs(beside_default(row, rows, "psnr") or 0))
        names = dict.fromkeys(row.name for row in rows)
        return write_sweep(folder, sorted(names, key=lambda name: (name != DEFAULT, -most[knob(name)])), draw=picture)


# Numbers of a recipe -------------------------------------------------------------------------------------------------


def numbers_of(written: Mapping[str, Any], settings: Mapping[str, Any], of: str | Sequence[str]) -> dict[str, Number]:
    """The numbers of a recipe: dotted key -> number, or list of numbers.

    Without those that are 0 or not finite, and without those that follow another setting, such as ``${max_steps}``: they would
    be the same knob twice. What is null as the thermal model has a number of its own is this number.

    Args:
        written: its settings as they are written.
        settings: the same, with their interpolations resolved.
        of: settings whose numbers are asked for, with all that is below them; those that the recipe does not have count as empty.

    Raises:
        SceneError: there is no number.
    """
    keys = [
        key for section in listed(of) for key, value in walk({section: at(written, section)}) if not _follows(value)
    ]
    known = {key: at(settings, key) for key in keys} | _of_the_model(settings)
    numbers = {key: known[key] for key in keys if _is_number(known[key])}
    if not numbers:
        raise SceneError(f"hydra.sweeper.knobs.of=[{','.join(listed(of))}]: the recipe has no numbers there")
    return numbers


def _of_the_model(settings: Mapping[str, Any]) -> dict[str, Number]:
    """Numbers that the thermal model has for settings that are null."""
    null = [key for key in OF_THE_MODEL if at(settings, key) is None]
    target = at(settings, "thermal._target_")
    if not null or target is None:
        return {}
    module, _, name = target.rpartition(".")
    model = getattr(import_module(module), name)
    return {key: getattr(model, OF_THE_MODEL[key]) for key in null}


def _follows(written: Any) -> bool:
    return isinstance(written, str) and re.fullmatch(r"\$\{[\w.]+\}", written) is not None


def _is_number(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(_is_number(one) for one in value)
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value != 0


def scaled(value: Number, factor: float) -> Number:
    """The number times the factor; one from 0.5 to 1 has its odds p / (1 - p) multiplied, so 0.999 becomes 0.9995 or 0.998.

    Integers stay such and do not become 0; of a list each number is changed.
    """
    if isinstance(value, list):
        return [scaled(one, factor) for one in value]
    if isinstance(value, int):
        return round(value * factor) or int(math.copysign(1, value))
    if 0.5 <= value < 1:
        return factor * value / (1 - value + factor * value)
    return value * factor


def spelled(value: Number) -> str:
    """The number as an override has it, four digits of it; of one near 1 as many as tell what it lacks to a hundredth."""
    if isinstance(value, list):
        return f"[{','.join(map(spelled, value))}]"
    if isinstance(value, int):
        return str(value)
    texts = (f"{value:.{digits}g}" for digits in range(DIGITS, 17))
    near_one = 0.5 <= value < 1
    return next((text for text in texts if not near_one or abs(value - float(text)) <= 0.01 * (1 - value)), repr(value))


def knob(name: str) -> str:
    """The setting that a row changes, such as "optim.means" of "optim.means 8e-05"."""
    return name.partition(" ")[0]


def factor_of(name: str) -> float | None:
    """By what it is multiplied, such as 0.5 of "optim.means 8e-05 (x0.5)"; None of a row that changes no number."""
    found = re.search(r" \(x([\d.e+-]+)\)$", name)
    return float(found[1]) if found else None


# What they are worth -------------------------------------------------------------------------------------------------


def default_of(row: Runs, rows: Sequence[Runs]) -> Runs | None:
    """The row in which nothing is changed, on the same scene and with the same other settings; None where there is none."""
    return next((r for r in rows if r.name == DEFAULT and (r.scene, r.other) == (row.scene, row.other)), None)


def beside_default(row: Runs, rows: Sequence[Runs], name: str) -> float | None:
    """A score or cost of the row less that of the default, mean over the seeds that both have; None without any."""
    default = default_of(row, rows)
    if default is None:
        return None
    own, its = _by_seed(row, name), _by_seed(default, name)
    both = [own[seed] - its[seed] for seed in own if seed in its]
    return statistics.fmean(both) if both else None


def _by_seed(row: Runs, name: str) -> dict[tuple[str, ...], float]:
    if name not in row.table:
        return {}
    known = row.table[row.table[name].notna()]
    return {seeds_of(run["overrides"], run["results"]): run[name] for _, run in known.iterrows()}


def picture(rows: Sequence[Runs]) -> Figure | None:
    """What each knob gains, and beside it what it costs: blue for less of it, red for more, larger for further away.

    The grey band is the spread of the default over its seeds. A pair of panels for each scene, and for each other setting. Rows
    that change no number, such as those of another sweep in the same folder, are left out; None where no default has a result.
    """
    rows = [row for row in rows if row.name == DEFAULT or factor_of(row.name) is not None]
    defaults = [row for row in rows if row.name == DEFAULT and row.mean("psnr") is not None]
    if not defaults:
        return None
    names = [*dict.fromkeys(knob(row.name) for row in rows if row.name != DEFAULT)]
    figure = Figure(figsize=(9.5 * len(defaults), 1.6 + 0.2 * len(names)), dpi=110, layout="constrained")
    panels = figure.subplots(1, 2 * len(defaults), squeeze=False, sharey=True)[0]
    for default, gains, costs in zip(defaults, panels[::2], panels[1::2], strict=True):
        seconds = default.mean("train_seconds") or math.nan
        spreads = (default.spread("psnr") or 0, 100 * (default.spread("train_seconds") or 0) / seconds)
        for axes, spread in zip((gains, costs), spreads, strict=True):
            axes.axvspan(-spread, spread, color="0.85")
        for row in rows:
            if row is default or default_of(row, rows) is not default:
                continue
            factor, y = factor_of(row.name), names.index(knob(row.name))
            mark, color = (">", "C3") if factor > 1 else ("<", "C0")
            size = 3 + 2 * abs(math.log2(factor))
            gain, slower = (beside_default(row, rows, name) for name in ("psnr", "train_seconds"))
            for axes, x in ((gains, gain), (costs, None if slower is None else 100 * slower / seconds)):
                axes.plot(math.nan if x is None else x, y, mark, color=color, markersize=size)
        gains.set(xlabel="PSNR above the default's (dB)", title=literal(default.scene))
        costs.set(xlabel="seconds above the default's (%)", title=literal(default.other))
    panels[0].set_yticks(range(len(names)), [literal(name) for name in names], fontsize=7)
    panels[0].invert_yaxis()
    for axes in panels:
        axes.grid(alpha=0.25)
    return figure
