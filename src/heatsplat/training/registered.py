"""Parameters that would never train, or not be in a checkpoint: what a model forgot to register, said by name."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import torch
from torch import nn

from heatsplat.splats import GEOMETRY
from heatsplat.training.stages import Stages

log = logging.getLogger(__name__)


def check_registered(module: nn.Module) -> None:
    """Raises ValueError where a part of a run holds parameters in a list or dict of Python, of which torch knows nothing."""
    registered = {id(parameter) for parameter in module.parameters()}
    parts = [(name, part) for name, part in module.named_modules() if part is not module]
    for name, part in parts:
        for attribute, value in vars(part).items():
            if attribute.startswith("_") or not isinstance(value, list | tuple | dict):
                continue
            if any(id(parameter) not in registered for parameter in _parameters_in(value)):
                raise ValueError(
                    f"{name}.{attribute} of {type(part).__name__} holds parameters in a {type(value).__name__}, where neither "
                    "the optimiser nor checkpoints find them: use nn.ParameterList, nn.ModuleList or the like"
                )


def check_trained(module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Raises ValueError where a module has parameters that its optimiser does not, as they were made after it."""
    trained = {id(parameter) for group in optimizer.param_groups for parameter in group["params"]}
    late = [name for name, parameter in module.named_parameters() if id(parameter) not in trained]
    if late:
        raise ValueError(
            f"the optimiser does not know the parameters {', '.join(late)}, which would never learn: create those of a thermal "
            "model or a sensor part in __init__ or prepare, and those of each Gaussian in per_gaussian"
        )


def warn_of_untrained(optimizer: torch.optim.Optimizer, stages: Stages) -> None:
    """Warns, at the end of a run, of parameters with a learning rate that never had a gradient: Adam has no state of these.

    The geometry is left out, and so is what a stage froze.
    """
    idle = [
        group["name"]
        for group in optimizer.param_groups
        if group["name"] not in GEOMETRY
        and group.get("initial_lr", group["lr"]) > 0
        and not stages.freezes_group(group["name"])
        and any(parameter.numel() and not optimizer.state.get(parameter) for parameter in group["params"])
    ]
    if idle:
        log.warning("%s had no gradient in this run, and learned nothing: no image depended on it", ", ".join(idle))


def _parameters_in(values: Any) -> Iterator[nn.Parameter]:
    """The parameters in a list, tuple or dict and in the modules in it."""
    for value in values.values() if isinstance(values, dict) else values:
        if isinstance(value, nn.Parameter):
            yield value
        elif isinstance(value, nn.Module):
            yield from value.parameters()
