"""A training step as Lightning's loops take it, without what does nothing here."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.loops.fetchers import _DataFetcher, _DataLoaderIterDataFetcher
from pytorch_lightning.loops.optimization.automatic import _AutomaticOptimization
from pytorch_lightning.loops.training_epoch_loop import _TrainingEpochLoop
from pytorch_lightning.profilers import PassThroughProfiler
from pytorch_lightning.strategies import SingleDeviceStrategy

# Lightning's hooks of a training step.
STEP_HOOKS = (
    "on_train_batch_start",
    "on_before_zero_grad",
    "on_before_backward",
    "on_after_backward",
    "on_before_optimizer_step",
    "on_train_batch_end",
)


def without_idle_hooks(part: pl.Callback | pl.LightningModule) -> pl.Callback | pl.LightningModule:
    """A callback or module, of which Lightning calls no hook of a step that it leaves empty: a hundred calls a step otherwise."""
    kind = pl.Callback if isinstance(part, pl.Callback) else pl.LightningModule
    for name in STEP_HOOKS:
        if getattr(type(part), name) is getattr(kind, name):
            setattr(part, name, None)
    return part


def lean(trainer: pl.Trainer) -> None:
    """Gives a trainer that has not begun the loops below in place of Lightning's."""
    known = trainer.fit_loop.epoch_loop
    trainer.fit_loop.epoch_loop = LeanEpoch(trainer, known.min_steps, known.max_steps)
    trainer.fit_loop.epoch_loop.automatic_optimization = LeanOptimization(trainer)


class LeanEpoch(_TrainingEpochLoop):
    """Lightning's loop over the views of a run: the same hooks in the same order, and no more.

    Lightning looks at each step how ``training_step`` spells its arguments, who moves a view to the device, which
    schedules wait for the end of an epoch, and what was logged.
    """

    def advance(self, data_fetcher: _DataFetcher) -> None:
        """One step."""
        trainer, connector = self.trainer, self.trainer._logger_connector
        if self.restarting or not _alone(trainer) or isinstance(data_fetcher, _DataLoaderIterDataFetcher):
            super().advance(data_fetcher)
            return
        view, *_ = next(data_fetcher)
        number = self.batch_idx + 1
        self.batch_progress.is_last_batch = data_fetcher.done
        view = trainer.lightning_module.transfer_batch_to_device(view, trainer.strategy.root_device, 0)
        self.batch_progress.increment_ready()
        connector.on_batch_start(view)
        _tell(trainer, "on_train_batch_start", view, number)
        self.batch_progress.increment_started()
        arguments = OrderedDict(batch=view, batch_idx=number)
        outputs = self.automatic_optimization.run(trainer.optimizers[0], number, arguments)
        self.batch_progress.increment_processed()
        self.update_lr_schedulers("step", update_plateau_schedulers=False)
        _tell(trainer, "on_train_batch_end", outputs, view, number)
        if self._results:  # something was logged
            connector.on_batch_end()
        self.batch_progress.increment_completed()
        if self._results:
            connector.update_train_step_metrics()


class LeanOptimization(_AutomaticOptimization):
    """Lightning's loop of one optimiser whose step takes one view: the same hooks in the same order, and no more.

    For a small scene, Lightning's layers of closures, plugins and guards around a step (precision, strategies, profiles,
    accumulation) take longer than its loss. A run that asks for one of them gets Lightning's own loop.
    """

    def run(self, optimizer: torch.optim.Optimizer, batch_idx: int, kwargs: OrderedDict) -> dict[str, Any]:
        """The step's outputs, the loss without its graph."""
        trainer, module, progress = self.trainer, self.trainer.lightning_module, self.optim_progress.optimizer
        if not _alone(trainer) or trainer.gradient_clip_val or trainer.accumulate_grad_batches != 1:
            return super().run(optimizer, batch_idx, kwargs)
        outputs: dict[str, Any] = {}

        def closure() -> torch.Tensor:
            outputs.update(module.training_step(*kwargs.values()))
            loss = outputs["loss"]
            progress.zero_grad.increment_ready()
            _tell(trainer, "on_before_zero_grad", optimizer)
            progress.zero_grad.increment_started()
            module.optimizer_zero_grad(trainer.current_epoch, batch_idx, optimizer)
            progress.zero_grad.increment_completed()
            _tell(trainer, "on_before_backward", loss)
            module.backward(loss)
            _tell(trainer, "on_after_backward")
            outputs["loss"] = loss.detach()
            return outputs["loss"]

        progress.step.increment_ready()
        stepping = _Stepping(optimizer, lambda: _tell(trainer, "on_before_optimizer_step", optimizer))
        module.optimizer_step(trainer.current_epoch, batch_idx, stepping, closure)
        progress.step.increment_completed()
        return outputs


def plain(optimizer: Any) -> torch.optim.Optimizer:
    """The optimiser itself, of what Lightning or ``LeanOptimization`` hands to hooks in its place."""
    return getattr(optimizer, "optimizer", optimizer)


def _alone(trainer: pl.Trainer) -> bool:
    """Whether there is one device, and nobody takes the time of hooks."""
    return type(trainer.strategy) is SingleDeviceStrategy and isinstance(trainer.profiler, PassThroughProfiler)


def _tell(trainer: pl.Trainer, name: str, *arguments: Any) -> None:
    """Calls a hook of the callbacks and of the module, of those that have one (``without_idle_hooks``)."""
    module = trainer.lightning_module
    # What is logged in a hook is kept under its name. torch would look forty times a step whether that is a tensor.
    object.__setattr__(module, "_current_fx_name", name)
    for callback in trainer.callbacks:
        hook = getattr(callback, name)
        if hook is not None:
            hook(trainer, module, *arguments)
    hook = getattr(module, name)
    if hook is not None:
        hook(*arguments)
    object.__setattr__(module, "_current_fx_name", None)


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
