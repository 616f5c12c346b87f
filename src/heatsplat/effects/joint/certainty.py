"""Whether images tell what the joint fit says of an effect: what it gains where it was not fitted, beside what chance gains."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from torch import Tensor

from heatsplat.effects.joint.courses import ANY, common_courses
from heatsplat.effects.joint.data import MIN_FREE
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.foreseen import holds_still
from heatsplat.effects.joint.held_out import HeldOut, compared, shows, shuffled, squares_of, would_tell
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.like_heat import may_be_heat
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import candidates, grown, worthwhile
from heatsplat.effects.joint.terms import Own
from heatsplat.training.rng import generator_for

# What an effect must bring on held-out observations: less is no loss, and within the scatter of the images it is chance.
MIN_DB, MIN_SIGMAS = 0.3, 3.5
SHUFFLES, NO_CHANCE = 8, 30.0  # gains from which it is not asked whether chance makes as much
# Nine tenths of the points in the most even third are explained to within so many times the expected error: nothing is left
# for another effect. At edges poses err.
EXPLAINED, OF_POINTS, EVEN = 1.6, 0.9, 0.33

ROUGH = "heat that goes another way than the weather record says may do it; more frames would tell"
COURSES = 2  # that points share stand for any change of a scene


@dataclass(frozen=True)
class AnyChange:
    """In the joint fit in the place of an effect: courses over time of which each point has its own measure."""

    term: Own
    stands_on: None = None


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
        told: by name of an effect in it, what something that knows more says (``heat_source.Known``): why nobody can tell
            whether it is there; empty where it is.
    """

    def __init__(self, fit: Fit, model: Model, told: Mapping[str, str] | None = None) -> None:
        change = AnyChange(
            Own(basis=lambda at, count: common_courses(at, Model(), count), kinds=lambda at: (), in_time=True)
        )
        self.fit = replace(fit, data=replace(fit.data, effects={**fit.data.effects, ANY: change}))
        self.model, self.told = model, told or {}
        self.sure = frozenset(name for name, doubt in self.told.items() if not doubt)
        self._squares: dict[Model, Tensor] = {}
        self._worths: dict[tuple[Model, Model], Worth] = {}

    @cached_property
    def doubts(self) -> dict[str, str]:
        """Why nobody can tell whether an effect is there, by name: of those taken in, and of those that may be there instead."""
        found = self._own_doubts()
        found |= self._unclear_without(found)
        for name, rivals in self._equals():
            found[name] = f"{' and '.join(rivals)} would explain the images as well; more frames would tell"
            for rival in set(rivals) - self.model.names:
                found.setdefault(rival, f"it would explain the images as well as {name}")
        doubted = sorted(found.keys() & self.model.names)
        why = f"it goes or comes with {' and '.join(doubted)}, which nobody can tell from these images"
        for name in self._instead_of(doubted):
            found.setdefault(name, why)
        heat = {name for name in found if self._in_time(name)}
        followed = not heat & self.model.names and not any(self._lacking(name) for name in heat)
        if heat and followed and self.fit.data.drivers is None and holds_still(self.fit, self.model, doubted):
            found = {name: doubt for name, doubt in found.items() if name not in heat}
        return {name: doubt for name, doubt in found.items() if name not in self.sure}

    def _own_doubts(self) -> dict[str, str]:
        """Why nobody can tell of an effect that was taken in, by itself."""
        own = {
            name: self.told[name] if name in self.told else self.worth(name).doubt for name in sorted(self.model.names)
        }
        return {name: doubt for name, doubt in own.items() if doubt}

    def _unclear_without(self, doubts: Mapping[str, str]) -> dict[str, str]:
        """Why nobody can tell of effects of the camera that are clear only beside those that are doubted."""
        others, found = self.model.minus(doubts), {}
        for name in sorted(others.names - self.sure) if doubts else ():
            clear = self._in_time(name) or self._beside_changes(name, others, self.fit.without(others, name))
            if not clear:
                found[name] = self._may_be_change(name) or ROUGH
        return found

    def _equals(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Effects that were taken in and count, each with rivals in whose place it is not clearly better."""
        for name in sorted(self.model.names - self.sure):
            for rivals in self.fit.data.effects[name].term.rivals:
                if self._counts(name) and not self._outdoes(name, rivals):
                    yield name, rivals

    def _in_time(self, name: str) -> bool:
        """Whether an effect is one by which the scene changes."""
        return self.fit.data.effects[name].term.in_time

    def idle(self, name: str, more: Model, less: Model) -> bool:
        """Whether nothing is lost without an effect: it gains nothing on held-out observations, nor does any course over time in
        its place; or it is a camera's change of single images that gains little and fails what such a change has to meet."""
        if name in self.sure:
            return False
        worth, term = self.worth(name, more, less), self.fit.data.effects[name].term
        if term.in_time:
            return not shows(worth.held_out) and not any(self._shows(one, less) for one in self._changing(less))
        return not shows(worth.held_out) or term.single_images and bool(worth.doubt) and worth.held_out.db < MIN_DB

    def _counts(self, name: str) -> bool:
        """Whether a selected effect gains so much on held-out observations that something would have to take its place."""
        return self.compared(self.model, self.fit.without(self.model, name)).db > MIN_DB

    def worth(self, name: str, more: Model | None = None, less: Model | None = None) -> Worth:
        """What is known of an effect; ``more`` and ``less`` are the models with and without it, those of the selection."""
        more = self.model if more is None else more
        less = self.fit.without(more, name) if less is None else less
        if (more, less) not in self._worths:
            held_out = self.compared(more, less)
            self._worths[more, less] = Worth(held_out, self._doubt(name, more, less, held_out))
        return self._worths[more, less]

    def undecided(self, more: Model, name: str) -> bool:
        """Whether an effect that was left out is worth what it costs, though not by enough to be taken in, and may explain
        observations that it was not fitted to."""
        worth = self.fit.gain(more, self.model) > 1.0 and worthwhile(self.fit, more, self.model, name)
        return worth and self._shows(more, self.model)

    def clear(self, more: Model, name: str) -> bool:
        """Whether an effect that was left out for its size is clear on held-out observations, and no small thing but beside what
        the scene does by itself."""
        large = self.fit.effect_size(more, self.model) >= self.fit.data.effects[name].term.smallest
        return large and self._is_clear(more, self.model) and self._beside_changes(name, more, self.model)

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

    @cached_property
    def changes(self) -> bool:
        """Whether courses over time explain what was left out beside the model, or cannot be asked for."""
        changing = self._changing(self.model)
        return not changing or any(self._shows(one, self.model) for one in changing)

    @cached_property
    def may_warm(self) -> bool:
        """Whether points are lit or cool, or nobody can tell whether they do."""
        heat = [name for name, one in self.fit.data.effects.items() if one.term.in_time and name != ANY]
        return self.fit.data.balances is not None or any(
            name in self.model.names or name in self.doubts or self.few(name) for name in heat
        )

    def few(self, name: str) -> str:
        """That the record has too few frames to tell an effect that was left out, and how many are needed; empty where it has
        enough, and where nothing is left that it could explain."""
        lacking, in_time = self._lacking(name), self.fit.data.effects[name].term.in_time
        if not lacking:
            return ""
        if in_time and any(one in self.doubts and self._counts(one) for one in self._of_single_images):
            return lacking  # heat may be in its place
        if self.explained:
            return ""
        if in_time:
            return lacking if self.changes else ""
        tried = [more for other, more in candidates(self.fit, self.model) if other == name]
        return lacking if not tried or any(self._shows(more, self.model) for more in tried) else ""

    @cached_property
    def unseen_changes(self) -> str:
        """That the scene may change in ways that the record has too few frames to follow; empty where it cannot."""
        return self._unfollowed if not self.explained and self.changes else ""

    @cached_property
    def _unfollowed(self) -> str:
        """In which ways a scene may change that the record has too few frames to follow; empty where it can follow all."""
        effects = self.fit.data.effects.items()
        changing = [name for name, one in effects if one.term.in_time and name not in self.model.names]
        why = [(name, lacking) for name in changing if (lacking := self._lacking(name))]
        if not why:
            return ""
        return f"it may as well be {' or '.join(name for name, _ in why)}: {why[-1][1]}"

    @property
    def _of_single_images(self) -> list[str]:
        """Names of the effects that were taken in and whose numbers belong to single images."""
        return [name for name in self.model.names if self.fit.data.effects[name].term.single_images]

    def _lacking(self, name: str) -> str:
        data = self.fit.data
        needed = data.effects[name].term.frames(data)
        if data.usual_length >= needed:
            return ""
        return f"of {data.frames} frames {data.usual_length:.0f} see a point, and {needed} are needed"

    def beside_weather(self, model: Model) -> Model:
        """The model in a scene that changes in any way, where a weather record says roughly in which."""
        return [model, *(self._changing(model) if self.fit.data.rough else ())][-1]

    def _changing(self, model: Model) -> list[Model]:
        """The model in a scene that changes in any way, with one common course and with more; none where points are seen in too
        few frames to ask that."""
        free = int(self.fit.data.usual_length) - self.fit.own_basis(model).shape[2] - MIN_FREE
        return [model.plus(ANY, count) for count in range(1, min(free, COURSES) + 1)]

    def _is_clear(self, more: Model, less: Model) -> bool:
        """Whether one model explains what was left out clearly better than another."""
        return self.compared(more, less).exceeds(MIN_DB, MIN_SIGMAS)

    def _shows(self, more: Model, less: Model) -> bool:
        return shows(self.compared(more, less))

    def compared(self, more: Model, less: Model) -> HeldOut:
        """What one model gains over another on observations that neither was fitted to."""
        return compared(self._squares_of(more), self._squares_of(less), self.fit.weights)

    def _beside_changes(self, name: str, more: Model, less: Model) -> bool:
        """Whether an effect is clear however the scene may change, where its changes are not known well: a camera's change of
        single images explains them as well as any course over time of which each point has its own measure would, and other
        effects gain beside that."""
        unfollowed, rough = self._may_be_change(name), self.fit.data.rough
        if ANY in less.names or not rough and not unfollowed:
            return True
        changing = self._changing(less)
        if self.fit.data.effects[name].term.single_images:
            if unfollowed and rough:
                return False  # surfaces under the sky change alike
            return bool(changing) and all(self.compared(more, one).db > 0 for one in changing)
        return bool(changing) and all(self._is_clear(more.plus(ANY, one.kind(ANY)), one) for one in changing)

    def _may_be_change(self, name: str) -> str:
        """That a change of the scene which the record cannot follow may pass for an effect; empty where none can. What single
        images have in common may be one however well it explains them."""
        return self._unfollowed if self.fit.data.effects[name].term.single_images else self.unseen_changes

    def _doubt(self, name: str, more: Model, less: Model, held_out: HeldOut) -> str:
        fit, term = self.fit, self.fit.data.effects[name].term
        if not term.in_time and not self._beside_changes(name, more, less):
            return self._may_be_change(name) or ROUGH
        if may_be_heat(self.fit, self.model, name):
            return "it goes over time as a scene may that cools or warms; frames that come back to a place later would tell"
        for rule, why in term.told_by:
            if not rule(fit, more, less):
                return why
        if held_out.sigmas < MIN_SIGMAS and held_out.db > 0:
            more_frames = would_tell(held_out, MIN_SIGMAS)
            return f"what it gains scatters over the images as much as chance would; {more_frames}"
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
        in_time = any(one in rivals and effect.term.in_time for one, effect in self.fit.data.effects.items())
        if in_time and not all(self._is_clear(self.model, one) for one in self._changing(other)):
            return False
        fit = self.fit.linearised(other)
        for rival in (one for one in rivals if one not in other.names):
            kinds = fit.data.effects[rival].term.kinds(fit) if rival in fit.data.effects else ()
            if not kinds:
                return True
            other = other.plus(rival, kinds[-1])
            fit = fit.linearised(other)
        return self._is_clear(self.model, other)

    def _instead_of(self, doubts: Collection[str]) -> set[str]:
        """Effects that come or go when those that are doubted go, and explain about as much: heat and cameras change images
        alike."""
        if not doubts:
            return set()
        less = self.model
        for name in doubts:
            less = self.fit.without(less, name)
        counts = any(self._counts(name) for name in doubts)
        found = self._in_place_of(doubts, less) if counts else set()
        if self._heat_may_be_there(doubts, less, counts):
            found |= {name for name in self.fit.data.effects if self._in_time(name)} - {ANY, *self.model.names}
        return found

    def _in_place_of(self, doubts: Collection[str], less: Model) -> set[str]:
        """Effects that come or go where a model is selected anew without those that are doubted (``less``), and that explain
        about as much."""
        start = self.fit.accepted(less)
        _, other = grown(start, less, [name for name in self.fit.data.effects if name not in doubts])
        found = set() if self._is_clear(self.model, other) else set(other.names ^ self.model.names)
        for name, more in candidates(start, less):
            asked = name not in self.model.names | found
            if asked and start.gain(more, less) > 1.0 and worthwhile(start, more, less, name):
                found |= set() if self._is_clear(self.model, more) else {name}
        return found

    def _heat_may_be_there(self, doubts: Collection[str], less: Model, counts: bool) -> bool:
        """Whether heat may be in the place of effects that are doubted.

        Args:
            less: the model without them.
            counts: whether any of them gains so much that something would have to take its place.
        """
        there = self._shows if counts else self._is_clear
        # What gains little, and is none of single images, gives no way to heat that shows as clearly beside it.
        small = not counts and not any(self.fit.data.effects[name].term.single_images for name in doubts)
        if small and any(there(one, self.model) for one in self._changing(self.model)):
            return False
        changing = self._changing(less)
        if not changing or any(may_be_heat(self.fit, self.model, name) for name in doubts):
            return True
        return any(there(one, less) and not self._is_clear(self.model, one) for one in changing)

    def _squares_of(self, model: Model) -> Tensor:
        if model not in self._squares:
            self._squares[model] = squares_of(self.fit.linearised(model).linearised(model), model)
        return self._squares[model]
