"""Which view a training step sees: a pure function of (seed, step), so that a resumed run repeats nothing."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import torch
from torch.utils.data import Sampler

from heatsplat.training.rng import generator_for


class StepSampler(Sampler[int]):
    """View positions for the steps from ``start_step`` on, without end; every pass over the views is a fresh permutation.

    One epoch of the trainer is the whole run: a DataLoader that restarts with every pass over 50 views would restart in
    the middle of a resumed run as well, and show it other views than an uninterrupted run. The end of
    the run is known to its ``Schedule`` alone.

    Args:
        count: number of training views.
        seed: the run's seed.
        start_step: first step to draw for (``trainer.global_step``).
        restarts: steps at which a pass over the views begins anew, increasing (``Schedule.restarts``): what counts passes
            from the first step of a round is right in every round.
    """

    def __init__(self, count: int, seed: int, start_step: int = 0, restarts: Sequence[int] = ()) -> None:
        if count < 1:
            raise ValueError(f"StepSampler needs at least one view, got {count}")
        self.count = count
        self.seed = seed
        self.start_step = start_step
        self.restarts = tuple(restarts)
        self._epoch = -1
        self._permutation: list[int] = []

    def view_at(self, step: int) -> int:
        """The position of the view that training step ``step`` sees."""
        before, first = 0, 0  # passes that began before this round, and its first step
        for restart in self.restarts:
            if restart <= step:
                before, first = before - (first - restart) // self.count, restart
        epoch, place = divmod(step - first, self.count)
        epoch += before
        if epoch != self._epoch:
            generator = generator_for(self.seed, epoch, "views")
            self._permutation = torch.randperm(self.count, generator=generator).tolist()
            self._epoch = epoch
        return self._permutation[place]

    def __iter__(self) -> Iterator[int]:
        return (self.view_at(step) for step in itertools.count(self.start_step))
