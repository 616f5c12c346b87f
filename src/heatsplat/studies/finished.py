"""Finished runs as one table, and the runs of one recipe as one of its parts; sweeps, fronts and comparisons are views of it."""

from __future__ import annotations

import logging
import re
import statistics
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from heatsplat.contracts import SceneError, counted
from heatsplat.io.recorded import CONFIG, OVERRIDES, config_of, overrides_of
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults

log = logging.getLogger(__name__)

# Columns of a table of runs that are no score; a score of this name, of a callback that is not ours, has none.
COLUMNS = {
    "folder", "scene", "method", "row", "overrides", "failed", "results", "data", "name", "other", "title", "measured", "course",
}  # fmt: skip
# Overrides that make no other recipe. runs.resume.NOT_LEARNED, and the keys that conf/train.yaml leaves out of the names of
# folders, are among them; the method is named by itself.
SEEDS = {"seed", "data.seed", "data.scene_seed"}
PLACES = {"data", "data.root", "data.scene", "data.scenes"}
NAMES = {"method", "row", "ablation", "experiment"}
HOW_IT_RUNS = {"threads", "ckpt", "test"}
NOT_A_ROW = SEEDS | PLACES | NAMES | HOW_IT_RUNS
# Groups with all that is below them. Those that say whose job a run was do not tell it from any other.
WHOSE_JOB = {"launcher", "hydra", "table", "leaderboard"}
NOT_WHAT_WAS_LEARNED = WHOSE_JOB | {"doctor", "trainer", "callbacks", "logger"}


@dataclass
class Runs:
    """The runs of one recipe on one scene.

    Args:
        name: of the recipe.
        scene: on which they ran.
        table: the rows of ``read_runs``; those without results too.
        other: settings that not all runs of this name have, such as "max_steps=3000"; empty where all agree.
    """

    name: str
    scene: str
    table: pd.DataFrame
    other: str = ""

    @property
    def label(self) -> str:
        """The name, with what tells the runs from others of its name."""
        return f"{self.name}, {self.other}" if self.other else self.name

    @property
    def count(self) -> int:
        """How many have results."""
        return int(self.table["failed"].isna().sum())

    @property
    def failed(self) -> list[str]:
        """Why the others have none."""
        return self.table["failed"].dropna().tolist()

    def values(self, name: str) -> list[float]:
        """A score or cost of the runs that have it."""
        return self.table[name].dropna().tolist() if name in self.table else []

    def mean(self, name: str) -> float | None:
        """Mean over the runs that have the value, None where none has."""
        values = self.values(name)
        return statistics.fmean(values) if values else None

    def spread(self, name: str) -> float | None:
        """Standard deviation over them (n - 1), None for fewer than two."""
        values = self.values(name)
        return statistics.stdev(values) if len(values) > 1 else None


def read_runs(folders: Iterable[Path | str] | Path | str) -> pd.DataFrame:
    """A row for each run, in the order of the folders; of a folder that is no run a row for each that lies below it. A run that
    is reached twice, as by a link to the latest, has one.

    Columns: folder, scene, method, row (of a sweep, "" for none), overrides (key -> value), failed (why there are no results,
    None where there are), results (None where there are none), data (the options of the data), then every score of the test
    views and every cost, NaN where a run has none.

    Raises:
        SceneError: a folder is none, or has no run in it.
    """
    places = [folders] if isinstance(folders, Path | str) else folders
    runs: dict[Path, Path] = {}
    for run in (run for place in places for run in _runs_in(Path(place))):
        runs.setdefault(run.resolve(), run)
    return pd.DataFrame([_read(run) for run in runs.values()])


def _runs_in(place: Path) -> list[Path]:
    if not place.is_dir():
        raise SceneError(f"there is no folder {place}")
    found = list(_runs_below(place, set()))
    if not found:
        raise SceneError(f"{place} holds no run, nor does any folder below it: a run has {METRICS_FILE} or {OVERRIDES}")
    return found


def _runs_below(place: Path, seen: set[Path]) -> Iterator[Path]:
    """The folder itself where it is one of a run; else those below it, but none within a run, such as of its evaluations.

    Links come last, and those to a folder that was seen, such as the one above, are passed over.
    """
    if (real := place.resolve()) in seen:
        return
    seen.add(real)
    if any((place / name).exists() for name in (METRICS_FILE, FAILED, OVERRIDES, CONFIG)):
        yield place
        return
    for inner in sorted(
        (path for path in place.iterdir() if path.is_dir()), key=lambda path: (path.is_symlink(), path)
    ):
        yield from _runs_below(inner, seen)


def _read(folder: Path) -> dict[str, Any]:
    overrides, config, results, failed = {}, {}, None, None
    try:
        overrides, config = overrides_of(folder), config_of(folder)
        if (folder / METRICS_FILE).exists():
            results = RunResults.read(folder / METRICS_FILE)
        else:
            failed = reason_of(folder)
    except (ValueError, OSError) as error:
        failed = f"{error}. Delete the folder to run it again."
    run = {} if results is None else results.run
    found = {
        "folder": folder, "scene": str(run.get("scene", _scene(config))),
        "method": str(run.get("method", overrides.get("method"))),
        "row": named_row(overrides), "overrides": overrides, "failed": failed, "results": results,
        "data": _data(config),
    }  # fmt: skip
    if results is None:
        return found
    return found | {name: value for name, value in (results.test | results.cost).items() if name not in COLUMNS}


def _scene(config: Mapping[str, Any]) -> str:
    """The scene that a run was given; a method's own synthetic preset is a reference to another key."""
    data = _data(config)
    scene = str(data.get("scene") or "+".join(data.get("scenes") or ()) or "?")
    return str(config.get(scene[2:-1], scene)) if scene.startswith("${") else scene


def _data(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The options of the data; none where the file ends before them."""
    data = config.get("data")
    return data if isinstance(data, Mapping) else {}


def reason_of(folder: Path) -> str:
    """Why a run has no result: the last line of its FAILED file that names an error, since Hydra adds lines of its own."""
    if not (folder / FAILED).exists():
        return "not finished"
    told = (folder / FAILED).read_text(encoding="utf-8", errors="replace")
    lines = [line.strip() for line in told.splitlines() if line.strip()]
    named = [line for line in lines if re.match(r"[\w.]*(Error|Exception)\b", line)]
    return (named or lines or ["failed"])[-1]


def each_seed_once(runs: pd.DataFrame, rows: Sequence[Hashable]) -> pd.DataFrame:
    """The runs without those that were trained more than once: of each row and seed the last that has results, else the last.

    Args:
        runs: of ``read_runs``.
        rows: of each the row that it is of, with its scene.
    """
    seeds = [
        seeds_of(run.overrides, run.results)
        if run.overrides or run.results
        else run.folder  # of which nothing is known
        for run in runs.itertuples()
    ]
    told = runs.assign(which=[*zip(rows, seeds, strict=True)], done=runs["failed"].isna())
    kept = told.sort_values("done", kind="stable").drop_duplicates("which", keep="last").index
    if twice := runs.loc[~runs.index.isin(kept), "folder"].tolist():
        log.warning("%d jobs were trained more than once; each counts once, without %s", len(twice), twice[0])
    return runs.loc[runs.index.isin(kept)].reset_index(drop=True)


def seeds_of(overrides: Mapping[str, str], results: RunResults | None) -> tuple[str, str, str]:
    """Of training, of the order of views and of a synthetic scene."""
    given = {key.lstrip("+~"): value.strip("'\"") for key, value in overrides.items()}
    seed = str(given.get("seed", "0") if results is None else results.run.get("seed", given.get("seed", "0")))
    return seed, given.get("data.seed", seed), given.get("data.scene_seed", "0")


def ran_on(results: RunResults) -> str:
    """The machine and the threads of a run, as far as it tells them."""
    machine, threads = results.run.get("machine"), results.run.get("threads")
    return ", ".join(filter(None, [machine, None if threads is None else counted(threads, "thread")]))


def clocks(places: Iterable[str]) -> str:
    """What is said of seconds of runs that ran on several machines or numbers of threads (``ran_on``); empty for one of each."""
    return _several("Seconds are of several machines or numbers of threads, and compare within one", places)


def versions(results: Iterable[RunResults]) -> str:
    """What is said of runs of several versions of heatsplat, as of a sweep that went on after an update; empty for one."""
    told = ([str(one.versions.get(key) or "") for key in ("heatsplat", "git_commit")] for one in results)
    texts = (f"{number} {commit[:8]}".strip() for number, commit in told)
    return _several("Runs are of several versions of heatsplat", texts)


def _several(what: str, told: Iterable[str]) -> str:
    """A sentence with each of the texts and how many runs tell it; empty where all that tell one tell the same."""
    runs = Counter(text for text in told if text)
    listed = "; ".join(f"{text} ({counted(count, 'run')})" for text, count in sorted(runs.items()))
    return f"{what}: {listed}." if len(runs) > 1 else ""


# Names ---------------------------------------------------------------------------------------------------------------


def row_names(jobs: Sequence[Mapping[str, str]], scenes: Sequence[str]) -> list[tuple[str, str]]:
    """For each job the name of its row, and the settings that not all jobs of a row of this name have ("" for none).

    A job without a named row is named by its method and by the settings that not all such jobs have. Jobs of a row that
    differ on a scene in more than their seeds have that in their name too (``told_apart``).

    Args:
        jobs: overrides of each: key -> value.
        scenes: on which each ran.
    """
    names = [named_row(overrides) for overrides in jobs]
    settings = [[*(_method(o) if name else []), *settings_of(o)] for o, name in zip(jobs, names, strict=True)]
    others = unshared(names, settings)
    rows = [
        (name or tuple(_method(o)), *own, scene)
        for o, name, own, scene in zip(jobs, names, others, scenes, strict=True)
    ]
    words = [" ".join([*own, *apart]) for own, apart in zip(others, told_apart(rows, jobs), strict=True)]
    return [
        (name, other) if name else (" ".join([*_method(overrides), other]).strip() or "run", "")
        for overrides, name, other in zip(jobs, names, words, strict=True)
    ]


def told_apart(names: Sequence[Hashable], jobs: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """For each job the settings that make no recipe, but in which jobs of its name differ beside their seeds.

    So a grid over data.root or callbacks is no mean over seeds. Where a job ran and how (``PLACES``, ``HOW_IT_RUNS``) tells it
    from those alone that say otherwise: one that went on (ckpt) is as good as one that did not have to.

    Args:
        names: of the jobs' rows, with their scenes.
        jobs: overrides of each.
    """

    def is_meant(key: str) -> bool:
        named = SEEDS | NAMES - {"experiment"}  # which sets what no override tells
        return not _makes_a_recipe(key) and key not in named and key.partition(".")[0] not in WHOSE_JOB

    left = [
        {name: f"{key}={value}" for key, value in sorted(own.items()) if is_meant(name := key.lstrip("+~"))}
        for own in jobs
    ]
    said = Counter(
        about
        for about, _ in {((row, key), text) for row, own in zip(names, left, strict=True) for key, text in own.items()}
    )
    return [
        [text for key, text in own.items() if text in apart and (key not in PLACES | HOW_IT_RUNS or said[row, key] > 1)]
        for row, own, apart in zip(names, left, unshared(names, [[*own.values()] for own in left]), strict=True)
    ]


def unshared(names: Sequence[Hashable], settings: Sequence[Sequence[str]]) -> list[list[str]]:
    """For each job those of its settings that not all jobs of its name have."""
    shared: dict[Hashable, set[str]] = {}
    for name, own in zip(names, settings, strict=True):
        shared[name] = shared.get(name, set(own)) & set(own)
    return [[text for text in own if text not in shared[name]] for name, own in zip(names, settings, strict=True)]


def named_row(overrides: Mapping[str, str]) -> str:
    """Name of the row that a job was given (``row=``), empty for none."""
    name = overrides.get("row", "").strip("'\"").replace("\\'", "'")
    return "" if name == "null" else name


def _method(overrides: Mapping[str, str]) -> list[str]:
    return [overrides["method"]] if "method" in overrides else []


def settings_of(overrides: Mapping[str, str]) -> list[str]:
    """Overrides that make a recipe besides its method: "key=value" in alphabetical order."""
    return sorted(f"{key}={value}" for key, value in overrides.items() if _makes_a_recipe(key.lstrip("+~")))


def _makes_a_recipe(key: str) -> bool:
    return key not in NOT_A_ROW and key.partition(".")[0] not in NOT_WHAT_WAS_LEARNED
