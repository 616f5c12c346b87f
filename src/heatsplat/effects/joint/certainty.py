"""Whether images tell what the joint fit says of an effect: what it gains where it was not fitted, beside what chance gains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.held_out import HeldOut, compared, shuffled, squares_of
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import grown, worthwhile
from heatsplat.training.rng import generator_for

# What an effect must bring on held-out observations: less is no loss, and within the scatter of the images it is chance.
MIN_DB, MIN_SIGMAS = 0.3, 3.5
SHUFFLES, NO_CHANCE = 8, 30.0  # gains from which it is not asked whether chance makes as much
# Nine tenths of the points in the most even third are explained to within so many times the expected error: nothing is left
# for another effect. At edges poses err.
EXPLAINED, OF_POINTS, EVEN = 1.6, 0.9, 0.33


@dataclass(frozen=True)
class Worth:
    """What is known of an effect that was taken in.

    Args:
        held_out: what it gains on held-out observations.
        doubt: why nobody can tell whether it is there, and what would be needed; empty where it can be told.
    """

    held_out: HeldOut
    doubt: str = ""


class Certainty:
    """What can be told from a joint fit.

    Args:
        fit, model: what was selected.
    """

    def __init__(self, fit: Fit, model: Model) -> None:
        self.fit, self.model = fit, model
        self._squares: dict[Model, Tensor] = {}
        self._worths: dict[tuple[Model, Model], Worth] = {}

    @cached_property
    def doubts(self) -> dict[str, str]:
        """Why nobody can tell whether an effect is there, by name: of those taken in, and of those that may be there instead."""
        found = {name: self.worth(name).doubt for name in sorted(self.model.names)}
        found = {name: doubt for name, doubt in found.items() if doubt}
        for name in sorted(self.model.names):
            for rivals in self.fit.data.effects[name].term.rivals:
                if self._outdoes(name, rivals):
                    continue
                found[name] = f"{' and '.join(rivals)} would explain the images as well; more frames would tell"
                for rival in set(rivals) - self.model.names:
                    found.setdefault(rival, f"it would explain the images as well as {name}")
        if not found:
            return found
        names = " and ".join(name for name in found if name in self.model.names)
        for name in self._instead_of(found):
            found.setdefault(name, f"it goes or comes with {names}, which nobody can tell from these images")
        return found

    def worth(self, name: str, more: Model | None = None, less: Model | None = None) -> Worth:
        """What is known of an effect; ``more`` and ``less`` are the models with and without it, those of the selection."""
        more = self.model if more is None else more
        less = self.fit.without(more, name) if less is None else less
        if (more, less) not in self._worths:
            held_out = compared(self._squares_of(more), self._squares_of(less), self.fit.weights)
            self._worths[more, less] = Worth(held_out, self._doubt(name, more, less, held_out))
        return self._worths[more, less]

    def undecided(self, more: Model, name: str) -> bool:
        """Whether an effect that was left out is worth what it costs, though not by enough to be taken in."""
        return self.fit.gain(more, self.model) > 1.0 and worthwhile(self.fit, more, self.model, name)

    @cached_property
    def explained(self) -> bool:
        """Whether the model leaves nothing but the errors that are to be expected."""
        fit, used = self.fit, self.fit.data.tracks.weights
        values, basis = fit.own(self.model)
        values = values - sum(fit.contributions(self.model).values())
        left = (
            values - own_part(basis, values, used / fit.errors**2)
        ) / fit.errors  # distrusted points have to fit as well
        free = (used.sum(1) - basis.shape[2]).clamp_min(1.0)
        left = ((left**2 * used).sum(1) / free).sqrt()
        slopes = (fit.data.tracks.slopes * used).sum(1) / used.sum(1).clamp_min(1.0)
        return bool(left[slopes <= slopes.quantile(EVEN)].quantile(OF_POINTS) < EXPLAINED)

    def few(self, name: str) -> str:
        """That the record has too few frames to tell an effect, and how many are needed; empty where it has enough."""
        return "" if self.explained else self._lacking(name)

    @cached_property
    def unseen_changes(self) -> str:
        """That the scene may change in ways that the record has too few frames to follow; empty where it cannot."""
        effects = self.fit.data.effects.items()
        changing = [name for name, one in effects if one.term.in_time and name not in self.model.names]
        why = [(name, lacking) for name in changing if (lacking := self._lacking(name))]
        return f"it may as well be {' or '.join(name for name, _ in why)}: {why[-1][1]}" if why else ""

    def _lacking(self, name: str) -> str:
        data = self.fit.data
        needed = data.effects[name].term.frames(data)
        if data.usual_length >= needed:
            return ""
        return f"of {data.frames} frames {data.usual_length:.0f} see a point, and {needed} are needed"

    def _doubt(self, name: str, more: Model, less: Model, held_out: HeldOut) -> str:
        fit, term = self.fit, self.fit.data.effects[name].term
        if self.unseen_changes and not term.in_time and not self.explained:
            return self.unseen_changes
        if not all(rule(fit, more, less) for rule in term.told_by):
            return "what images have in common is not common to all points; more frames would tell heat from the camera"
        if held_out.sigmas < MIN_SIGMAS and held_out.db > 0:
            needed = math.ceil(held_out.images * (MIN_SIGMAS / max(held_out.sigmas, 0.5)) ** 2)
            return f"what it gains scatters over the images as much as chance would; about {needed} frames would tell"
        if held_out.db < MIN_DB:
            return f"{held_out.db:.1f} dB on what was left out are no gain; more frames, or less noise, would tell"
        gain = fit.gain(more, less)
        start = fit.linearised(less)
        for k in range(SHUFFLES if gain < NO_CHANCE else 0):
            chance = shuffled(start, less, generator_for(0, k, f"shuffled {name}"), not term.single_images)
            if chance.gain(more, less) > gain:
                return "images that are shuffled gain as much; more frames, or less noise, would tell"
        return ""

    def _outdoes(self, name: str, rivals: tuple[str, ...]) -> bool:
        """Whether a selected effect is clearly better than others in its place; so it is where those cannot be had."""
        other = self.fit.without(self.model, name)
        if set(rivals) <= other.names:
            return True
        fit = self.fit.linearised(other)
        for rival in (one for one in rivals if one not in other.names):
            kinds = fit.data.effects[rival].term.kinds(fit) if rival in fit.data.effects else ()
            if not kinds:
                return True
            other = other.plus(rival, kinds[-1])
            fit = fit.linearised(other)
        gain = compared(self._squares_of(self.model), self._squares_of(other), self.fit.weights)
        return gain.db > MIN_DB and gain.sigmas > MIN_SIGMAS

    def _instead_of(self, doubts: dict[str, str]) -> set[str]:
        """Effects that come or go when those that are doubted go: heat and cameras change images alike."""
        effects, less = self.fit.data.effects, self.model
        for name in doubts:
            less = self.fit.without(less, name)
        _, other = grown(self.fit.accepted(less), less, [name for name in effects if name not in doubts])
        found = set(other.names ^ self.model.names)
        if any(effects[name].term.single_images for name in doubts):
            found |= {name for name, one in effects.items() if one.term.in_time}
        if any(effects[name].term.in_time for name in doubts):
            found |= {name for name, one in effects.items() if one.term.single_images}
        return found

    def _squares_of(self, model: Model) -> Tensor:
        if model not in self._squares:
            self._squares[model] = squares_of(self.fit.linearised(model).linearised(model), model)
        return self._squares[model]
