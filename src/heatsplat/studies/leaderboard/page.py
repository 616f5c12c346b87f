"""The leaderboard as one HTML file: tables that sort, frontiers of error against seconds, renders beside the truth."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.io.pictures import ERROR, THERMAL, colorize, data_uri
from heatsplat.io.tiff import read_temperature
from heatsplat.metrics import DEFINITIONS
from heatsplat.studies.leaderboard.plan import Board
from heatsplat.studies.leaderboard.standings import SUBMISSION, Entry, beside_reference, spread_of, summary
from heatsplat.studies.score import ENDINGS, TRUTH

TEMPLATE = Path(__file__).with_name("page.html")
SHOWN = ("views", "times")  # parts of which the view in the middle is shown
QUALITY = 25  # of its WebP: hundreds of pictures are in one page


def page(entries: Sequence[Entry], board: Board, folder: Path | None) -> str:
    """The page.

    Args:
        entries: of ``standings``.
        board: what was asked for.
        folder: where the page lies, for links to the settings of runs; None leaves links out.
    """
    score = board.protocol["scores"][0]
    beside = beside_reference(entries, board)
    scenes = list(dict.fromkeys(entry.scene for entry in entries))
    content = {
        "score": score,
        "reference": board.protocol["reference"],
        "unit": DEFINITIONS[score].unit,
        "definitions": {name: DEFINITIONS[name].sentence for name in board.protocol["scores"]},
        "tracks": {track: " ".join(board.protocol["tracks"][track]) for track in board.tracks},
        "summary": summary(entries, board),
        "seeds": list(board.seeds),
        "sizes": board.sizes,
        "note": board.note,
        "spread": spread_of(entries, board),
        "scenes": [
            {"name": name, "shows": board.protocol["scenes"].get(name, {}).get("shows", "a recording"),
             "pictures": _pictures([one for one in entries if one.scene == name], board)}
            for name in scenes
        ],
        "entries": [_told(entry, board, folder) for entry in entries],
        "beside": [
            {"method": method, "track": track, "ratio": ratio, "scenes": count}
            for (method, track), (ratio, count) in sorted(beside.items(), key=lambda item: item[1][0])
        ],
    }  # fmt: skip
    data = json.dumps(content, allow_nan=False, ensure_ascii=False).replace("</", "<\\/")
    return TEMPLATE.read_text(encoding="utf-8").replace('"CONTENT"', data)


def _told(entry: Entry, board: Board, folder: Path | None) -> dict[str, Any]:
    """What the page knows of an entry."""
    about: dict[str, Any] = {"method": entry.method, "scene": entry.scene, "track": entry.track}
    if not entry.scores:
        return {**about, "reason": entry.reason}
    first = board.protocol["scores"][0]
    values = entry.values(first)
    links = [] if folder is None else [os.path.relpath(one / ".hydra" / "config.yaml", folder) for one in entry.folders]
    return {
        **about,
        "scores": {name: entry.mean(name) for name in board.protocol["scores"]},
        "spread": statistics.stdev(values) if len(values) > 1 else None,
        "seeds": len(entry.scores),
        "parts": {part: entry.mean(first, part) for part in entry.scores[0].parts},
        "rank": entry.rank,
        "cost": {name: entry.cost(name) for name in ("seconds", "memory_mb", "gaussians", "steps")},
        "command": " ".join(entry.commands[0]),
        "links": links,
    }


def _pictures(entries: Sequence[Entry], board: Board) -> list[dict[str, Any]]:
    """Views of a scene with the truth and every method's render and error, of the first track and the first seed."""
    there = [entry for entry in entries if entry.scores and entry.track == board.tracks[0]]
    if not there:
        return []
    truth = board.root / TRUTH / there[0].scene
    shown = []
    for part in SHOWN:
        names = [row["name"] for row in there[0].scores[0].views if row["part"] == part]
        if not names:
            continue
        name = names[len(names) // 2]
        exact = read_temperature(truth / f"{name}.tiff")
        low, high = (float(value) for value in np.nanpercentile(exact, (0.1, 99.9)))
        renders = {entry.method: image for entry in there if (image := _render(entry, name)) is not None}
        errors = {method: image - exact for method, image in renders.items()}
        limit = float(np.nanpercentile(np.abs(np.stack(list(errors.values()))), 98)) if errors else 1.0
        shown.append(
            {
                "view": name,
                "low": low,
                "high": high,
                "limit": limit,
                "truth": data_uri(colorize(exact, low, high, THERMAL), QUALITY),
                "renders": {
                    method: data_uri(colorize(image, low, high, THERMAL), QUALITY) for method, image in renders.items()
                },
                "errors": {
                    method: data_uri(colorize(image, -limit, limit, ERROR), QUALITY) for method, image in errors.items()
                },
            }
        )
    return shown


def _render(entry: Entry, name: str) -> np.ndarray | None:
    """The render of a view by the first run of an entry; None where its folder has none any more."""
    for place in (entry.folders[0] / SUBMISSION, entry.folders[0] / entry.scene):
        for ending in ENDINGS:
            path = place / f"{name}{ending}"
            if path.is_file():
                return np.load(path).squeeze() if ending == ".npy" else read_temperature(path)
    return None
