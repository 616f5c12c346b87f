"""The only code that adds or removes Gaussians, or touches their optimiser moments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from heatsplat.splats import Splats


@dataclass
class Cloud:
    """Gaussians with everything that has a row per Gaussian: parameters, Adam moments, density statistics.

    Args:
        splats: the parameters.
        optimizer: the optimiser, whose groups carry "name"; groups named like a tensor of ``splats`` hold just that
            tensor. None when nothing is being trained.
        state: density statistics, each [N, ...].
    """

    splats: Splats
    optimizer: torch.optim.Optimizer | None = None
    state: dict[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.splats)

    def keep(self, mask: Tensor) -> None:
        """Removes the Gaussians where ``mask`` [N] bool is False, with their moments and statistics."""
        rows = mask.nonzero().squeeze(1)
        for name in self.splats.names:
            self._replace(name, lambda tensor: tensor[rows], lambda moment: moment[rows])
        for name, tensor in self.state.items():
            self.state[name] = tensor[rows]

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Adds Gaussians: name -> [n, ...] for every tensor of the splats. Their moments and statistics start at zero.

        Raises:
            KeyError: a tensor of the splats is missing in ``rows``.
        """
        count = rows["means"].shape[0]
        for name in self.splats.names:
            new = rows[name]
            self._replace(
                name,
                lambda tensor, new=new: torch.cat([tensor, new.to(tensor)]),
                lambda moment: torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])]),
            )
        for name, tensor in self.state.items():
            self.state[name] = torch.cat([tensor, tensor.new_zeros(count, *tensor.shape[1:])])

    def overwrite(self, name: str, values: Tensor) -> None:
        """Gives one tensor new values [N, ...] and forgets its moments."""
        self._replace(name, lambda tensor: values.to(tensor), torch.zeros_like)

    def rows(self, ids: Tensor) -> dict[str, Tensor]:
        """Copies of the raw tensors of some Gaussians, to be changed and appended: name -> [n, ...]."""
        return {name: self.splats[name].detach()[ids].clone() for name in self.splats.names}

    @torch.no_grad()
    def _replace(
        self, name: str, change: Callable[[Tensor], Tensor], change_moment: Callable[[Tensor], Tensor]
    ) -> None:
        """Puts ``change(parameter)`` in the parameter's place, everywhere it is known; its moments likewise."""
        old = self.splats.raw[name]
        new = nn.Parameter(change(old.detach()).contiguous(), requires_grad=old.requires_grad)
        self.splats.raw[name] = new
        if self.optimizer is None:
            return
        for group in self.optimizer.param_groups:
            if group.get("name") != name:
                continue
            group["params"] = [new]
            moments = self.optimizer.state.pop(old, None)
            if moments is not None:
                self.optimizer.state[new] = {
                    key: change_moment(value).contiguous() if value.shape == old.shape else value
                    for key, value in moments.items()
                }
