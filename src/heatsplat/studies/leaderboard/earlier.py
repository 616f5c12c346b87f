"""A leaderboard's page as the record of its runs: what stands on it goes on counting when their folders are gone."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heatsplat.contracts import SceneError

if TYPE_CHECKING:
    from heatsplat.studies.leaderboard.plan import Board
    from heatsplat.studies.leaderboard.standings import Entry

MARK = "const board = "  # before the JSON of a page

Place = tuple[str, str, str]  # method, scene and track


@dataclass(frozen=True)
class EarlierSeeds:
    """What a page says of the seeds of a method on a scene in a track; nothing without arguments.

    Args:
        numbers: the seeds.
        scores, cost: name -> mean over them.
        parts: what views are held out by -> mean of the score that ranks.
        spread: standard deviation of the score that ranks; None for one seed.
        command: what the first was run with, or where the code of a submission is.
    """

    numbers: Sequence[int] = ()
    scores: Mapping[str, float | None] = field(default_factory=dict)
    cost: Mapping[str, float | None] = field(default_factory=dict)
    parts: Mapping[str, float | None] = field(default_factory=dict)
    spread: float | None = None
    command: str = ""

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> EarlierSeeds:
        """Those of an entry of a page; pages that do not tell the seeds have the first ones."""
        numbers = entry.get("numbers", range(entry["seeds"]))
        names = ("scores", "cost", "parts", "spread", "command")
        return cls(list(numbers), **{name: entry[name] for name in names})

    @property
    def handed_in(self) -> bool:
        """Whether they are of a submission: heatsplat's own were run by overrides."""
        return not self.command.startswith("method=")


@dataclass(frozen=True)
class EarlierPage:
    """What a page that a leaderboard wrote says.

    Args:
        reference: the method beside which it has the others.
        seeds: of every method on a scene in a track that has results.
        pictures: (scene, view) -> renders and errors, as the page shows them.
    """

    reference: str
    seeds: Mapping[Place, EarlierSeeds]
    pictures: Mapping[tuple[str, str], Mapping[str, Any]]


def read_page(path: Path, board: Board) -> EarlierPage:
    """What a page that a leaderboard wrote says.

    Raises:
        SceneError: there is no such page, it is cut off, or it has scenes of another size, another score, reference or clock,
            or other settings of a track.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise SceneError(f"leaderboard.earlier: {path} cannot be read ({error.strerror})") from error
    if MARK not in text:
        raise SceneError(f"leaderboard.earlier: {path} is no page of a leaderboard; give a leaderboard.html")
    try:
        content, _ = json.JSONDecoder().raw_decode(text, text.index(MARK) + len(MARK))
    except ValueError as error:
        raise SceneError(f"leaderboard.earlier: {path} is damaged ({error}); take another copy of the page") from error
    wanted = {"sizes": board.sizes, "score": board.score, "reference": board.reference}
    for key, value in wanted.items():
        if content[key] != value:
            raise SceneError(f"leaderboard.earlier: {path} has {key} {content[key]}, this board {value}; leave it out")
    clock = content["summary"]["clock"]
    if clock != board.clock:
        raise SceneError(
            f"leaderboard.earlier: the seconds of {path} are {clock}, those of this board {board.clock}; give "
            f"leaderboard.clock={clock}"
        )
    for track, settings in board.settings.items():
        before = content["tracks"].get(track, settings)
        if before != settings:
            quoted = ",".join(f"'{text}'" for text in before.split())
            raise SceneError(
                f"leaderboard.earlier: the track {track} of {path} is {before}, that of this board {settings}; leave the page "
                f'out, or give the track its settings: "leaderboard.protocol.tracks.{track}=[{quoted}]"'
            )
    return EarlierPage(
        reference=content["reference"],
        seeds={
            (entry["method"], entry["scene"], entry["track"]): EarlierSeeds.of(entry)
            for entry in content["entries"]
            if entry.get("scores")
        },
        pictures={(scene["name"], shown["view"]): shown for scene in content["scenes"] for shown in scene["pictures"]},
    )


def add_earlier(entries: Mapping[Place, Entry], page: EarlierPage) -> dict[str, float]:
    """Adds the seeds of a page that a board's folders lack; track -> the factor that makes their seconds its.

    Machines differ. Where runs of the reference in a track are in the folders and on the page, the seconds of all the folders'
    runs in it are multiplied by what the reference took there over what it took here (geometric mean over scenes). Without such
    a pair they stay as they are, and those of submissions always do.
    """
    factors = {}
    for track in dict.fromkeys(track for _, _, track in page.seeds):
        in_track = [entry for entry in entries.values() if entry.track == track]
        pairs = [
            (page.seeds[entry.place].cost["seconds"], entry.cost("seconds"))
            for entry in in_track
            if entry.method == page.reference and entry.place in page.seeds
        ]
        logs = [math.log(then / now) for then, now in pairs if then and now]
        if logs:
            factors[track] = math.exp(statistics.fmean(logs))
            for entry in in_track:
                entry.scale_seconds(factors[track])
    for place, seeds in page.seeds.items():
        if place in entries:
            entries[place].join(seeds)
    return factors


def sentence(factors: Mapping[str, float]) -> str:
    """What was taken from a page, and by how much the seconds of later runs were scaled, for the table."""
    text = "Seeds that later runs lack are those of an earlier page."
    scaled = " and ".join(f"{factor:.2f} (equal {track})" for track, factor in factors.items())
    if scaled:
        text += (
            f" Seconds of later runs are multiplied by {scaled}, which equalises the times of the reference; those of "
            "submissions are as handed in."
        )
    return text
