"""What the runs of a leaderboard and the submissions of others came to, and their ranks, with ties."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import re
import statistics
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, counted
from heatsplat.io.command_lines import as_dict
from heatsplat.io.files import read_json_object, write_atomically
from heatsplat.io.recorded import OVERRIDES, told_of
from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.finished import ran_on, reason_of
from heatsplat.studies.leaderboard.earlier import EarlierSeeds, Place, add_earlier, sentence
from heatsplat.studies.leaderboard.plan import Board
from heatsplat.studies.score import COSTS, META, SCENES, TRUTH, SceneScore, score_scene

log = logging.getLogger("heatsplat")

SCORE_FILE, SUBMISSION = "score.json", "submission"
WIDTH = 2.0  # standard errors of a difference below which two methods are tied
PRIOR = 2.0  # degrees of freedom of a scene's usual spread: two seeds alike by chance are no certainty


@dataclass(frozen=True)
class Result:
    """What a run came to.

    Args:
        seed: of the run.
        score: of its renders.
        cost: seconds, memory_mb, gaussians and steps, where known.
        folder: where it lies.
        command: what it was run with.
        on: the machine and threads that its seconds are of, where they are told.
        handed_in: whether it is a submission's, whose seconds are of a machine of its own.
    """

    seed: int
    score: SceneScore
    cost: Mapping[str, float]
    folder: Path
    command: str
    on: str = ""
    handed_in: bool = False


@dataclass
class Entry:
    """A method on a scene in a track: the runs of its seeds.

    Args:
        method, scene, track: what it is.
        runs: those that have results, each of a seed of its own.
        earlier: what an earlier page says of other seeds, which counts beside the runs.
        reason: why there are none.
        failed: seed -> why its run has no results.
        rank: best and worst rank that the seeds allow, in its scene and track; None without results.
    """

    method: str
    scene: str
    track: str
    runs: list[Result] = field(default_factory=list)
    earlier: EarlierSeeds = field(default_factory=EarlierSeeds)
    reason: str = "not run yet"
    failed: dict[int, str] = field(default_factory=dict)
    rank: tuple[int, int] | None = None

    @property
    def place(self) -> Place:
        """Method, scene and track."""
        return self.method, self.scene, self.track

    @property
    def all_numbers(self) -> list[int]:
        """Seeds of all results, those of an earlier page first."""
        return [*self.earlier.numbers, *(run.seed for run in self.runs)]

    @property
    def seeds(self) -> int:
        """How many seeds have results."""
        return len(self.all_numbers)

    @property
    def lost(self) -> str:
        """Why seeds beside those with results have none; empty where there are no such."""
        lost = sorted((seed, why) for seed, why in self.failed.items() if seed not in self.all_numbers)
        return "; ".join(f"seed {seed}: {why}" for seed, why in lost) if self.seeds else ""

    @property
    def parts(self) -> list[str]:
        """What views are held out by; empty without results."""
        return list(dict.fromkeys((*self.earlier.parts, *(part for run in self.runs for part in run.score.parts))))

    @property
    def command(self) -> str:
        """What the first seed was run with."""
        return self.earlier.command if self.earlier.numbers else self.runs[0].command

    def join(self, earlier: EarlierSeeds) -> None:
        """Adds what an earlier page says, unless there are runs of all its seeds; runs of some of them then do not count."""
        if not set(earlier.numbers) <= {run.seed for run in self.runs}:
            self.earlier, self.runs = earlier, [run for run in self.runs if run.seed not in earlier.numbers]

    def scale_seconds(self, factor: float) -> None:
        """Makes the seconds of the runs those of another machine; submissions keep theirs."""
        for k, run in enumerate(self.runs):
            if run.cost.get("seconds") is not None and not run.handed_in:
                self.runs[k] = replace(run, cost={**run.cost, "seconds": run.cost["seconds"] * factor})

    def values(self, score: str, part: str | None = None) -> list[float]:
        """A score of each run; all views, or those of a part."""
        found = (run.score.mean(score, part) for run in self.runs)
        return [value for value in found if value is not None and math.isfinite(value)]

    def mean(self, score: str, part: str | None = None) -> float | None:
        """Mean over the seeds; of a part, earlier pages have the score that ranks alone."""
        earlier = self.earlier.scores.get(score) if part is None else self.earlier.parts.get(part)
        return self._mean(self.values(score, part), earlier)

    def deviation(self, score: str) -> float | None:
        """Standard deviation over the seeds of the score that ranks; None for one seed."""
        values, count = self.values(score), len(self.earlier.numbers)
        if count + len(values) < 2:
            return None
        if not count:
            return statistics.stdev(values)
        mean = self.mean(score)
        squares = (count - 1) * (self.earlier.spread or 0.0) ** 2 + count * (self.earlier.scores[score] - mean) ** 2
        return math.sqrt((squares + sum((value - mean) ** 2 for value in values)) / (count + len(values) - 1))

    def cost(self, name: str) -> float | None:
        """Mean of a cost over the seeds that tell it."""
        values = [run.cost[name] for run in self.runs if run.cost.get(name) is not None]
        return self._mean(values, self.earlier.cost.get(name))

    def _mean(self, values: Sequence[float], earlier: float | None) -> float | None:
        """Mean of a number of each run and of that which an earlier page tells of its seeds."""
        every = [*values, *([earlier] * len(self.earlier.numbers) if earlier is not None else ())]
        return statistics.fmean(every) if every else None


@dataclass(frozen=True)
class Standings:
    """What a board came to.

    Args:
        entries: in the order of its scenes and methods, submissions last; ranked within scene and track.
        note: what was taken from an earlier page, and the machines that seconds are of.
    """

    entries: list[Entry]
    note: str = ""


def standings(folder: Path, board: Board) -> Standings:
    """What the runs in a folder, the submissions and an earlier page came to."""
    places = {(run.method, run.scene, run.track): run for run in _entries(board)}
    for path in sorted(folder.glob(f"*/{OVERRIDES}")):
        _add_run(places, path.parents[1], board)
    _add_submissions(places, board)
    note = ""
    if board.earlier is not None:
        for place, seeds in board.earlier.seeds.items():
            if seeds.handed_in and place[1] in board.scenes and place[2] in board.tracks:
                places.setdefault(place, Entry(*place))
        note = sentence(add_earlier(places, board.earlier))
    entries = list(places.values())
    for ranked, usual in _competitions(entries, board):
        means = [one.mean(board.score) for one in ranked]
        errors = [standard_error(one, board.score, usual) for one in ranked]
        for entry, rank in zip(ranked, ranks(means, errors, board.higher), strict=True):
            entry.rank = rank
    return Standings(entries, " ".join(filter(None, [note, _measured_on(entries)])))


def _competitions(entries: Sequence[Entry], board: Board) -> Iterator[tuple[list[Entry], float | None]]:
    """The entries with results of each scene and track, and by what their seeds usually vary: as on all scenes where no entry
    of this one has several."""
    everywhere = usual_spread(entries, board.score)
    for place in dict.fromkeys((entry.scene, entry.track) for entry in entries):
        own = [one for one in entries if (one.scene, one.track) == place and one.mean(board.score) is not None]
        usual = usual_spread(own, board.score)
        yield own, everywhere if usual is None else usual


def _entries(board: Board) -> list[Entry]:
    return [
        Entry(method, scene, track, reason=board.left_out(method, scene) or "not run yet")
        for track in board.tracks
        for scene in board.scenes
        for method in board.methods
    ]


def _add_submissions(places: dict[Place, Entry], board: Board) -> None:
    """Adds what was handed in; what has no seed takes the first number that is left, and a seed that is there is not replaced."""
    for submission in sorted(board.submissions, key=lambda one: one.seed is None):
        for scene in board.scenes:
            if scene not in submission.scores:
                continue
            key, score = (submission.method, scene, submission.track), submission.scores[scene]
            entry = places.setdefault(key, Entry(*key))
            taken = entry.all_numbers
            seed = next(n for n in count() if n not in taken) if submission.seed is None else submission.seed
            if seed not in taken:
                told = (score, score.cost, submission.folder, submission.command, submission.machine)
                entry.runs.append(Result(seed, *told, handed_in=True))


def _measured_on(entries: Sequence[Entry]) -> str:
    """A sentence on the machines that seconds are of; empty where none is known."""
    machines = Counter(run.on for entry in entries for run in entry.runs if run.on)
    told = "; ".join(f"{machine} ({counted(runs, 'run')})" for machine, runs in sorted(machines.items()))
    return f"Measured on {told}." if told else ""


def _add_run(places: Mapping[Place, Entry], folder: Path, board: Board) -> None:
    """Adds what is in the folder of a run to its entry; runs of what the board does not ask for, or of a seed that the entry
    has, are passed over, those that cannot be read with a word."""
    try:
        told = told_of(folder)
    except (ValueError, OSError) as error:
        log.warning("%s. Delete the folder to run it again.", error)
        return
    overrides = as_dict(told)
    scene = overrides.get("data.scene", "").strip("'")  # in quotes where Hydra would not take its name as it stands
    key = (overrides.get("method", ""), scene, overrides.get("leaderboard.track", ""))
    entry = places.get(key)
    if entry is None:
        return
    seed = int(overrides.get("seed", 0))
    if seed not in board.seeds or seed in entry.all_numbers:
        return
    try:
        entry.runs.append(_result(folder, seed, told, entry, board))
    except (ValueError, OSError) as error:
        entry.failed[seed] = entry.reason = str(error)


def _result(folder: Path, seed: int, told: Sequence[str], entry: Entry, board: Board) -> Result:
    """What a run came to. Raises SceneError, ValueError or OSError where it counts for nothing, with the reason."""
    if not (folder / METRICS_FILE).exists():
        raise SceneError(re.sub(r"^[\w.]+Error: ", "", reason_of(folder)))
    if lacking := [text for text in board.protocol["tracks"][entry.track] if text not in told]:
        raise SceneError(
            f"{folder.name} was trained without {' '.join(lacking)} of the track {entry.track}; give another hydra.sweep.dir, or "
            "delete the folder to run it again"
        )
    try:
        results = RunResults.read(folder / METRICS_FILE)
    except ValueError as error:
        raise SceneError(f"{error}. Delete the folder to run it again.") from error
    score = scored_once(folder, entry.scene, board)
    cost = {
        "seconds": results.cost.get(board.clock),
        "memory_mb": results.cost.get("peak_memory_mb"),
        "gaussians": results.cost.get("gaussians"),
        "steps": results.run.get("steps"),
    }
    command = " ".join(f"{name}={value}" for name, value in as_dict(told).items() if not _of_the_board(name))
    return Result(seed, score, cost, folder, command, ran_on(results))


def _of_the_board(name: str) -> bool:
    """Whether an override says how a board is filled, or where its scenes lie on one machine, and not how a method trains."""
    return name in ("row", "experiment", "data.root") or name.startswith("leaderboard.")


def scored_once(folder: Path, scene: str, board: Board) -> SceneScore:
    """The score of the renders of a run, which is written beside them and taken from there the next time, unless the run was made
    anew since, or the scene with other settings (``meta.json``)."""
    path, metrics = folder / SCORE_FILE, folder / METRICS_FILE
    made = hashlib.sha256((board.root / SCENES / scene / META).read_bytes()).hexdigest()
    known = read_json_object(path) or {}
    is_new = path.exists() and path.stat().st_mtime >= metrics.stat().st_mtime
    if is_new and known.get("scores") == board.scores and known.get("scene", made) == made:
        return SceneScore(known["views"])
    score = score_scene(folder / SUBMISSION, board.root / SCENES / scene, board.root / TRUTH / scene, board.scores)
    write_atomically(path, json.dumps({"scores": board.scores, "scene": made, "views": score.views}))
    return score


# Ranks ---------------------------------------------------------------------------------------------------------------


def usual_spread(entries: Sequence[Entry], score: str) -> float | None:
    """Standard deviation over seeds as a share of the mean, pooled over all that have several; None for none."""
    known = [(one.deviation(score), one.mean(score), one.seeds - 1) for one in entries]
    shares = [(deviation / mean, free) for deviation, mean, free in known if deviation is not None and mean > 0]
    freedom = sum(free for _, free in shares)
    return math.sqrt(sum(free * share**2 for share, free in shares) / freedom) if shares else None


def spread_of(entries: Sequence[Entry], board: Board) -> str:
    """A sentence on how far seeds vary, and what of it decides ties."""
    found = [usual for own, usual in _competitions(entries, board) if own and usual is not None]
    if not found:
        return "All methods ran with one seed, so the spread is unknown and ranks follow the means."
    low, high = (f"{100 * share:.1f}" for share in (min(found), max(found)))
    varied = f"{low} %" if low == high else f"{low} to {high} %, depending on the scene"
    return (
        f"Seeds vary by {varied} (standard deviation, pooled over methods). A method's own spread is weighed with that; "
        "one seed has that."
    )


def standard_error(entry: Entry, score: str, usual: float | None) -> float:
    """Of the mean over seeds, from their variance and the usual one by the degrees of freedom of each (``PRIOR``).

    Args:
        entry: with results.
        score: of which.
        usual: spread of its scene as a share of the mean; None where nothing is known, and then one seed has none.
    """
    own, free = entry.deviation(score) or 0.0, entry.seeds - 1
    prior = 0.0 if usual is None else PRIOR
    squares = free * own**2 + prior * ((usual or 0.0) * entry.mean(score)) ** 2
    return math.sqrt(squares / max(free + prior, 1) / entry.seeds)


def ranks(means: Sequence[float], errors: Sequence[float], higher: bool = False) -> list[tuple[int, int]]:
    """Best and worst rank of each: those that are not told apart from it by the seeds may stand before or behind it.

    Two are told apart where their means differ by more than two standard errors of the difference.

    Args:
        means, errors: of each method, a score over its seeds and its standard error.
        higher: whether more is better.
    """
    found = []
    for i, mean in enumerate(means):
        apart = [
            (other - mean) * (-1 if higher else 1)
            for j, other in enumerate(means)
            if j != i and abs(other - mean) > WIDTH * math.hypot(errors[i], errors[j])
        ]
        better, worse = sum(gap < 0 for gap in apart), sum(gap > 0 for gap in apart)
        found.append((1 + better, len(means) - worse))
    return found


def beside_reference(entries: Sequence[Entry], board: Board) -> dict[tuple[str, str], tuple[float, int]]:
    """(method, track) -> its score beside the reference's, over the scenes that both ran on, and their number; a method without
    such a scene is left out.

    Of errors that is the geometric mean of the ratios, those below ``least_error`` taken for that; of a score of which more is
    better, the mean of the differences.
    """
    found: dict[tuple[str, str], list[float]] = {}
    least = least_error(board)
    for scene, track in dict.fromkeys((entry.scene, entry.track) for entry in entries):
        means = {e.method: e.mean(board.score) for e in entries if (e.scene, e.track) == (scene, track)}
        own = {method: mean for method, mean in means.items() if mean is not None}
        for method, mean in own.items():
            if board.reference in own:
                reference = own[board.reference]
                beside = mean - reference if board.higher else math.log(max(mean, least) / max(reference, least))
                found.setdefault((method, track), []).append(beside)
    means = {key: (statistics.fmean(values), len(values)) for key, values in found.items()}
    return means if board.higher else {key: (math.exp(mean), count) for key, (mean, count) in means.items()}


def least_error(board: Board) -> float:
    """What errors below it count as in ratios, half of the last digit that tables show: one of zero, as of renders that are the
    truth, would hide all other scenes of its method, or of all methods where it is the reference's."""
    return 0.5 * 10.0 ** -DEFINITIONS[board.score].digits


def least_told(entries: Sequence[Entry], board: Board) -> str:
    """A clause on that, where some error is below it; else nothing."""
    least, unit = least_error(board), DEFINITIONS[board.score].unit
    means = (entry.mean(board.score) for entry in entries)
    small = not board.higher and any(mean is not None and mean < least for mean in means)
    return f"; errors below {least:g}{f' {unit}' if unit else ''} count as that" if small else ""


def mean_costs(entries: Sequence[Entry | None]) -> dict[str, float | None]:
    """Seconds, memory_mb and gaussians in the mean over those of a method's scenes where they are known; None for none."""
    found = {}
    for name in COSTS:
        known = [cost for one in entries if one and (cost := one.cost(name)) is not None]
        found[name] = statistics.fmean(known) if known else None
    return found


def summary(entries: Sequence[Entry], board: Board) -> dict[str, Any]:
    """What the whole table cost and how much of it there is."""
    seconds = [entry.seeds * entry.cost("seconds") for entry in entries if entry.seeds and entry.cost("seconds")]
    return {
        "runs": sum(entry.seeds for entry in entries),
        "filled": sum(entry.seeds > 0 for entry in entries),
        "entries": len(entries),
        "hours": sum(seconds) / 3600.0,
        "clock": board.clock,
    }
