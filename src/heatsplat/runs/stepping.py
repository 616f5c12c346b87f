"""Training steps of a module without a trainer, to time them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from heatsplat.contracts import SceneData
from heatsplat.training.clocks import read_clock


class Stepper:
    """A module in the middle of a run, ready to step.

    Args:
        module: a training module as the configuration builds it.
        scene: on which it trains.
        step: the step at which it believes to be.
        device: "cpu" or "cuda".
        clock: that seconds are of, "train_seconds" | "cpu_seconds".
    """

    def __init__(
        self, module: Any, scene: SceneData, *, step: int, device: torch.device | str, clock: str = "train_seconds"
    ) -> None:
        self.module, self.clock = module, clock
        module.attach(scene)
        module.loss.prepare(scene, module.modality)
        module.trainer = SimpleNamespace(global_step=step, world_size=1, precision="32-true")
        module.to(device).on_fit_start()
        self.optimizer = module.configure_optimizers()["optimizer"]

    def step(self, view: Any) -> float:
        """Seconds of one training step on a view."""
        start = read_clock(self.clock)
        self.optimizer.zero_grad()
        self.module.training_step(view, 0)["loss"].backward()
        self.module.on_after_backward()
        self.optimizer.step()
        if self.module.device.type == "cuda":
            torch.cuda.synchronize()
        return read_clock(self.clock) - start
