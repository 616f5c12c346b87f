"""A small folder of a protocol, and runs on its scenes as a sweep leaves them."""

import json
from pathlib import Path

import numpy as np
import yaml

from heatsplat.io.results import RunResults
from heatsplat.io.tiff import write_temperature
from heatsplat.studies.leaderboard.plan import board_of

PROTOCOL = yaml.safe_load((Path(__file__).parents[2] / "conf" / "protocol" / "thermal.yaml").read_text())
SETTINGS = PROTOCOL["tracks"]["steps"]
VIEWS = ("near_00003", "times_00007", "times_00008")
ASKED = {
    "protocol": PROTOCOL, "root": None, "methods": None, "scenes": None, "tracks": ["steps"], "seeds": [0, 1],
    "clock": "cpu_seconds", "submissions": [], "earlier": None, "document": None, "page": None, "train": True,
    "note": "On a busy machine.",
}  # fmt: skip


def truth(view: str) -> np.ndarray:
    """Temperatures [12, 16] of a view, 20 to 40 °C."""
    return np.linspace(20.0, 40.0, 192, dtype=np.float32).reshape(12, 16) + len(view) % 3


def protocol_folder(root: Path, *scenes: str) -> Path:
    """scenes/ and truth/ with these scenes."""
    for scene in scenes:
        (root / "scenes" / scene).mkdir(parents=True)
        (root / "scenes" / scene / "meta.json").write_text(
            json.dumps({"min_value": 15.0, "max_value": 45.0, "size": "tiny"})
        )
        for view in VIEWS:
            write_temperature(root / "truth" / scene / f"{view}.tiff", truth(view))
    return root


def hand_in(folder: Path, off: float) -> None:
    """Renders that are ``off`` °C too warm."""
    for view in VIEWS:
        write_temperature(folder / f"{view}.tiff", truth(view) + off)


def run_of(folder: Path, method: str, scene: str, seed: int, off: float | None, seconds: float = 10.0) -> None:
    """A run as the sweep leaves it; without ``off`` it failed."""
    place = folder / f"{method}_{scene}_steps_{seed}"
    (place / ".hydra").mkdir(parents=True)
    told = [
        f"method={method}",
        f"data.scene={scene}",
        f"seed={seed}",
        "leaderboard.track=steps",
        f"row={method}",
        *SETTINGS,
    ]
    (place / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(told))
    if off is None:
        (place / "FAILED").write_text("Traceback\nheatsplat.contracts.SceneError: scene 'x' lacks weather\n")
        return
    hand_in(place / "submission", off)
    cost = {"cpu_seconds": seconds, "peak_memory_mb": 900.0, "gaussians": 1000}
    RunResults(run={"method": method, "steps": 2000}, cost=cost).write(place / "metrics.json")


def submission(folder: Path, off: float, **told) -> Path:
    """Renders of ``cooling`` by other code that are ``off`` °C too warm."""
    hand_in(folder / "cooling", off)
    about = {"method": "theirs", "track": "steps", "scenes": {"cooling": {"seconds": 99}}, **told}
    (folder / "metrics.json").write_text(json.dumps(about))
    return folder


def board(folder: Path, given=(), **asked):
    """The board of a folder; ``given`` are keys of the command line."""
    return board_of({**ASKED, "root": str(folder), **asked}, ["3dgs", "etgs", "supirgs"], given)
