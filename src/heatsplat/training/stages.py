"""Stages of a run: which parameters are frozen at which steps, and where training begins anew.

A pure function of the step, so resuming is free.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase

import torch
from torch import Tensor

from heatsplat.training.adam import forget_gradients

log = logging.getLogger(__name__)

COLUMN = re.compile(r"(.+)\[(\d+)\]")


class Freeze:
    """Steps at which some parameters are frozen: one stretch of the run, or the end of every cycle in it.

    Args:
        groups: names of the optimiser's groups, wildcards allowed ("thermal.*"). "opacity_logits[1]" is the second
            column of a tensor that has several; a tensor of one column is shared, and such a name leaves it alone.
        start: first step.
        stop: the step before which it ends; None is the end of the run.
        cycle: steps of a cycle, counted from ``start``; None freezes from ``start`` to ``stop``.
        share: part of a cycle, at its end, in which they are frozen.
        turn, turns: they are frozen in every ``turns``-th cycle, the first of which is number ``turn``.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(
        self,
        groups: Sequence[str],
        start: int = 0,
        stop: int | None = None,
        cycle: int | None = None,
        share: float = 1.0,
        turn: int = 0,
        turns: int = 1,
    ) -> None:
        if not groups or isinstance(groups, str):
            raise ValueError(f"groups must be a list of names of parameter groups, got {groups!r}")
        if start < 0 or (stop is not None and stop < 0):
            raise ValueError(f"start and stop are steps of 0 or more, got {start} and {stop}")
        if cycle is not None and cycle < 1:
            raise ValueError(f"cycle must be at least 1 step, or null, got {cycle}")
        if not 0 <= share <= 1 or not 0 <= turn < turns:
            raise ValueError(f"share lies in [0, 1] and turn in 0 to turns - 1, got {share}, {turn} of {turns}")
        self.groups, self.start, self.stop = tuple(groups), start, stop
        self.cycle, self.share, self.turn, self.turns = cycle, share, turn, turns

    def at(self, step: int) -> bool:
        """Whether the parameters are frozen at ``step``."""
        if step < self.start or (self.stop is not None and step >= self.stop):
            return False
        if self.cycle is None:
            return True
        number, place = divmod(step - self.start, self.cycle)
        return number % self.turns == self.turn and place >= self.cycle - round(self.share * self.cycle)


class Stages:
    """Freezes parameters while a step runs. They, their moments and their penalties are left as they were.

    A run may be several rounds: a restart leaves the Gaussians as they are and begins training anew, with a fresh
    optimiser, and with learning rates, density control and the schedules of the thermal model at their start. Steps of
    ``freezes`` and of losses are those of the run.

    Args:
        freezes: name -> when which parameters are frozen, or None for a stage that is absent.
        restarts: first steps of all rounds but the first.
    """

    def __init__(self, freezes: Mapping[str, Freeze | None], restarts: Sequence[int] = ()) -> None:
        self.freezes = {name: freeze for name, freeze in freezes.items() if freeze is not None}
        self.restarts = tuple(restarts)

    def last_change(self, steps: int) -> int:
        """The last step of a run of so many at which a round begins, or a stage begins or ends that comes once; 0 for none."""
        once = [freeze for freeze in self.freezes.values() if freeze.cycle is None]
        turns = [step for freeze in once for step in (freeze.start, freeze.stop) if step is not None and step < steps]
        return max((*self.restarts, *turns), default=0)

    def held_from(self, group: str) -> float:
        """The step from which on a group is frozen until the run ends; infinity where none is, or in runs of several rounds."""
        if self.restarts:
            return math.inf  # density control, which asks, counts the steps of a round
        ends = (freeze for freeze in self.freezes.values() if freeze.stop is None and freeze.cycle is None)
        return min(
            (one.start for one in ends if any(fnmatchcase(group, name) for name in one.groups)), default=math.inf
        )

    def freezes_group(self, group: str) -> bool:
        """Whether a stage freezes a parameter group, all of it, at some step."""
        names = (name for freeze in self.freezes.values() for name in freeze.groups)
        return any(fnmatchcase(group, name) for name in names)

    def freezes_at(self, group: str, step: int) -> bool:
        """Whether a stage freezes a parameter group, all of it, at ``step``."""
        names = (name for freeze in self.freezes.values() if freeze.at(step) for name in freeze.groups)
        return any(fnmatchcase(group, name) for name in names)

    def check(self, optimizer: torch.optim.Optimizer) -> None:
        """Warns of stages that freeze nothing, as none of their names is a group of this run."""
        for name, freeze in self.freezes.items():
            if not any(_found(freeze.groups, optimizer)):
                there = ", ".join(group["name"] for group in optimizer.param_groups)
                log.warning(
                    "stage '%s' freezes nothing: none of %s is a parameter group of this run (%s)",
                    name,
                    ", ".join(freeze.groups),
                    there,
                )

    @contextmanager
    def on_step(self, step: int, optimizer: torch.optim.Optimizer) -> Iterator[None]:
        """Runs a training step, from the render to the optimiser's update, with its parameters frozen.

        Whole tensors get no gradient, so that nothing is computed for them and the optimiser passes them by; one that
        waited for those of more views is forgotten. Columns of a tensor are put back, with their moments, after the update, and
        what they gathered is forgotten, too.
        """
        names = [name for freeze in self.freezes.values() if freeze.at(step) for name in freeze.groups]
        frozen = list(_found(names, optimizer))
        whole = [parameter for parameter, column in frozen if column is None]
        held = [
            (parameter, column, _columns(parameter, column, optimizer))
            for parameter, column in frozen
            if column is not None
        ]
        for parameter in whole:
            parameter.requires_grad_(False)
            forget_gradients(parameter)
        try:
            yield
        finally:
            for parameter in whole:
                parameter.requires_grad_(True)
        for parameter, column, before in held:
            _put_back(parameter, column, before, optimizer)


def _found(names: Sequence[str], optimizer: torch.optim.Optimizer) -> Iterator[tuple[Tensor, int | None]]:
    """Parameters of the groups with one of ``names``, each with the column that is meant, or None for all of it."""
    for name in names:
        match = COLUMN.fullmatch(name)
        pattern, column = (match[1], int(match[2])) if match else (name, None)
        for group in optimizer.param_groups:
            if fnmatchcase(group["name"], pattern):
                for parameter in group["params"]:
                    if column is None or (parameter.ndim == 2 and column < parameter.shape[1] > 1):
                        yield parameter, column


def _columns(parameter: Tensor, column: int, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Copies of a column of a parameter, under "", and of its moments, which are missing before the first step."""
    moments = optimizer.state.get(parameter, {})
    found = {key: value for key, value in moments.items() if value.shape == parameter.shape} | {"": parameter.detach()}
    return {key: value[:, column].clone() for key, value in found.items()}


def _put_back(parameter: Tensor, column: int, before: dict[str, Tensor], optimizer: torch.optim.Optimizer) -> None:
    """Writes a column of a parameter and of its moments; moments that were missing, and its gradient, become zero."""
    with torch.no_grad():
        parameter[:, column] = before[""]
        if parameter.grad is not None:
            parameter.grad[:, column] = 0.0
        for key, value in optimizer.state.get(parameter, {}).items():
            if value.shape == parameter.shape:
                value[:, column] = before.get(key, 0.0)
