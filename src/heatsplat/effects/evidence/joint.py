"""One robust fit of all effects together: each has to earn its parameters in the presence of the others.

Starting from levels alone, the effect that lowers the Bayesian information criterion

    n log(weighted squares / n) + parameters · log n

most is taken in until none lowers it, and effects that the others make needless are dropped again. Effects that look
alike one by one (a common offset and heating, gain steps and haze, a fixed pattern and vignetting) are told apart by
which of them explains more with less. The criterion needs no noise level; how large an effect is beside the noise is
asked afterwards.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from heatsplat.effects.evidence.fits import LEAST_FREE, SHARED, Fits, Model

WELL_SEEN = 2.5  # observations of a point for each of its own numbers before a driven scene is taken for granted

# What an effect has to gain over the cost of its parameters. Points at edges look different from every place and hence at
# every time, which gives a point's own parameters up to 1.5 on scenes of which it is known that nothing changes.
# A pattern gets up to 1.7 on heated scenes, by how the courses of their points err.
OWN_HURDLE, SHARED_HURDLE = 2.5, 1.3
# An effect whose size is less than this share of the expected error is left out. Points that lie astray go with distance
# and direction a little.
SMALLEST, SMALLEST_PATH = 0.1, 0.2
# In a scene that changes: share of its changes that a sensor's effect must exceed. Where neighbours exchange heat, what the
# courses of points miss looks like a pattern of 0.004 of the changes; true ones of the scenes judged have 0.017 and more.
BESIDE_CHANGES = {
    "harmonic_source": 0.15,
    "agc": 0.1,
    "frame_offset": 0.03,
    "reflection": 0.04,
    "tone": 0.01,
    "fixed_pattern": 0.008,
    "vignetting": 0.008,
}
BESIDE_DRIFT = 0.25  # share of a common offset that other changes must exceed before a still camera
IN_COMMON = 0.15  # share of what half of the points leave that the other half has to explain
BESIDE_WEATHER = 0.2  # of any effect, where a weather record, whose answers are rough, explains the changes
SENSOR_FIRST = ("fixed_pattern", "vignetting", "frame_offset", "tone")
OWN = ("relaxation", "harmonic_source", "view_dependence")


class Joint(Fits):
    """Fits of models to tracks, and the choice among them."""

    def candidates(self, model: Model) -> list[tuple[str, Model]]:
        """Models with one effect more, by its name."""
        found = []
        if (
            self._span > 0
            and "relaxation" not in model.own
            and self._usual_length >= LEAST_FREE + 1 + self._decays.shape[1]
        ):
            found.append(("relaxation", replace(model, own=model.own | {"relaxation"})))
        for count in self.allowed():
            if count > model.courses:
                own = model.own | {"relaxation", "harmonic_source"}
                found.append(("harmonic_source", replace(model, own=own, courses=count)))
        if "view_dependence" not in model.own and self._moves:
            found.append(("view_dependence", replace(model, own=model.own | {"view_dependence"})))
        for name in SHARED:
            if name not in model.shared and self._possible(name):
                found.append((name, replace(model, shared=model.shared | {name})))
        if self.ambient is not None and self._moves:
            kinds = {"": ("constant", "varying"), "constant": ("varying",), "varying": ()}[model.attenuation]
            found += [("attenuation", replace(model, attenuation=kind)) for kind in kinds]
        return found

    def selected(self) -> Model:
        """The model that explains most with least.

        Effects are taken in one at a time, from several starts: from nothing, whichever explains most; those of the sensor
        first; and from a driven scene before an uneven camera, or a cooling one before a still camera that drifts. A change
        of all points in common is cheap as an offset and dear as courses of every point, but the courses explain more at
        once; and where a source and a pattern are at work, neither explains much alone: only the ends of the ways tell
        which was right.
        """
        start = (self.weights, self.trust)
        starts = [(Model(), SENSOR_FIRST), (Model(), ())]
        known = 2 + self._decays.shape[1] if self._span > 0 else 0  # numbers of a point of a driven scene
        if not self._moves and "relaxation" in self.rich.own:
            starts.append((Model(frozenset({"relaxation"}), frozenset({"frame_offset"})), ()))
        if self._moves and "harmonic_source" in self.rich.own and self._usual_length >= WELL_SEEN * known:
            starts.append((replace(self.rich, shared=frozenset({"fixed_pattern"})), ()))
        ends = []
        for begin, first in starts:
            self._restart(start)
            if begin.names():
                self._accept(begin)
                self._accept(begin)
                if not begin.names() <= self._pruned(begin).names():
                    continue
            model = self._grown(self._grown(begin, first), (*SHARED, *OWN, "attenuation"))
            if model not in ends:
                ends.append(model)
        model = min(ends, key=lambda one: self._compared(one, start))
        self._restart(start)
        self._accept(model)
        self._accept(model)
        return self._grown(self._pruned(model), (*SHARED, *OWN, "attenuation"))

    def _compared(self, model: Model, start: tuple[Tensor, Tensor]) -> float:
        self._restart(start)
        for _ in range(2):
            self._known = self.contributions(model)
            self._scenes.clear()
        self.fits.clear()
        return self.fitted(model).bic

    def _restart(self, start: tuple[Tensor, Tensor]) -> None:
        self.weights, self.trust = start
        self._known = {}
        self._scenes.clear()
        self._courses.clear()
        self.fits.clear()

    def _grown(self, model: Model, names: tuple[str, ...]) -> Model:
        """A model with those effects among ``names`` that earn their place, and without those that no longer do."""
        seen = {model}
        for _ in range(12):
            tried = [(name, more) for name, more in self.candidates(model) if name in names]
            found = [more for name, more in tried if self.earns(more, model, name)]
            best = min(found, key=lambda more: self.fitted(more).bic, default=None)
            if best is None or self.fitted(best).bic >= self.fitted(model).bic:
                break
            model = self._pruned(best)
            self._accept(model)
            if model in seen:
                break
            seen.add(model)
        return self._pruned(model)

    def earns(self, more: Model, less: Model, name: str) -> bool:
        """Whether an effect explains enough for what its parameters cost, and is large enough."""
        hurdle = OWN_HURDLE if name in (*OWN, "fixed_pattern") else SHARED_HURDLE
        return self.gain(more, less) > hurdle and self.worthwhile(more, less, name)

    def worthwhile(self, more: Model, less: Model, name: str) -> bool:
        """Whether what an effect adds is large enough beside the noise, and beside what the scene does by itself: how a
        model of the scene's changes errs is easily taken for a small flaw of the sensor."""
        size = self.effect_size(more, less)
        if size < (SMALLEST_PATH if name in ("attenuation", "reflection") else SMALLEST):
            return False
        if name in ("relaxation", "harmonic_source") and not self._moves and not self._beyond_drift(more):
            return False
        if name in ("agc", "frame_offset") and self._may_change(less) and not self._in_common(more, less):
            return False
        if "relaxation" not in less.own:
            return True
        share = BESIDE_CHANGES.get(name, 0.0) if self.drivers is None else BESIDE_WEATHER
        return size > share * self.effect_size(less, less.without("relaxation"))

    def _may_change(self, model: Model) -> bool:
        return self.drivers is not None or "relaxation" in model.own

    def _beyond_drift(self, model: Model) -> bool:
        """Whether a still camera sees more than its own drift. Surfaces do not all change alike; a drift is one offset of
        the whole image, and leaves a pattern of its own that is small beside it."""
        drift = Model(shared=frozenset({"frame_offset"}))
        beyond = self.effect_size(replace(model, shared=model.shared | drift.shared), drift)
        return beyond > BESIDE_DRIFT * self.effect_size(drift, Model())

    def _in_common(self, more: Model, less: Model) -> bool:
        """Whether what the points that change most say of every image holds for those that change least, and conversely.

        A sensor changes all points alike; a lamp does not.
        """
        weights, values = self.weights, self.tracks.values
        used = weights > 0
        mean = (values * used).sum(1) / used.sum(1).clamp_min(1)
        change = (((values - mean[:, None]) ** 2 * used).sum(1) / used.sum(1).clamp_min(1)).sqrt()
        loud = change > change[used.any(1)].median()
        before = self.weights * self.residuals(less) ** 2 / self.trust[:, None]
        _, basis, _ = self._own(more)
        for known, asked in ((loud, ~loud), (~loud, loud)):
            self.weights = weights * known[:, None]
            added = sum(self.contributions(more).values())
            self.weights = weights
            left = self._own(more)[0] - added
            after = weights * (left - self._own_part(basis, left)) ** 2 / self.trust[:, None]
            if float(after[asked].sum()) > (1.0 - IN_COMMON) * float(before[asked].sum()):
                return False
        return True

    def _pruned(self, model: Model) -> Model:
        while True:
            idle = [name for name in sorted(model.names()) if not self.earns(model, model.without(name), name)]
            if not idle:
                return model
            model = model.without(min(idle, key=lambda name: self.gain(model, model.without(name))))

    def _accept(self, model: Model) -> None:
        """Makes a model the one about which products of effects are linearised."""
        self._known = self.contributions(model)
        self.weigh(model)

    def why_not(self, name: str) -> str:
        """Why no model has an effect."""
        if name in ("relaxation", "harmonic_source"):
            return "all frames show one moment" if self._span <= 0 else "points are seen in too few frames"
        if name == "tone":
            return "no offset moves the levels along a curve"
        return "points are seen from one side only" if name != "reflection" else "the points show no surface"

    def _possible(self, name: str) -> bool:
        """Whether the tracks can show a shared effect: nobody tells the pattern of a camera that stands still from the
        scene."""
        if name == "tone":
            return "frame_offset" in self._known
        return name in ("frame_offset", "agc") or (self._moves and (name != "reflection" or self.normals is not None))
