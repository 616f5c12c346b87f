"""What a run was, for metrics.json and TensorBoard: the run, its data, its effects and its hyperparameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytorch_lightning as pl
import torch

from heatsplat.contracts import SceneData
from heatsplat.io.files import utf8
from heatsplat.io.settings import walk
from heatsplat.io.versions import processor

# Parts of the configuration that say what was learned and how; the others say where and when, or repeat these.
HYPERPARAMETERS = (
    "name", "seed", "max_steps", "dtype", "data", "thermal", "sensor", "composite", "renderer", "smoothing", "density",
    "merge", "loss", "init", "optim", "stages", "effects",
)  # fmt: skip


def describe_run(trainer: pl.Trainer, module: pl.LightningModule) -> dict[str, Any]:
    """What was run, for metrics.json."""
    return {
        "method": module.config.get("name"),
        "scene": module.scene.name,
        "modality": module.modality,
        "seed": module.config.get("seed"),
        "steps": trainer.global_step or None,
        "thermal_model": type(module.thermal).__name__,
        "multiply_adds_per_gaussian": module.thermal.cost,
        "parameters": sum(parameter.numel() for parameter in module.parameters()),
        "device": str(module.device),
        "machine": _machine(module.device),
        "threads": torch.get_num_threads(),
    }


def _machine(device: torch.device) -> str:
    """What the seconds of a run are seconds of."""
    return f"{torch.cuda.get_device_name(device)}; {processor()}" if device.type == "cuda" else processor()


def describe_data(scene: SceneData) -> dict[str, Any]:
    """What the data are, for metrics.json: counts, sizes and ranges, then what the loader found and assumed."""
    sizes = sorted({f"{frame.camera.width}x{frame.camera.height}" for frame in scene.frames})
    times = [frame.time_s for frame in scene.frames if frame.time_s is not None]
    bounds = scene.thermal_range
    return {
        "views": {"train": len(scene.train), "val": len(scene.val), "test": len(scene.test)},
        "image_sizes": sizes[:10],
        "seconds": max(times) - min(times) if times else None,
        "points": len(scene.points),
        "thermal_range_c": None if bounds is None else [bounds.min_c, bounds.max_c],
        "ambient_c": scene.ambient_c,
        "metres_per_unit": scene.metres_per_unit,
        **scene.notes,
    }


def describe_effects(module: pl.LightningModule) -> dict[str, dict[str, Any]]:
    """Physical effects by name, for metrics.json: those that are simulated with their settings.

    Where a scene chose them there is an entry for every effect of the catalogue, with the verdict on it, how many numbers
    it adds to this many Gaussians ("parameters") and what a step of training costs more ("ms_per_step"). One that is off
    has settings where a part of it is simulated all the same.
    """
    simulated = module.thermal.effects() | module.sensor.effects()
    verdicts = module.config.get("verdicts")
    if not verdicts:
        return {name: {"on": True} | settings for name, settings in simulated.items()}
    described = {}
    for name, verdict in verdicts.items():
        described[name] = {key: verdict[key] for key in ("on", "told", "statistic", "threshold", "gain_db", "reason")}
        priced = "ms_per_step" in verdict
        described[name]["parameters"] = (
            verdict["shared"] + verdict["per_gaussian"] * len(module.splats) if priced else None if verdict["on"] else 0
        )
        described[name]["ms_per_step"] = verdict["ms_per_step"] if priced else None if verdict["on"] else 0.0
        if verdict["on"] or name in simulated:  # wet surfaces follow the air, whether or not wind blows
            described[name]["settings"] = simulated.get(name, {})
    return described


def hyperparameters(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that say what was learned and how, flat: "thermal.frequencies" -> 24."""
    flat: dict[str, Any] = {}
    for key, value in walk({name: config[name] for name in HYPERPARAMETERS if name in config}):
        if key.endswith("._target_"):
            flat[key.removesuffix("._target_")] = str(value).split(".")[-1]
        elif not isinstance(value, Mapping):
            flat[key] = value if isinstance(value, (int, float)) else utf8(str(value)).decode()
    return flat
