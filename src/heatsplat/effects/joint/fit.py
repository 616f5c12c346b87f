"""The state of the joint fit: what an observation counts, and about what products of effects are linearised.

A state never changes. ``weighed``, ``linearised`` and ``accepted`` return a new one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from heatsplat.effects.base import Effect
from heatsplat.effects.joint import least_squares
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.terms import Own, Path, Shared
from heatsplat.physics.noise import MAD_TO_SIGMA

OUTLIER = 5.0  # an observation this many times the usual residual away counts nothing (Tukey's weights)
DISTRUSTED = 0.15  # share of the points, those that are fitted worst, that is left out: edges and hidden points
# No fit is taken to be better than this, in squares of the expected error: a value between four pixels is less noisy.
FLOOR = 0.1
# Error of a point's place in an image. Structure from motion reports 0.4 pixels at most; below a twentieth nothing depends
# on it.
MIN_ERROR_PX, MAX_ERROR_PX = 0.05, 0.4
MEDIAN_OF_CHI2 = 0.455  # of one degree of freedom
ROUNDS = 3  # of fitting each of several paths beside the others
LEAST_SHARE = 1e-3  # that arrives, where what was sent is asked for
FEW = 4.0  # how many observations the usual residual counts for beside a point's own


@dataclass(frozen=True)
class Quality:
    """How well a model explains the tracks.

    Args:
        squares: sum of squared residuals in units of the errors to be expected.
        parameters: how many numbers it has.
        cost: what the criterion asks for them.
        bic: the criterion.
    """

    squares: float
    parameters: float
    cost: float
    bic: float


@dataclass(frozen=True, eq=False)
class Fit:
    """Fits of models to tracks.

    Args:
        data: what is explained.
        errors: [P, F] that are to be expected.
        weights: [P, F] inverse squares of them, less where an observation is an outlier.
        trust: [P] variance of a point beyond its errors; it counts less by that.
        known: [P, F] by name of a shared effect: what it adds, where products of effects are linearised.
        bases: [F, k] or [P, F, k] by effect and kind, worked out so far.
    """

    data: Data
    errors: Tensor
    weights: Tensor
    trust: Tensor
    known: Mapping[str, Tensor] = field(default_factory=dict)
    bases: dict[tuple[str, object], Tensor] = field(default_factory=dict)
    _images: dict[Model, Tensor] = field(default_factory=dict, init=False)
    _qualities: dict[Model, Quality] = field(default_factory=dict, init=False)
    _passing: dict[Model, dict[str, Tensor]] = field(default_factory=dict, init=False)

    # Models ---------------------------------------------------------------------------------------------------

    def terms(self, model: Model, kind: type) -> dict[str, Effect]:
        """The effects of a model whose terms are of this class; shared ones in the order in which they act."""
        found = {n: e for n, e in self.data.effects.items() if n in model.names and isinstance(e.term, kind)}
        return dict(sorted(found.items(), key=lambda item: item[1].term.order)) if kind is Shared else found

    def without(self, model: Model, name: str) -> Model:
        """The model that lacks an effect, and those that stand on it."""
        return model.minus({name, *(other for other, e in self.data.effects.items() if e.stands_on == name)})

    def at_rest(self, model: Model) -> Model:
        """The model that lacks the effects by which a scene changes."""
        return model.minus([name for name, effect in self.terms(model, Own).items() if effect.term.in_time])

    def may_change(self, model: Model) -> bool:
        """Whether the scene of a model changes."""
        return self.data.drivers is not None or self.at_rest(model) != model

    # How well they fit ----------------------------------------------------------------------------------------

    @property
    def observations(self) -> int:
        """How many observations count."""
        return int((self.weights > 0).sum())

    def quality(self, model: Model) -> Quality:
        """How well a model explains the tracks; worked out once."""
        if model not in self._qualities:
            self._qualities[model] = self._quality(model)
        return self._qualities[model]

    def gain(self, more: Model, less: Model) -> float:
        """What the larger of two models gains over the smaller: drop of the criterion's first term over what its
        additional parameters cost. Above 1 it is worth them; about 1 / log n if it explains noise alone."""
        a, b = self.quality(more), self.quality(less)
        cost = a.cost - b.cost
        return 1.0 + (b.bic - a.bic) / cost if cost > 0 else 0.0

    def effect_size(self, more: Model, less: Model) -> float:
        """Root mean square over the observations of what the larger of two models explains and the smaller cannot,
        in units of the errors expected; what its parameters explain of mere noise is taken away."""
        n, a, b = self.observations, self.quality(more), self.quality(less)
        noise = a.squares / max(n - a.parameters, 1)
        return math.sqrt(max(b.squares - a.squares - noise * (a.parameters - b.parameters), 0.0) / max(n, 1))

    def _quality(self, model: Model) -> Quality:
        """Every point has a noise of its own: a tenth of bad points must not decide for all."""
        squares, counts, size = self._squares(model)
        used = counts > 0
        variances = _variances(squares, counts, size)[used]
        lengths = counts[used].clamp(max=size).double()
        effects = self.data.effects
        shared = sum(effects[name].term.numbers(self.data, model.kind(name)) for name in effects if name in model.names)
        # What a point's own number is worth depends on the observations of that point, not on all.
        cost = float((lengths * counts[used].double().log()).sum()) + shared * math.log(max(self.observations, 3))
        bic = float((counts[used] * variances.log()).sum()) + cost
        return Quality(float((squares / self.trust).sum()), float(lengths.sum()) + shared, cost, bic)

    def variances(self, model: Model) -> Tensor:
        """What a model leaves of each point's values, [P] in squares of the errors expected."""
        return _variances(*self._squares(model))

    def _squares(self, model: Model) -> tuple[Tensor, Tensor, int]:
        """Of each point [P] the weighted squares that a model leaves and how many observations count, and the numbers it has."""
        left = self.residuals(model)
        return (self.weights * left**2).sum(1), (self.weights > 0).sum(1), self.own(model)[1].shape[2]

    # What they make of the values -----------------------------------------------------------------------------

    def own(self, model: Model, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What points' own parts have to explain [P, F], and their basis [P, F, k] as it arrives at the camera."""
        values, basis = self.data.tracks.values, self.own_basis(model)
        if self.terms(model, Path):  # the surroundings shine through what a path takes away
            shares = self._passed(model) if weights is None else self._shares(model, weights)
            values, basis = values - self.data.ambient, math.prod(shares.values())[..., None] * basis
        return values, basis

    def before_path(self, model: Model, name: str) -> tuple[Tensor, Tensor, Tensor]:
        """What one path of a model is fitted to: the excess [P, F] over the surroundings without other paths and what is known
        of shared effects, the points' own basis [P, F, k], and weights [P, F]."""
        return self._before(self._passed(model), model, name, self.weights)

    def _passed(self, model: Model) -> dict[str, Tensor]:
        """``_shares`` by the weights of this state, which effects that are not the points' own do not change; worked out once."""
        key = model.minus(self.terms(model, Shared))
        if key not in self._passing:
            self._passing[key] = self._shares(key, self.weights)
        return self._passing[key]

    def _shares(self, model: Model, weights: Tensor) -> dict[str, Tensor]:
        """By name of a path, the share [P, F] of the excess over the surroundings that it lets pass."""
        paths, shares = self.terms(model, Path), {}
        for _ in range(1 if len(paths) < 2 else ROUNDS):
            for name, effect in paths.items():
                shares[name] = effect.term.passing(self, model.kind(name), *self._before(shares, model, name, weights))
        return shares

    def _before(
        self, shares: Mapping[str, Tensor], model: Model, name: str, weights: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        excess = self.data.tracks.values - self.data.ambient - sum(self.known.values())
        for share in (share for other, share in shares.items() if other != name):
            excess, weights = excess / share.clamp_min(LEAST_SHARE), weights * share**2
        return excess, self.own_basis(model), weights

    def own_basis(self, model: Model) -> Tensor:
        """The points' own basis [P, F, k] before the path: a level and the bases of a model's effects."""
        points, frames = self.data.tracks.values.shape
        parts = [torch.ones(frames, 1, dtype=self.weights.dtype)]
        parts += [] if self.data.balances is None else [self.data.balances]
        parts += [self.basis(name, model.kind(name)) for name in self.terms(model, Own)]
        if any(part.ndim == 3 for part in parts):
            return torch.cat([part.expand(points, -1, -1) for part in parts], 2)
        return torch.cat(parts, 1).expand(points, -1, -1)

    def basis(self, name: str, kind: object) -> Tensor:
        """The basis of an effect, [F, k] or [P, F, k]."""
        if (name, kind) not in self.bases:
            self.bases[name, kind] = self.data.effects[name].term.basis(self, kind)
        return self.bases[name, kind]

    def image(self, model: Model) -> Tensor:
        """The points' own part [P, F] as it arrives at the camera, apart from what is known to be of shared effects."""
        key = model.minus(self.terms(model, Shared))
        if key not in self._images:
            values, basis = self.own(key)
            clean = least_squares.own_part(basis, values - sum(self.known.values()), self.weights)
            self._images[key] = clean + (self.data.ambient if self.terms(model, Path) else 0.0)
        return self._images[key]

    def shared_columns(self, model: Model, known: Mapping[str, Tensor] | None = None) -> dict[str, Columns]:
        """The columns of the shared effects of a model.

        What multiplies an image multiplies the points' own part of it and what earlier effects of the sensor, as far as
        the model has them, added to that: were it the values themselves, a gain per frame would explain everything.
        """
        known = self.known if known is None else known
        image, columns = self.image(model), {}
        for name, effect in self.terms(model, Shared).items():
            columns[name] = effect.term.columns(self.data, image, known)
            image = image + known.get(name, 0.0)
        return columns

    def gram(self, basis: Tensor, columns: Columns, weights: Tensor | None = None) -> Tensor:
        """Inner products [c, c] of columns with what the points' own bases [P, F, k] can say taken away."""
        weights = self.weights if weights is None else weights
        return least_squares.gram(basis, columns, weights / self.trust[:, None])

    def contributions(
        self, model: Model, weights: Tensor | None = None, known: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """What each shared effect of a model adds to the values [P, F].

        Args:
            model: that is fitted.
            weights: [P, F] by which it is fitted, this state's where None.
            known: about which it is linearised, this state's where None.
        """
        known = self.known if known is None else known
        columns = self.shared_columns(model, known)
        if not columns:
            return {}
        values, basis = self.own(model, weights)
        products = self.gram(basis, Columns.joined([Columns.dense(values[..., None]), *columns.values()]), weights)
        parts = least_squares.shared_weights(products).split([block.count for block in columns.values()])
        numbers = dict(zip(columns, parts, strict=True))
        terms = {name: self.data.effects[name].term for name in columns}
        added = {name: block @ terms[name].settled(numbers[name]) for name, block in columns.items()}
        for gain in (name for name in columns if terms[name].gain):
            # What all images gain alike of what earlier effects added is theirs.
            for name in added.keys() & known.keys():
                if terms[name].order < terms[gain].order:
                    added[name] = added[name] + numbers[gain].mean() * known[name]
        return added

    def residuals(self, model: Model, known: Mapping[str, Tensor] | None = None) -> Tensor:
        """What a model leaves of the values [P, F], in image units."""
        values, basis = self.own(model)
        values = values - sum(self.contributions(model, known=known).values())
        return values - least_squares.own_part(basis, values, self.weights)

    # The next state -------------------------------------------------------------------------------------------

    def weighed(self, model: Model, known: Mapping[str, Tensor] | None = None) -> Fit:
        """The state that weighs observations by how well a model explains them and their point: outliers not at all, and a
        point by its own residuals (those at edges and those that others hide are explained by nothing)."""
        tracks = self.data.tracks
        off = self.residuals(model, known).abs() / self.errors
        usual = max(MAD_TO_SIGMA * float(off[self.weights > 0].median()), math.sqrt(FLOOR))
        own = (MAD_TO_SIGMA * _median(off, tracks.weights > 0)).clamp_min(usual)
        robust = (1.0 - (off / (OUTLIER * own[:, None])) ** 2).clamp_min(0.0) ** 2 * tracks.weights
        free = (robust.sum(1) - self.own(model)[1].shape[2]).clamp_min(1.0)
        excess = ((robust * off**2).sum(1) + FEW * usual**2) / (free + FEW)
        seen = tracks.weights.sum(1).clamp_min(1.0)
        trusted = (own <= own.quantile(1.0 - DISTRUSTED)) & ((robust > 0).sum(1) > 0.6 * seen)
        weights = robust / self.errors**2 * trusted[:, None]
        return Fit(self.data, self.errors, weights, excess.clamp_min(FLOOR), self.known if known is None else known)

    def linearised(self, model: Model) -> Fit:
        """The state in which products of effects are linearised about a model; its bases stay."""
        return replace(self, known=self.contributions(model), bases=self._bases_of(model))

    def accepted(self, model: Model) -> Fit:
        """The state that is linearised about a model and weighed by it."""
        return self.weighed(model, self.contributions(model))

    def expecting(self, error_px: float) -> Fit:
        """The state that knows a point's place in an image to so many pixels; what was weighed is forgotten."""
        errors, weights = _expected(self.data, error_px)
        return replace(self, errors=errors, weights=weights, bases=self._bases_of(self.data.rich))

    def _bases_of(self, model: Model) -> dict[tuple[str, object], Tensor]:
        return {(name, model.kind(name)): self.basis(name, model.kind(name)) for name in self.terms(model, Own)}


def fit_of(data: Data) -> Fit:
    """The state before anything is selected: observations are weighed by how a rich model explains them."""
    errors, weights = _expected(data, MAX_ERROR_PX)
    fit = Fit(data, errors, weights, torch.ones(len(weights), dtype=weights.dtype)).weighed(data.rich)
    return fit.expecting(_place_error_px(fit)).weighed(data.rich)


def _expected(data: Data, error_px: float) -> tuple[Tensor, Tensor]:
    """Errors and weights [P, F] where a point's place in an image is known to so many pixels."""
    errors = torch.sqrt(data.noise**2 + (error_px * data.tracks.slopes) ** 2)
    return errors, data.tracks.weights / errors**2


def _place_error_px(fit: Fit) -> float:
    """How many pixels a point's place in an image is off by, from what steep places leave more than even ones."""
    used = fit.weights > 0
    left, slopes = fit.residuals(fit.data.rich)[used], fit.data.tracks.slopes[used]
    steep = slopes > slopes.median() if len(slopes) else used[used]
    if not steep.any():
        return MIN_ERROR_PX
    excess = float(left[steep].square().median()) / MEDIAN_OF_CHI2 - fit.data.noise**2
    squared = excess / float(slopes[steep].square().median())
    return math.sqrt(min(max(squared, MIN_ERROR_PX**2), MAX_ERROR_PX**2))


def _variances(squares: Tensor, counts: Tensor, size: int) -> Tensor:
    return (squares / (counts - size).clamp_min(1)).clamp_min(FLOOR)


def _median(values: Tensor, keep: Tensor) -> Tensor:
    """Median [P] over the entries of values [P, F] that are kept; 0 where none is."""
    return torch.where(keep, values, torch.nan).nanmedian(1).values.nan_to_num(0.0)
