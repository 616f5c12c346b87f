"""Stops a run on the first NaN or infinity, names the tensor, and keeps it out of checkpoints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor

from heatsplat.contracts import Frame, View, check_count


class NotFinite(FloatingPointError):
    """A tensor of the training has NaN or infinite values. The message names it and the step."""


class FiniteGuard(pl.Callback):
    """Raises NotFinite, naming loss term, gradient or parameter and the step, when a value is NaN or infinite.

    The loss and the parameters are looked at after every step on a CPU and every ``every`` steps on a GPU, where looking
    means waiting. Gradients are looked at every ``every`` steps before the optimiser uses them, and parameters and the
    optimiser's moments whenever a checkpoint is to be written: a checkpoint that exists is sound.

    Args:
        every: steps between looks at gradients (and at the loss and parameters on a GPU).
    """

    def __init__(self, every: int = 50) -> None:
        check_count("callbacks.finite.every", every)
        self.every = every
        self._frame: Frame | None = None

    def on_train_batch_start(self, trainer: pl.Trainer, module: pl.LightningModule, view: View, *_: Any) -> None:
        self._frame = view.frame

    @property
    def _seen(self) -> str | None:
        """Name of the training image that the step saw."""
        return None if self._frame is None else self._frame.name

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, module: pl.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        if trainer.global_step % self.every == 0:
            try:
                demand_finite(_gradients(module), trainer.global_step + 1, self._seen)
            except NotFinite:
                demand_finite(_emitted(module, self._frame), trainer.global_step + 1, self._seen)
                raise

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: dict[str, Any], *_: Any
    ) -> None:
        step = trainer.global_step
        if module.device.type == "cpu" or step % self.every == 0:
            total = outputs["loss"]
            if not math.isfinite(total.item()):
                terms = outputs.get("terms", {}).items()
                demand_finite(((f"loss term '{name}'", term) for name, term in terms), step, self._seen)
                demand_finite([("loss", total)], step, self._seen)
            if not all(map(_sum_is_finite, trainer.optimizers)):
                demand_finite([*_gradients(module), *_parameters(module)], step, self._seen)

    def on_save_checkpoint(self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
        demand_finite(_parameters(module), trainer.global_step)
        for optimizer in trainer.optimizers:
            demand_finite(_moments(optimizer), trainer.global_step)


def demand_finite(tensors: Iterable[tuple[str, Tensor]], step: int, view: str | None = None) -> None:
    """Raises NotFinite with the names of all ``tensors`` (pairs of name and tensor) that are not finite at ``step``.

    ``view`` is the name of the training image that the step saw, where it is known.

    The sum of a tensor is finite if its values are and do not overflow together; only where it is not are the values
    looked at one by one, which takes several times as long.
    """
    named = [(name, tensor.detach()) for name, tensor in tensors if tensor.is_floating_point()]
    if not named:
        return
    # Adam counts its steps on the CPU even where its moments live on a GPU.
    device = named[0][1].device
    sums = torch.stack([tensor.sum().to(device, torch.float64) for _, tensor in named])
    if bool(torch.isfinite(sums).all()):
        return
    broken = [_describe(name, tensor) for name, tensor in named if not bool(torch.isfinite(tensor).all())]
    if broken:
        raise NotFinite(
            f"step {step}: {'; '.join(broken)}. Nothing of it is in a checkpoint: continue from the last one with a "
            f"lower learning rate of that tensor, or look at the image that this step saw{f', {view}' if view else ''}."
        )


def _describe(name: str, tensor: Tensor) -> str:
    """Which tensor is broken, how badly, and where first."""
    bad = ~torch.isfinite(tensor)
    where = "" if tensor.ndim == 0 else f", first at {bad.nonzero()[0].tolist()} of {list(tensor.shape)}"
    return (
        f"{name} has {int(torch.isnan(tensor).sum())} NaN and {int(torch.isinf(tensor).sum())} infinite values{where}"
    )


def _sum_is_finite(optimizer: torch.optim.Optimizer) -> bool:
    """Whether the sum of all that is trained is finite, which an optimiser may know of what it wrote (``OnePassAdam``)."""
    known = optimizer.finite() if hasattr(optimizer, "finite") else None
    if known is not None:
        return known
    return math.isfinite(sum(p.detach().sum().item() for group in optimizer.param_groups for p in group["params"]))


def _gradients(module: pl.LightningModule) -> Iterator[tuple[str, Tensor]]:
    return ((f"gradient of {name}", p.grad) for name, p in module.named_parameters() if p.grad is not None)


def _emitted(module: pl.LightningModule, frame: Frame | None) -> Iterator[tuple[str, Tensor]]:
    """What the thermal model emits in a frame, of which NaN reach gradients of the geometry."""
    if frame is not None and len(module.splats) and getattr(module.thermal, "per_row", 0) == 1:  # rows are Gaussians
        yield f"what {type(module.thermal).__name__}.features returns", module.emissions(module.splats, frame)


def _parameters(module: pl.LightningModule) -> Iterator[tuple[str, Tensor]]:
    return ((f"parameter {name}", parameter) for name, parameter in module.named_parameters())


def _moments(optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    for number, group in enumerate(optimizer.param_groups):
        for parameter in group["params"]:
            for key, value in optimizer.state.get(parameter, {}).items():
                if isinstance(value, Tensor):
                    yield f"optimiser's {key} of {group.get('name', number)}", value
