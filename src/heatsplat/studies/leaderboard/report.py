"""The leaderboard for people: leaderboard.md, leaderboard.csv, and a page that a browser opens offline."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from heatsplat.io.results import write_atomically
from heatsplat.io.tables import NONE, markdown_table, number, write_csv
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.leaderboard.page import page
from heatsplat.studies.leaderboard.plan import Board
from heatsplat.studies.leaderboard.standings import Entry, Standings, beside_reference, spread_of, standings, summary

log = logging.getLogger("heatsplat")

TABLE_FILE, CSV_FILE, PAGE_FILE = "leaderboard.md", "leaderboard.csv", "leaderboard.html"
TIES = "methods whose difference is below two of its standard errors are tied, and share their ranks."
DIGITS = {"psnr": 2, "ssim": 4, "mae_c": 3}


def write_leaderboard(folder: Path, board: Board) -> list[Path]:
    """Writes the table, the CSV and the page into the folder of a sweep, and where the board says besides; their paths."""
    found = standings(folder, board)
    told = summary(found.entries, board)
    log.info("%d of %d entries have results, of %d runs", told["filled"], told["entries"], told["runs"])
    text = markdown(found, board)
    files = {folder / TABLE_FILE: text, folder / PAGE_FILE: page(found, board, folder)}
    if board.document is not None:
        files[board.document] = text
    if board.page is not None:
        files[board.page] = page(found, board, None)
    for path, content in files.items():
        write_atomically(path, content)
    write_csv(folder / CSV_FILE, _records(found.entries, board))
    return [*files, folder / CSV_FILE]


def markdown(found: Standings, board: Board) -> str:
    """The table: a part for each track, with ranks over all scenes and the error on each."""
    entries = found.entries
    told, score = summary(entries, board), board.protocol["scores"][0]
    unit = DEFINITIONS[score].unit
    lines = [
        "# Leaderboard",
        "",
        f"Every method on every scene of the [protocol](protocol.md), written by `experiment=leaderboard`. Scenes of size "
        f"{', '.join(board.sizes)}; {told['runs']} runs, {told['hours']:.2f} h of {_clock(board)} together; seeds "
        f"{', '.join(map(str, board.seeds))}. {' '.join(filter(None, (board.note, found.note)))}".rstrip(),
        "",
        f"The [page]({PAGE_FILE}) beside it sorts, draws error against seconds, and shows renders beside the truth.",
        "",
        f"A cell is {score} ({unit}) of the held-out views, mean over seeds, with the ranks that the seeds allow: {TIES} "
        f"{spread_of(entries, board)} `x {board.protocol['reference']}` is the geometric mean of a method's error as a multiple "
        "of that method's, over the scenes that both ran on.",
        "",
    ]
    for track in board.tracks:
        own = [entry for entry in entries if entry.track == track]
        if not any(entry.seeds for entry in own):
            continue
        settings = " ".join(board.protocol["tracks"][track])
        if steps := sorted({int(entry.cost("steps")) for entry in own if entry.cost("steps")}):
            settings += f"`; steps taken: `{steps[0]:,}" + (f" to {steps[-1]:,}" if len(steps) > 1 else "")
        lines += [f"## Equal {track}", "", f"`{settings}`", "", *_table(own, board, track), ""]
        lines += [f"### By what is held out, equal {track}", "", *_parts(own, board), ""]
        if reasons := _reasons(own):
            lines += ["### What could not run", "", *(f"- {text}" for text in reasons), ""]
    lines += ["## Scores", "", *(f"- {name}: {DEFINITIONS[name].sentence}" for name in board.protocol["scores"]), ""]
    return "\n".join(lines)


def _clock(board: Board) -> str:
    return "processor time" if board.clock == "cpu_seconds" else "training time"


def order(entries: Sequence[Entry], board: Board, track: str) -> list[str]:
    """Methods of a track: those that ran on more scenes first, the better of equally many before the worse."""
    beside = beside_reference(entries, board)
    names = list(dict.fromkeys(entry.method for entry in entries))
    last = (float("inf"), 0)
    return sorted(names, key=lambda name: (-beside.get((name, track), last)[1], beside.get((name, track), last)[0]))


def _table(entries: Sequence[Entry], board: Board, track: str) -> list[str]:
    score = board.protocol["scores"][0]
    beside = beside_reference(entries, board)
    scenes = list(dict.fromkeys(entry.scene for entry in entries))
    places = {(entry.method, entry.scene): entry for entry in entries}
    rows = []
    for method in order(entries, board, track):
        own = [places.get((method, scene)) for scene in scenes]
        if not any(one and one.seeds for one in own):
            continue
        ratio, count = beside.get((method, track), (None, 0))
        seconds = [one.cost("seconds") for one in own if one and one.cost("seconds") is not None]
        told = number(sum(seconds) / len(seconds) if seconds else None, 0)
        rows.append([f"`{method}`", number(ratio, 2), count, told, *(_cell(one, score) for one in own)])
    head = ["method", f"x {board.protocol['reference']}", "scenes", f"s ({_clock(board)})", *scenes]
    return markdown_table(head, rows, "lrrr" + "r" * len(scenes))


def rank_text(entry: Entry) -> str:
    """Its ranks: "2", or "2–4" where seeds do not tell."""
    low, high = entry.rank
    return str(low) if low == high else f"{low}–{high}"


def _cell(entry: Entry | None, score: str) -> str:
    if entry is None or entry.mean(score) is None:
        return NONE
    text = f"{number(entry.mean(score), DIGITS.get(score, 3))} ({rank_text(entry)})"
    return f"**{text}**" if entry.rank[0] == 1 else text


def _parts(entries: Sequence[Entry], board: Board) -> list[str]:
    """The three best of each part of each scene."""
    score = board.protocol["scores"][0]
    parts = list(dict.fromkeys(part for entry in entries for part in entry.parts))
    scenes = list(dict.fromkeys(entry.scene for entry in entries))
    rows = []
    for scene in scenes:
        for part in parts:
            found = {entry.method: entry.mean(score, part) for entry in entries if entry.scene == scene and entry.seeds}
            found = {method: value for method, value in found.items() if value is not None}
            if found:
                best = sorted(found, key=found.get)[:3]
                rows.append([scene, part, *(f"`{method}` {number(found[method], 3)}" for method in best)])
    longest = max((len(row) for row in rows), default=2)
    head = ["scene", "held out", *("best", "second", "third")[: longest - 2]]
    return markdown_table(head, [row + [NONE] * (longest - len(row)) for row in rows])


def _reasons(entries: Sequence[Entry]) -> list[str]:
    """Methods without results and why, scenes of one reason together."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for entry in entries:
        if not entry.seeds:
            reasons.setdefault((entry.method, _short(entry)), []).append(entry.scene)
    return [f"`{method}` on {', '.join(scenes)}: {reason}" for (method, reason), scenes in reasons.items()]


def _short(entry: Entry) -> str:
    """The reason without the name of the scene, so that scenes of one reason stand together."""
    return entry.reason.replace(f"scene '{entry.scene}'", "the scene")


def _records(entries: Sequence[Entry], board: Board) -> list[Mapping[str, object]]:
    """A row per run in full precision, or for all seeds of an earlier page; one without scores for what has none."""
    rows: list[Mapping[str, object]] = []
    for entry in entries:
        about = {"method": entry.method, "scene": entry.scene, "track": entry.track}
        if entry.told is not None:
            rows.append({**about, **entry.told["scores"], **entry.told["cost"], "seeds": entry.seeds})
        elif not entry.scores:
            rows.append({**about, "reason": entry.reason})
        for score, cost, folder in zip(entry.scores, entry.costs, entry.folders, strict=True):
            values = {name: score.mean(name) for name in board.protocol["scores"]}
            by_part = {
                f"{name}_{part}": score.mean(name, part) for part in score.parts for name in board.protocol["scores"]
            }
            rows.append({**about, **values, **by_part, **cost, "folder": os.path.basename(folder)})
    return rows
