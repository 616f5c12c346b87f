"""A training step as Lightning's automatic optimisation takes it, without what does nothing here."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import torch
from pytorch_lightning.loops.optimization.automatic import _AutomaticOptimization
from pytorch_lightning.profilers import PassThroughProfiler
from pytorch_lightning.strategies import SingleDeviceStrategy


class LeanOptimization(_AutomaticOptimization):
    """Lightning's loop of one optimiser whose step takes one view: the same hooks in the same order, and no more.

    For a small scene, Lightning's layers of closures, plugins and guards around a step (precision, strategies, profiles,
    accumulation) take longer than its loss. A run that asks for one of them gets Lightning's own loop.
    """

    def run(self, optimizer: torch.optim.Optimizer, batch_idx: int, kwargs: OrderedDict) -> dict[str, Any]:
        """The step's outputs, the loss without its graph."""
        trainer, module, progress = self.trainer, self.trainer.lightning_module, self.optim_progress.optimizer
        alone = type(trainer.strategy) is SingleDeviceStrategy and isinstance(trainer.profiler, PassThroughProfiler)
        if not alone or trainer.gradient_clip_val or trainer.accumulate_grad_batches != 1:
            return super().run(optimizer, batch_idx, kwargs)
        outputs: dict[str, Any] = {}

        def closure() -> torch.Tensor:
            outputs.update(module.training_step(*kwargs.values()))
            loss = outputs["loss"]
            progress.zero_grad.increment_ready()
            self._tell("on_before_zero_grad", optimizer)
            progress.zero_grad.increment_started()
            module.optimizer_zero_grad(trainer.current_epoch, batch_idx, optimizer)
            progress.zero_grad.increment_completed()
            self._tell("on_before_backward", loss)
            module.backward(loss)
            self._tell("on_after_backward")
            outputs["loss"] = loss.detach()
            return outputs["loss"]

        progress.step.increment_ready()
        stepping = _Stepping(optimizer, lambda: self._tell("on_before_optimizer_step", optimizer))
        module.optimizer_step(trainer.current_epoch, batch_idx, stepping, closure)
        progress.step.increment_completed()
        return outputs

    def _tell(self, name: str, *arguments: Any) -> None:
        """Calls a hook of the callbacks and of the module, of those that have one (``session.without_idle_hooks``)."""
        module = self.trainer.lightning_module
        for callback in self.trainer.callbacks:
            hook = getattr(callback, name)
            if hook is not None:
                hook(self.trainer, module, *arguments)
        hook = getattr(module, name)
        if hook is not None:
            hook(*arguments)


class _Stepping:
    """What stands for the optimiser in the module's ``optimizer_step``: calls ``before`` when a closure has found gradients."""

    def __init__(self, optimizer: torch.optim.Optimizer, before: Callable[[], None]) -> None:
        self.optimizer, self._before = optimizer, before

    def step(self, closure: Callable[[], Any]) -> Any:
        def found() -> Any:
            loss = closure()
            self._before()
            return loss

        return self.optimizer.step(found)
