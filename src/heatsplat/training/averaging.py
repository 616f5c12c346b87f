"""Means of a run's parameters over its last updates (Polyak and Juditsky, 1992), in place of the last of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


class Average:
    """The mean of what each update leaves in parameters, since the first that was taken.

    Adam's last update is one of many around an optimum: it answers the views that it saw. Rates that fall would settle it, and
    learn less on the way. A mean over the updates is settled, at the rates that learn.
    """

    def __init__(self) -> None:
        self._count = 0
        self._means: dict[str, Tensor] = {}

    def __bool__(self) -> bool:
        """Whether anything was taken."""
        return self._count > 0

    @torch.no_grad()
    def take(self, parameters: Iterable[tuple[str, Tensor]]) -> None:
        """Counts the parameters as they are now, by name. Begins anew where Gaussians have come or gone."""
        now = dict(parameters)
        if any(self._means[name].shape != now[name].shape for name in self._means):
            self.forget()
        self._count += 1
        for name, parameter in now.items():
            if self._count == 1:
                self._means[name] = parameter.detach().clone()
            else:  # not lerp, whose last bits depend on how threads share the elements
                self._means[name] += (parameter - self._means[name]) / self._count

    @torch.no_grad()
    def give(self, parameters: Iterable[tuple[str, Tensor]]) -> int:
        """Puts the means in place of the parameters and forgets them. Returns over how many updates."""
        count, means = self._count, self._means
        self.forget()
        for name, parameter in parameters:
            if name in means:
                parameter.copy_(means[name])
        return count

    def forget(self) -> None:
        """Begins anew with what is taken next."""
        self._count, self._means = 0, {}

    def state_dict(self) -> dict[str, Any]:
        """The count and the means, on the CPU, for a checkpoint."""
        return {"count": self._count, "means": {name: mean.cpu() for name, mean in self._means.items()}}

    def load_state_dict(self, state: dict[str, Any], device: torch.device) -> None:
        """Goes on from a checkpoint."""
        self._count = state["count"]
        self._means = {name: mean.to(device) for name, mean in state["means"].items()}
