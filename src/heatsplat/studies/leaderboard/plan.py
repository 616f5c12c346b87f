"""Which runs fill the leaderboard: methods x scenes x tracks x seeds of a protocol, and which combinations it leaves out."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, check_option
from heatsplat.io.command_lines import keys_of, setting
from heatsplat.io.results import METRICS_FILE
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.leaderboard.earlier import EarlierPage, read_page
from heatsplat.studies.options import listed, whole_numbers
from heatsplat.studies.score import META, SCENES, SceneScore, scenes_in, score_submission, scores_of
from heatsplat.training.clocks import CLOCKS

DECIDED = {
    "method": "methods",
    "data.scene": "scenes",
    "seed": "seeds",
}  # key of a run -> what chooses among its values


@dataclass(frozen=True)
class Submission:
    """Renders of other code and what they are worth.

    Args:
        folder: where they lie.
        method, track: what they are of.
        command: where the code is, in place of a command line.
        scores: scene -> its score.
        seed: of the run that made them; None where it is not told.
        machine: that its seconds are of; empty where it is not told.
    """

    folder: Path
    method: str
    track: str
    command: str
    scores: Mapping[str, SceneScore]
    seed: int | None = None
    machine: str = ""


@dataclass(frozen=True)
class Board:
    """What is asked for.

    Args:
        protocol: conf/protocol.
        root: folder of its scenes/ and truth/.
        methods, scenes, tracks, seeds: names, in the order of the table.
        clock: the cost that counts as seconds, of ``metrics.json``.
        submissions: renders of other code, which count beside.
        earlier: a leaderboard's page, whose entries stand where the folder has fewer seeds; None for none.
        document, page: where the table and the page go besides the folder of the sweep; None for nowhere.
        train: False to write what is there and run nothing.
        note: on the conditions of the runs, for the table and the page.
    """

    protocol: Mapping[str, Any]
    root: Path
    methods: Sequence[str]
    scenes: Sequence[str]
    tracks: Sequence[str]
    seeds: Sequence[int]
    clock: str = "train_seconds"
    submissions: Sequence[Submission] = ()
    earlier: EarlierPage | None = None
    document: Path | None = None
    page: Path | None = None
    train: bool = True
    note: str = ""

    @property
    def scores(self) -> list[str]:
        """Names of the scores that are told."""
        return list(self.protocol["scores"])

    @property
    def score(self) -> str:
        """The one that ranks, the first."""
        return self.scores[0]

    @property
    def higher(self) -> bool:
        """Whether more of it is better."""
        return DEFINITIONS[self.score].higher

    @property
    def reference(self) -> str:
        """The method beside which the others stand."""
        return self.protocol["reference"]

    @property
    def sizes(self) -> list[str]:
        """Sizes of the scenes, as they were written."""
        metas = (json.loads((self.root / SCENES / name / META).read_text(encoding="utf-8")) for name in self.scenes)
        return list(dict.fromkeys(str(meta.get("size") or "as recorded") for meta in metas))

    @property
    def settings(self) -> dict[str, str]:
        """Those that make each track."""
        return {track: " ".join(self.protocol["tracks"][track]) for track in self.tracks}

    def _overrides(self, track: str) -> list[str]:
        """Overrides that make a track: equal seconds are seconds of the board's clock."""
        told = list(self.protocol["tracks"][track])
        timed = self.clock != "train_seconds" and "budget" in keys_of(told)
        return [*told, f"budget_clock={self.clock}"] if timed else told

    def left_out(self, method: str, scene: str) -> str | None:
        """Why the protocol does not run a method on a scene; None where it does."""
        only = (self.protocol.get("only") or {}).get(method)
        return None if only is None or scene in only["scenes"] else only["why"]

    def image(self, method: str, scene: str) -> str:
        """Which image a method hands in of a scene: "clean" is the one before its sensor, "thermal" the one behind it."""
        if method in (self.protocol.get("recorded") or {}):
            return "thermal"
        return self.protocol["scenes"].get(scene, {}).get("hand_in", "thermal")

    def jobs(self, given: Sequence[str] = ()) -> list[list[str]]:
        """Overrides of every run, those of the command line first; all methods and scenes with one seed before the next."""
        if not self.train:
            return []
        own = self.protocol.get("overrides") or {}
        return [
            [
                f"method={method}",
                "data=benchmark",
                setting("data.root", self.root),
                setting("data.scene", scene),
                f"seed={seed}",
                *self._overrides(track),
                *own.get(method, ()),
                f"callbacks.temperatures.image={self.image(method, scene)}",
                f"leaderboard.track={track}",
                f"row='{method}'",
                *given,
            ]
            for seed in self.seeds
            for track in self.tracks
            for method in self.methods
            for scene in self.scenes
            if self.left_out(method, scene) is None
        ]

    def summary(self) -> str:
        """A sentence on what will run."""
        what = f"{len(self.methods)} methods x {len(self.scenes)} scenes x {len(self.tracks)} tracks x {len(self.seeds)} seeds"
        return f"{what}: {len(self.jobs())} runs; scenes in {self.root}"


def board_of(
    asked: Mapping[str, Any], known: Iterable[str], given: Collection[str] = (), several: Collection[str] = ()
) -> Board:
    """The board that a configuration asks for (conf/experiment/leaderboard.yaml).

    Submissions are scored here and the earlier page is read: what is wrong with them is told before anything runs.

    Args:
        asked: its section "leaderboard".
        known: options of conf/method.
        given: keys that the command line sets.
        several: those of them that it gives several values.

    Raises:
        SceneError: no folder of scenes, names that there are not, a key that the board decides, or several values of another; a
            submission is none, or has the name of a method, an unknown track or the seed of another; the page is not one of this
            board.
    """
    for key, instead in DECIDED.items():
        if key in given:
            raise SceneError(
                f"{key}=...: a leaderboard has several; choose among them with leaderboard.{instead}=[...]"
            )
    if several:
        raise SceneError(
            f"{', '.join(sorted(several))}: a leaderboard has one run of each method, scene, track and seed, so that of several "
            "values one would count; give one, and the others to leaderboards in other folders (lists in brackets: [a,b])"
        )
    protocol = asked["protocol"]
    if asked["root"] is None:
        raise SceneError(
            "give the folder of the protocol's scenes: leaderboard.root=FOLDER; python src/study.py study=scenes "
            "study.target=FOLDER writes them (docs/protocol.md)"
        )
    root = Path(asked["root"]).expanduser().absolute()
    there, known = scenes_in(root), sorted(known)
    ordered = [name for name in protocol["scenes"] if name in there]
    choices = {
        "methods": known,
        "scenes": [*ordered, *(name for name in there if name not in ordered)],
        "tracks": list(protocol["tracks"]),
    }
    chosen = {
        key: listed(asked[key]) or (protocol.get(key) if key == "methods" else None) or choices[key] for key in choices
    }
    for key, names in chosen.items():
        if unknown := [name for name in names if name not in choices[key]]:
            raise SceneError(
                f"leaderboard.{key}: there is no {', '.join(unknown)}; there are {', '.join(choices[key])}"
            )

    scores_of(protocol)
    check_option("leaderboard.clock", asked["clock"], CLOCKS, SceneError)
    seeds = whole_numbers("leaderboard.seeds", listed(asked["seeds"]) or protocol["seeds"], least=0)

    def path(text: str | None) -> Path | None:
        return None if text is None else Path(text).expanduser()

    board = Board(
        protocol, root, **chosen, seeds=seeds, clock=asked["clock"],
        document=path(asked["document"]), page=path(asked["page"]), train=asked["train"], note=asked["note"],
    )  # fmt: skip
    folders = {place.resolve(): place for place in map(path, listed(asked["submissions"]))}  # each once
    submissions = [_submission(folder, board, known) for folder in folders.values()]
    _check_seeds(submissions)
    earlier = path(asked["earlier"])
    page = None if earlier is None else read_page(earlier, board)
    names = [*known, *(one.method for one in submissions), *(method for method, _, _ in (page.seeds if page else ()))]
    check_option("the protocol's reference", protocol["reference"], dict.fromkeys(names), SceneError)
    return replace(board, submissions=submissions, earlier=page)


def _submission(folder: Path, board: Board, known: Collection[str]) -> Submission:
    """What a folder hands in. Raises SceneError as ``board_of`` does."""
    told, scores = score_submission(folder, board.root, board.scores)
    method, track, where = told["method"], told.get("track", board.tracks[0]), folder / METRICS_FILE
    if method in known:
        raise SceneError(
            f'{where}: "method" is {method}, a method of heatsplat; give the submission another name there'
        )
    if track not in board.tracks:
        raise SceneError(
            f'{where}: "track" is {track}; this board has {", ".join(board.tracks)}. Name one of them there, or leave the '
            "folder out of leaderboard.submissions"
        )
    words = {"command": str(told.get("code", "a submission")), "machine": str(told.get("machine") or "")}
    return Submission(folder, method, track, scores=scores, seed=told.get("seed"), **words)


def _check_seeds(submissions: Sequence[Submission]) -> None:
    """Raises SceneError where two folders hand in the same seed of a scene, of which one alone would count."""
    first: dict[tuple[str, str, str, int], Path] = {}
    for one in submissions:
        for scene in one.scores if one.seed is not None else ():
            other = first.setdefault((one.method, one.track, scene, one.seed), one.folder)
            if other != one.folder:
                raise SceneError(
                    f"{other} and {one.folder} both hand in seed {one.seed} of {one.method} on {scene}: give each run its own "
                    f'"seed" in its {METRICS_FILE}, or leave one of them out'
                )
