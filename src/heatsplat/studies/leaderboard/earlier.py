"""A leaderboard's page as the record of its runs: what stands on it goes on counting when their folders are gone."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heatsplat.contracts import SceneError

if TYPE_CHECKING:
    from heatsplat.studies.leaderboard.plan import Board
    from heatsplat.studies.leaderboard.standings import Entry

MARK = "const board = "  # before the JSON of a page


def read_page(path: Path, board: Board) -> dict[str, Any]:
    """The contents of a page that a leaderboard wrote.

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
    wanted = {"sizes": board.sizes, "score": board.protocol["scores"][0], "reference": board.protocol["reference"]}
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
    return content


def add_earlier(places: Mapping[tuple[str, str, str], Entry], content: Mapping[str, Any]) -> dict[str, float]:
    """Adds the seeds of a page that a board's folders lack; track -> the factor that makes their seconds its.

    Machines differ. Where runs of the reference in a track are in the folders and on the page, the seconds of all the folders'
    runs in it are multiplied by what the reference took there over what it took here (geometric mean over scenes). Without such
    a pair they stay as they are.
    """
    told = {place_of(one): one for one in told_by(content)}
    factors = {}
    for track in dict.fromkeys(key[2] for key in told):
        own = [entry for key, entry in places.items() if key[2] == track]
        pairs = [
            (told[entry.place]["cost"]["seconds"], entry.cost("seconds"))
            for entry in own
            if entry.method == content["reference"] and entry.place in told
        ]
        logs = [math.log(there / here) for there, here in pairs if there and here]
        if logs:
            factors[track] = math.exp(statistics.fmean(logs))
            for entry in own:
                entry.scale_seconds(factors[track])
    for key, one in told.items():
        if key in places:
            places[key].join(one)
    return factors


def told_by(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Entries of a page that have results."""
    return [one for one in content["entries"] if one.get("scores")]


def place_of(one: Mapping[str, Any]) -> tuple[str, str, str]:
    """Method, scene and track of an entry of a page."""
    return one["method"], one["scene"], one["track"]


def numbers_of(one: Mapping[str, Any]) -> list[int]:
    """Seeds of an entry of a page; pages that do not tell them have the first ones."""
    return one.get("numbers", list(range(one["seeds"])))


def handed_in(one: Mapping[str, Any]) -> bool:
    """Whether an entry of a page is a submission: heatsplat's own were run by overrides."""
    return not one["command"].startswith("method=")


def pictures_of(content: Mapping[str, Any] | None, scene: str, view: str) -> Mapping[str, Any] | None:
    """Renders and errors of a view that a page shows, as it has them; None where it does not, or there is none."""
    scenes = [one for one in content["scenes"] if one["name"] == scene] if content else []
    return next((shown for one in scenes for shown in one["pictures"] if shown["view"] == view), None)


def sentence(factors: Mapping[str, float]) -> str:
    """What was taken from a page, and by how much the seconds of later runs were scaled, for the table."""
    text = "Seeds that later runs lack are those of an earlier page."
    scaled = " and ".join(f"{factor:.2f} (equal {track})" for track, factor in factors.items())
    if scaled:
        text += f" Seconds of later runs are multiplied by {scaled}, which equalises the times of the reference."
    return text
