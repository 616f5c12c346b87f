"""What each simulated effect costs: parameters, and milliseconds of a training step, measured in pairs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from heatsplat.contracts import SceneData
from heatsplat.runs.stepping import Stepper

WARM_UP = 2  # steps of each model that are not timed: kernels compile and memory is found
ROUNDS = (3, 15)  # fewest and most
SECONDS = 10.0  # no further round begins after this long


@dataclass(frozen=True)
class Price:
    """What a run has more because an effect is simulated.

    Args:
        per_gaussian: numbers that every Gaussian carries for it.
        shared: numbers that belong to scene or camera.
        ms_per_step: milliseconds of a training step, by quickest steps; noise may take it below zero.
    """

    per_gaussian: int
    shared: int
    ms_per_step: float


def prices(
    whole: Callable[[], Any],
    without: Mapping[str, Callable[[], Any]],
    scene: SceneData,
    max_steps: int,
    device: torch.device | str = "cpu",
) -> dict[str, Price]:
    """What each effect adds to a run, by name.

    Steps are whole ones (render, loss, backward, optimiser) on the Gaussians that a run starts with, as they are at the
    end of a run, when schedules have let everything in. The model with all effects and those without one take turns, step
    by step on the same views, and the quickest step of each counts: whatever else the machine does makes steps slower only.

    Args:
        whole: makes the training module with all effects that are on.
        without: for each of them, makes the module without it.
        scene: to train on.
        max_steps: length of the run.
        device: where the run trains.
    """
    if not without:
        return {}
    models = {
        name: Stepper(make(), scene, step=max_steps - 1, device=device) for name, make in {"": whole, **without}.items()
    }
    sizes = {name: _size(model.module) for name, model in models.items()}
    views = [scene.train[i] for i in range(min(len(scene.train), ROUNDS[1]))]
    best = dict.fromkeys(models, float("inf"))
    start = time.perf_counter()
    for turn in range(-WARM_UP, ROUNDS[1]):
        if turn >= ROUNDS[0] and time.perf_counter() - start > SECONDS:
            break
        for name, model in models.items():
            seconds = model.step(views[turn % len(views)])
            if turn >= 0:
                best[name] = min(best[name], seconds)
    return {
        name: Price(
            sizes[""][0] - sizes[name][0],
            sizes[""][1] - sizes[name][1],
            1e3 * (best[""] - best[name]),
        )
        for name in without
    }


def _size(module: Any) -> tuple[int, int]:
    """Numbers that a module learns for each Gaussian, and all others."""
    per_gaussian = sum(tensor[0].numel() for tensor in module.splats.parameters())
    return per_gaussian, sum(tensor.numel() for tensor in module.parameters()) - per_gaussian * len(module.splats)
