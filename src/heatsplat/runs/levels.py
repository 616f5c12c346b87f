"""Levels of detail of a trained scene: its Gaussians merged as far as stated numbers of degrees allow, as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from heatsplat.contracts import SceneError, as_written
from heatsplat.io.files import write_atomically
from heatsplat.runs.run import Trained
from heatsplat.training.checkpoints import CheckpointFiles
from heatsplat.training.module import CHECKPOINT_KEY

LEVELS_FILE = "levels.json"


def write_levels(
    trained: Trained,
    merging: Any,
    levels_c: Sequence[float] | float,
    output_dir: Path,
    write_ply: Callable[[Path], None] | None = None,
) -> list[Path]:
    """Paths of the files written: lod_<k>.ckpt and, with ``write_ply``, lod_<k>.ply of every level, and levels.json.

    A checkpoint of a level can be evaluated and rendered. It has no optimiser moments.

    Args:
        trained: the scene.
        merging: how Gaussians are merged (``density.merging.FlatMerging``).
        levels_c: °C that each level may lose, increasing; or that of a single one.
        output_dir: folder of the files.
        write_ply: writes the Gaussians that the module then has to a file for viewers; None writes none.

    Raises:
        SceneError: levels do not increase from above 0, or the Gaussians of the method cannot be merged.
    """
    wanted = levels_c if isinstance(levels_c, Sequence) else [levels_c]
    try:
        increasing = all(before < after for before, after in zip((0.0, *wanted), wanted, strict=False))
    except TypeError:
        increasing = False
    if not increasing or len(wanted) == 0:
        raise SceneError(f"levels_c must be increasing numbers of °C above 0, got {as_written(levels_c)}")
    module, written, found = trained.module, [], []
    for number, level in enumerate(merging.levels(module, [float(level) for level in wanted])):
        found.append(level.found | {"checkpoint": f"lod_{number}.ckpt"})
        with module.showing(level.splats):
            kept = trained.checkpoint[CHECKPOINT_KEY] | {
                "density_state": module.density.initial_state(len(level.splats), torch.device("cpu"))
            }
            checkpoint = trained.checkpoint | {
                "state_dict": {name: tensor.detach().cpu() for name, tensor in module.state_dict().items()},
                "optimizer_states": [],
                CHECKPOINT_KEY: kept,
            }
            written.append(output_dir / f"lod_{number}.ckpt")
            CheckpointFiles().save_checkpoint(checkpoint, written[-1])
            if write_ply is not None:
                written.append(output_dir / f"lod_{number}.ply")
                write_ply(written[-1])
    written.append(output_dir / LEVELS_FILE)
    write_atomically(written[-1], json.dumps(found, indent=2) + "\n")
    return written
