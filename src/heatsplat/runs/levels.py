"""Levels of detail of a trained scene: its Gaussians merged as far as stated numbers of degrees allow, as files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from heatsplat.contracts import SceneError
from heatsplat.io.ply import write_splats
from heatsplat.io.results import write_atomically
from heatsplat.runs.run import Trained
from heatsplat.shots import at_time
from heatsplat.splats import Splats
from heatsplat.training.checkpoints import CheckpointFiles
from heatsplat.training.module import CHECKPOINT_KEY

LEVELS_FILE = "levels.json"


def write_levels(
    trained: Trained,
    merging: Any,
    levels_c: Sequence[float] | float,
    output_dir: Path,
    ply: bool = True,
    time_s: float | None = None,
) -> list[Path]:
    """Paths of the files written: lod_<k>.ckpt and, if asked for, lod_<k>.ply of every level, and levels.json.

    A checkpoint of a level can be evaluated and rendered. It has no optimiser moments.

    Args:
        trained: the scene.
        merging: how Gaussians are merged (``density.merging.FlatMerging``).
        levels_c: °C that each level may lose, increasing; or that of a single one.
        output_dir: folder of the files.
        ply: write the Gaussians for viewers as well, with their temperature.
        time_s: of the PLY files, seconds since the first training frame; None takes the middle of the record.

    Raises:
        SceneError: levels do not increase from above 0, or the Gaussians of the method cannot be merged.
    """
    wanted = levels_c if isinstance(levels_c, Sequence) else [levels_c]
    try:
        increasing = all(before < after for before, after in zip((0.0, *wanted), wanted, strict=False))
    except TypeError:
        increasing = False
    if not increasing or len(wanted) == 0:
        raise SceneError(f"levels_c must be increasing numbers of °C above 0, got {levels_c}")
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
        if ply:
            written.append(output_dir / f"lod_{number}.ply")
            _write_ply(written[-1], trained, level.splats, time_s)
    written.append(output_dir / LEVELS_FILE)
    write_atomically(written[-1], json.dumps(found, indent=2) + "\n")
    return written


@torch.no_grad()
def _write_ply(path: Path, trained: Trained, splats: Splats, time_s: float | None) -> None:
    """The Gaussians as they are rendered at a moment; those whose emission depends on the view as the first camera sees them."""
    module, scene = trained.module, trained.scene
    first = scene.train.frames[0]
    if time_s is None and first.time_s is not None:
        start, span = scene.record
        time_s = start + span / 2
    frame = first if time_s is None else at_time(scene, first, time_s)
    with module.showing(splats):
        scales, opacities = module.smoothing(splats.scales, splats.opacities)
        values = module.emissions(splats, replace(frame, camera=first.camera))[:, : module.thermal.modality_channels[0]]
        temperature = None if time_s is None else module.thermal.temperature(splats, time_s)
    write_splats(
        path,
        splats.means.cpu(),
        scales.log().cpu(),
        splats.quats.cpu(),
        opacities[0].logit().clamp(-30, 30).cpu(),
        values.clamp(0, 1).cpu(),
        temperature_k=None if temperature is None else temperature.cpu(),
    )
