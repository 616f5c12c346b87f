"""The leaderboard as one HTML file: tables that sort, frontiers of error against seconds, renders beside the truth."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.geometry.resampling import resampled
from heatsplat.io.pictures import ERROR, THERMAL, bounds_of, colorize, data_uri
from heatsplat.io.tiff import read_temperature
from heatsplat.metrics.definitions import DEFINITIONS
from heatsplat.studies.leaderboard.plan import Board
from heatsplat.studies.leaderboard.standings import (
    SUBMISSION,
    Entry,
    Standings,
    beside_reference,
    least_told,
    mean_costs,
    spread_of,
    summary,
)
from heatsplat.studies.score import ENDINGS, TRUTH

TEMPLATE = Path(__file__).with_name("page.html")
SHOWN = ("views", "times")  # parts of which the view in the middle is shown
QUALITY = 9  # of its WebP: hundreds of pictures are in one page
WIDTH = 200  # pixels, in which the template shows a picture


def page(found: Standings, board: Board, folder: Path | None) -> str:
    """The page.

    Args:
        found: of ``standings``.
        board: what was asked for.
        folder: where the page lies, for links to the settings of runs; None leaves links out.
    """
    entries = found.entries
    beside = beside_reference(entries, board)
    scenes = list(dict.fromkeys(entry.scene for entry in entries))
    # Those that ran on no scene with the reference, too.
    told = {(entry.method, entry.track): (None, 0) for entry in entries if entry.seeds} | beside

    def place(item: tuple[tuple[str, str], tuple[float | None, int]]) -> tuple[bool, float]:
        value = item[1][0]
        return value is None, (value or 0.0) * (-1 if board.higher else 1)

    content = {
        "score": board.score,
        "higher": board.higher,
        "reference": board.reference,
        "unit": DEFINITIONS[board.score].unit,
        "definitions": {name: DEFINITIONS[name].sentence for name in board.scores},
        "tracks": board.settings,
        "summary": summary(entries, board),
        "seeds": list(board.seeds),
        "sizes": board.sizes,
        "note": " ".join(filter(None, (board.note, found.note))),
        "spread": spread_of(entries, board),
        "least": least_told(entries, board),
        "scenes": [
            {"name": name, "shows": board.protocol["scenes"].get(name, {}).get("shows", "a recording"),
             "pictures": _pictures(name, found, board)}
            for name in scenes
        ],
        "entries": [_told(entry, board, folder) for entry in entries],
        "beside": [
            {"method": method, "track": track, "beside": value, "scenes": count,
             "cost": mean_costs([entry for entry in entries if (entry.method, entry.track) == (method, track)])}
            for (method, track), (value, count) in sorted(told.items(), key=place)
        ],
    }  # fmt: skip
    data = json.dumps(content, allow_nan=False, ensure_ascii=False).replace("</", "<\\/")
    return TEMPLATE.read_text(encoding="utf-8").replace('"CONTENT"', data)


def _told(entry: Entry, board: Board, folder: Path | None) -> dict[str, Any]:
    """What the page knows of an entry."""
    about: dict[str, Any] = {"method": entry.method, "scene": entry.scene, "track": entry.track}
    if not entry.seeds:
        return {**about, "reason": entry.reason}
    links = (
        [] if folder is None else [os.path.relpath(run.folder / ".hydra" / "config.yaml", folder) for run in entry.runs]
    )
    return {
        **about,
        "scores": {name: entry.mean(name) for name in board.scores},
        "spread": entry.deviation(board.score),
        "seeds": entry.seeds,
        "numbers": sorted(entry.all_numbers),
        "parts": {part: entry.mean(board.score, part) for part in entry.parts},
        "rank": entry.rank,
        "cost": {name: entry.cost(name) for name in ("seconds", "memory_mb", "gaussians", "steps")},
        "command": entry.command,
        "links": links,
        "reason": entry.lost,
    }


def _pictures(scene: str, found: Standings, board: Board) -> list[dict[str, Any]]:
    """Views of a scene with the truth and every method's render and error, of the first track and the first seed.

    Methods whose first seed an earlier page tells keep its pictures, and errors of all its limit of colours.
    """
    own = [entry for entry in found.entries if entry.scene == scene and entry.track == board.tracks[0] and entry.seeds]
    truth = board.root / TRUTH / scene
    pictures_before = board.earlier.pictures if board.earlier is not None else {}
    shown = []
    for part in SHOWN:
        names = sorted(path.stem for path in truth.glob(f"{part}_*.tiff"))
        if not own or not names:
            continue
        name = names[len(names) // 2]
        exact = read_temperature(truth / f"{name}.tiff")
        low, high = bounds_of(exact[~np.isnan(exact)])
        earlier = pictures_before.get((scene, name), {"renders": {}, "errors": {}})
        kept = [entry.method for entry in own if entry.earlier.numbers and entry.method in earlier["renders"]]
        others = [entry for entry in own if entry.method not in kept]
        renders = {entry.method: image for entry in others if (image := _render(entry, name)) is not None}
        errors = {method: image - exact for method, image in renders.items()}
        limit = float(np.nanpercentile(np.abs(np.stack(list(errors.values()))), 98)) if errors else 1.0
        limit = earlier.get("limit", limit)
        shown.append(
            {
                "view": name,
                "low": low,
                "high": high,
                "limit": limit,
                "truth": _picture(exact, low, high, THERMAL),
                "renders": {
                    **{method: earlier["renders"][method] for method in kept},
                    **{method: _picture(image, low, high, THERMAL) for method, image in renders.items()},
                },
                "errors": {
                    **{method: earlier["errors"][method] for method in kept},
                    **{method: _picture(image, -limit, limit, ERROR) for method, image in errors.items()},
                },
            }
        )
    return shown


def _picture(values: np.ndarray, low: float, high: float, colormap: str) -> str:
    """Values [H, W] in colours as the ``src`` of an image, no wider than it is shown."""
    picture = colorize(values, low, high, colormap)
    height, width = picture.shape[:2]
    if width > WIDTH:
        shrunk = resampled(torch.from_numpy(picture).float(), round(height * WIDTH / width), WIDTH, "area")
        picture = shrunk.round().byte().numpy()
    return data_uri(picture, QUALITY)


def _render(entry: Entry, name: str) -> np.ndarray | None:
    """The render of a view by the first run of an entry; None where its folder has none any more."""
    for place in (run.folder / kind for run in entry.runs[:1] for kind in (SUBMISSION, entry.scene)):
        for ending in ENDINGS:
            path = place / f"{name}{ending}"
            if path.is_file():
                return np.load(path).squeeze() if ending == ".npy" else read_temperature(path)
    return None
