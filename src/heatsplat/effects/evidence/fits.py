"""Fits of effects to tracks of scene points: what every point does by itself, and what all share.

Tracks are explained as  value(point, frame) = Σ own(point) · basis(point, frame) + Σ shared · column(point, frame) + noise.
A point's own part is a level, and with an effect of state a course over time; shared columns are those of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from heatsplat.effects.evidence import shared_columns
from heatsplat.effects.observations import Tracks

# Mixtures of these decays, as rates times the record's length, stand for any course that relaxes: the surface of a deep
# body does not follow one exponential. Within 0.5 % of the excess for slabs of Biot number 0 to 3.
DECAYS = (0.6, 2.5, 9.0, 40.0)
LONG = 24  # observations of a point from which all of these can be told apart; below that, DECAYS_FEW
DECAYS_FEW = (0.7, 3.0, 12.0)
# Courses over time that points share: one source and bodies that follow it more or less slowly need a few.
COURSES = (1, 2, 3)
STRENGTHS = 12  # iterations for the strength of a random pattern
SWEEPS = 4  # of alternating least squares for them
NODES, NODES_FEW = 7, 5  # along the sides of the grids on which a fixed pattern is looked for
MANY = 10_000  # observations from which the finer grid pays
FINE_NODES = 9  # where the pattern is a random field, which more nodes than it needs do no harm
OUTLIER = 5.0  # an observation this many times the usual residual away counts nothing (Tukey's weights)
DISTRUSTED = 0.15  # share of the points, those that are fitted worst, that is left out: edges and hidden points
# No fit is taken to be better than this, in squares of the expected error: a value between four pixels is less noisy.
FLOOR = 0.1
# Structure from motion reports 0.4 pixels at most; below a twentieth nothing depends on it.
LEAST_ASTRAY_PX, MOST_ASTRAY_PX = 0.05, 0.4
MEDIAN_OF_CHI2 = 0.455  # of one degree of freedom
FEW = 4.0  # how many observations the usual residual counts for beside a point's own
LEAST_FREE = 4  # observations of a point that its own parameters must leave free
RIDGE = 1e-9
# In the order in which they act on an image.
SHARED = ("reflection", "fixed_pattern", "vignetting", "agc", "frame_offset", "tone")


@dataclass(frozen=True)
class Model:
    """A selection of effects.

    Args:
        own: relaxation, harmonic_source and view_dependence, whose basis every point has.
        shared: effects among SHARED.
        courses: of harmonic_source, how many courses over time all points share, each with an amplitude of its own.
        attenuation: "" for none, "constant" or "varying" (over time).
    """

    own: frozenset[str] = frozenset()
    shared: frozenset[str] = frozenset()
    courses: int = 0
    attenuation: str = ""

    def names(self) -> set[str]:
        """All effects in it."""
        return set(self.own | self.shared) | ({"attenuation"} if self.attenuation else set())

    def without(self, name: str) -> Model:
        """The model that lacks an effect; a source cannot do without the relaxation that answers it."""
        if name == "attenuation":
            return replace(self, attenuation="")
        own = self.own - ({name, "harmonic_source"} if name == "relaxation" else {name})
        return replace(self, own=own, shared=self.shared - {name}, courses=self.courses * ("harmonic_source" in own))


@dataclass(frozen=True)
class Fitted:
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


@dataclass
class Fits:
    """Fits of models to tracks, each made once.

    Args:
        tracks: what is explained.
        times_s: [F] or None; without times nothing changes in time.
        ambient: image value of the surroundings, or None.
        noise: of a pixel, in image units.
        normals: [P, 3] of the surface at the points, or None.
        drivers: [F, k] how surfaces answer a weather record, which then stands for relaxation, or None.
    """

    tracks: Tracks
    times_s: Tensor | None
    ambient: float | None
    noise: float
    normals: Tensor | None = None
    drivers: Tensor | None = None
    weights: Tensor = field(init=False)
    trust: Tensor = field(init=False)
    fits: dict[Model, Fitted] = field(default_factory=dict)
    _courses: dict[int, Tensor] = field(default_factory=dict)
    _known: dict[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._expect(MOST_ASTRAY_PX)
        self.trust = torch.ones(len(self.weights), dtype=self.weights.dtype)
        self.weigh(self.rich)
        self._expect(self._astray_px())
        self.weigh(self.rich)

    def _astray_px(self) -> float:
        """How many pixels a point's place in an image is off by, from what steep places leave more than even ones."""
        used = self.weights > 0
        left, slopes = self.residuals(self.rich)[used], self.tracks.slopes[used]
        steep = slopes > slopes.median() if len(slopes) else used[used]
        if not steep.any():
            return LEAST_ASTRAY_PX
        squared = (float(left[steep].square().median()) / MEDIAN_OF_CHI2 - self.noise**2) / float(
            slopes[steep].square().median()
        )
        return math.sqrt(min(max(squared, LEAST_ASTRAY_PX**2), MOST_ASTRAY_PX**2))

    def _expect(self, astray_px: float) -> None:
        """Sets the errors to be expected where a point's place in an image is known to so many pixels."""
        self.errors = torch.sqrt(self.noise**2 + (astray_px * self.tracks.slopes) ** 2)
        self.weights = self.tracks.weights / self.errors**2
        self._scenes.clear()
        self.fits.clear()

    @property
    def observations(self) -> int:
        """How many observations count."""
        return int((self.weights > 0).sum())

    @property
    def frames(self) -> int:
        return self.tracks.values.shape[1]

    def allowed(self) -> list[int]:
        """Numbers of common courses that the record has frames for."""
        if self._span <= 0:
            return []
        return [count for count in COURSES if count <= self._usual_length - 1 - self._decays.shape[1] - LEAST_FREE]

    def fitted(self, model: Model) -> Fitted:
        """The fit of a model."""
        if model not in self.fits:
            self.fits[model] = self._fit(model)
        return self.fits[model]

    def gain(self, more: Model, less: Model) -> float:
        """What the larger of two models gains over the smaller: drop of the criterion's first term over what its
        additional parameters cost. Above 1 it is worth them; about 1 / log n if it explains noise alone."""
        a, b = self.fitted(more), self.fitted(less)
        cost = a.cost - b.cost
        return 1.0 + (b.bic - a.bic) / cost if cost > 0 else 0.0

    def effect_size(self, more: Model, less: Model) -> float:
        """Root mean square over the observations of what the larger of two models explains and the smaller cannot,
        in units of the errors expected; what its parameters explain of mere noise is taken away."""
        n, a, b = self.observations, self.fitted(more), self.fitted(less)
        noise = a.squares / max(n - a.parameters, 1)
        return math.sqrt(max(b.squares - a.squares - noise * (a.parameters - b.parameters), 0.0) / max(n, 1))

    def _fit(self, model: Model) -> Fitted:
        """Every point has a noise of its own: a tenth of bad points must not decide for all."""
        left = self.residuals(model)
        values, basis, paths = self._own(model)
        squares, counts = (self.weights * left**2).sum(1), (self.weights > 0).sum(1)
        used = counts > 0
        free = (counts - basis.shape[2]).clamp_min(1)
        variances = (squares / free).clamp_min(FLOOR)[used]
        lengths = counts[used].clamp(max=basis.shape[2]).double()
        shared = paths + self._rank(model) + model.courses * self.frames
        # What a point's own number is worth depends on the observations of that point, not on all.
        cost = float((lengths * counts[used].double().log()).sum()) + shared * math.log(max(self.observations, 3))
        bic = float((counts[used] * variances.log()).sum()) + cost
        weighted = (squares / self.trust).sum()
        return Fitted(float(weighted), float(lengths.sum()) + shared, cost, bic)

    def _rank(self, model: Model) -> int:
        """How many independent numbers the shared effects of a model have."""
        sizes = {"frame_offset": self.frames - 1, "agc": self.frames - 1, "vignetting": 2, "reflection": 8, "tone": 2}
        return sum(sizes.get(name, 2 * self._nodes**2 - 2) for name in model.shared)

    def _own(self, model: Model) -> tuple[Tensor, Tensor, int]:
        """Values [P, F], basis [P, F, k] of a point's own part, and the number of parameters of the path."""
        values = self.tracks.values
        basis, _ = self._basis(model)
        if not model.attenuation:
            return values, basis, 0
        passing, paths = self.transmission(model)
        # The surroundings shine through what the path takes away.
        return values - self.ambient, passing[..., None] * basis, paths

    def _basis(self, model: Model) -> tuple[Tensor, int]:
        """Basis [P, F, k] of a point's own part before the path, and k."""
        values = self.tracks.values
        courses = [torch.ones(self.frames, 1, dtype=values.dtype)]
        if "relaxation" in model.own:
            courses.append(self._decays)
        if model.courses:
            courses.append(self.common_courses(model.courses))
        basis = torch.cat(courses, 1).expand(len(values), -1, -1)
        if "view_dependence" in model.own:
            basis = torch.cat([basis, self.tracks.directions], 2)
        return basis, basis.shape[2]

    def transmission(self, model: Model) -> tuple[Tensor, int]:
        """Share of the excess over the surroundings that arrives [P, F], and how many numbers say so.

        log(value - ambient) is linear in the extinction (Beer-Lambert), so it comes from one linear fit there.
        """
        excess = self.tracks.values - self.ambient
        clear = excess.abs() > 8.0 * self.errors
        sign = torch.sign((excess * self.tracks.weights).sum(1, keepdim=True))
        clear = clear & (excess * sign > 0)
        weights = self.weights * excess**2 * clear
        logs = torch.where(clear, excess.abs(), torch.ones_like(excess)).log()
        distances = self.tracks.distances
        scale = float((distances * self.tracks.weights).sum() / self.tracks.weights.sum())
        if model.attenuation == "constant":
            columns = distances[..., None] / scale
        else:
            columns = (distances / scale)[..., None] * torch.eye(self.frames, dtype=excess.dtype)
        basis, _ = self._basis(model)
        gram = self._gram(basis, torch.cat([logs[..., None], columns], 2), weights)
        ridge = 1e-8 * gram.diagonal()[1:].mean().clamp_min(1e-300) * torch.eye(columns.shape[2], dtype=gram.dtype)
        thickness = -torch.linalg.solve(gram[1:, 1:] + ridge, gram[1:, 0])
        thickness = thickness.clamp(0.0, 3.0)  # air only takes away
        return torch.exp(-(columns @ thickness)), len(thickness)

    def _gram(self, basis: Tensor, columns: Tensor, weights: Tensor | None = None) -> Tensor:
        """Inner products [c, c] of columns [P, F, c] with what the points' own bases [P, F, k] can say taken away."""
        weights = (self.weights if weights is None else weights) / self.trust[:, None]
        result = columns.new_zeros(columns.shape[2], columns.shape[2])
        step = max(1, 2_000_000 // (columns.shape[1] * (columns.shape[2] + basis.shape[2])))
        for first in range(0, len(columns), step):
            part = slice(first, first + step)
            root = weights[part].sqrt()[..., None]
            own, wanted = root * basis[part], root * columns[part]
            own = own / own.norm(dim=1, keepdim=True).clamp_min(1e-300)
            inner = own.mT @ own + RIDGE * torch.eye(own.shape[2], dtype=own.dtype)
            rest = (wanted - own @ torch.linalg.solve(inner, own.mT @ wanted)).flatten(0, 1)
            result += rest.T @ rest
        return result

    def residuals(self, model: Model) -> Tensor:
        """What a model leaves of the values [P, F], in image units."""
        values, basis, _ = self._own(model)
        values = values - sum(self.contributions(model).values())
        return values - self._own_part(basis, values)

    def contributions(self, model: Model) -> dict[str, Tensor]:
        """What each shared effect of a model adds to the values [P, F]."""
        blocks = self._shared(model)
        if not blocks:
            return {}
        values, basis, _ = self._own(model)
        columns = torch.cat([values[..., None], *blocks.values()], dim=2)
        gram = self._gram(basis, columns)
        scale = gram.diagonal()[1:].clamp_min(1e-150).rsqrt()
        inner = scale[:, None] * gram[1:, 1:] * scale + RIDGE * torch.eye(len(scale), dtype=gram.dtype)
        weights = scale * torch.linalg.solve(inner, scale * gram[1:, 0])
        parts = weights.split([block.shape[2] for block in blocks.values()])
        numbers = dict(zip(blocks, parts, strict=True))
        added = {name: block @ _settled(name, numbers[name]) for name, block in blocks.items()}
        if "agc" in added:  # what a gain that all images share makes of what earlier stages added is theirs
            for name in added.keys() & self._known.keys() & {"reflection", "fixed_pattern", "vignetting"}:
                added[name] = added[name] + numbers["agc"].mean() * self._known[name]
        return added

    def _own_part(self, basis: Tensor, values: Tensor) -> Tensor:
        """What the points' own bases [P, F, k] make of values [P, F]."""
        return (basis @ self._own_weights(basis, values)[..., None])[..., 0]

    def _own_weights(self, basis: Tensor, values: Tensor) -> Tensor:
        """Weights [P, k] of the points' own bases [P, F, k] that fit values [P, F] best."""
        root = self.weights.sqrt()[..., None]
        own = root * basis
        scale = own.norm(dim=1, keepdim=True).clamp_min(1e-150)
        own = own / scale
        inner = own.mT @ own + RIDGE * torch.eye(own.shape[2], dtype=own.dtype)
        return (torch.linalg.solve(inner, own.mT @ (root * values[..., None])) / scale.mT)[..., 0]

    @property
    def rich(self) -> Model:
        """A model that follows most things; what it leaves tells good points from bad ones before anything is known."""
        allowed = [count for count in self.allowed() if count <= 1]
        changes = self._span > 0 and self._usual_length >= 2 * (1 + len(self._rates))
        own = {"relaxation", "harmonic_source"} if changes and allowed else ({"relaxation"} if changes else set())
        shared = frozenset({"frame_offset", "agc"})
        return Model(frozenset(own), shared, max(allowed, default=0) if "harmonic_source" in own else 0)

    def weigh(self, model: Model) -> None:
        """Weighs observations by how well a model explains them and their point: outliers not at all, and a point by its
        own residuals (those at edges and those that others hide are explained by nothing)."""
        seen = self.tracks.weights.sum(1).clamp_min(1.0)
        astray = self.residuals(model).abs() / self.errors
        usual = max(1.4826 * float(astray[self.weights > 0].median()), math.sqrt(FLOOR))
        own = (1.4826 * _median(astray, self.tracks.weights > 0)).clamp_min(usual)
        robust = (1.0 - (astray / (OUTLIER * own[:, None])) ** 2).clamp_min(0.0) ** 2 * self.tracks.weights
        free = (robust.sum(1) - self._own(model)[1].shape[2]).clamp_min(1.0)
        excess = ((robust * astray**2).sum(1) + FEW * usual**2) / (free + FEW)
        trusted = (own <= own.quantile(1.0 - DISTRUSTED)) & ((robust > 0).sum(1) > 0.6 * seen)
        self.weights = robust / self.errors**2 * trusted[:, None]
        self.trust = excess.clamp_min(FLOOR)
        self._scenes.clear()
        self._courses.clear()
        self.fits.clear()

    @property
    def _span(self) -> float:
        return 0.0 if self.times_s is None else float(self.times_s.max() - self.times_s.min())

    @property
    def _usual_length(self) -> float:
        return float(self.tracks.weights.sum(1).median())

    @property
    def _rates(self) -> tuple[float, ...]:
        return DECAYS if self._usual_length >= LONG else DECAYS_FEW

    @cached_property
    def _moves(self) -> bool:
        """Whether points are seen from several places."""
        return bool(self.tracks.directions.std(1).max() > 1e-6)

    @cached_property
    def _decays(self) -> Tensor:
        if self.drivers is not None:
            return self.drivers
        passed = (self.times_s - self.times_s.min()) / self._span
        return torch.exp(-passed[:, None] * torch.tensor(self._rates, dtype=torch.float64))

    def common_courses(self, count: int) -> Tensor:
        """Courses over time [F, count] by which points depart from relaxation, each in its own measure.

        Whatever drives the scene: the leading directions of what relaxation leaves, by alternating least squares.
        """
        if count not in self._courses:
            values = self.tracks.values - sum(self._known.values())
            decaying, _ = self._basis(Model(own=frozenset({"relaxation"})))
            left = (values - self._own_part(decaying, values)) * (self.weights > 0)
            weights = self.weights / self.trust[:, None]
            scale = weights.sum(1).clamp_min(1e-300)[:, None]
            _, found = torch.linalg.eigh((left * weights / scale).T @ left)
            found = found[:, -count:]
            for _ in range(SWEEPS):
                basis = torch.cat([decaying, found.expand(len(values), -1, -1)], 2)
                own = self._own_weights(basis, values)
                amplitudes, rest = own[:, -count:], values - (decaying @ own[:, :-count, None])[..., 0]
                inner = torch.einsum("pf,pi,pj->fij", weights, amplitudes, amplitudes)
                inner = inner + RIDGE * inner.diagonal(dim1=1, dim2=2).mean().clamp_min(1e-300) * torch.eye(count)
                found = torch.linalg.solve(inner, torch.einsum("pf,pi,pf->fi", weights, amplitudes, rest))
                found = torch.linalg.qr(found).Q
            self._courses[count] = found
        return self._courses[count]

    def _shared(self, model: Model) -> dict[str, Tensor]:
        """The columns [P, F, c] of the shared effects of a model.

        What multiplies an image multiplies the points' own part of it and what earlier stages of the sensor, as far as
        the model has them, added to that: were it the values themselves, a gain per frame would explain everything.
        """
        key = replace(model, shared=frozenset())
        if key not in self._scenes:
            values, basis, _ = self._own(key)
            clean = self._own_part(basis, values - sum(self._known.values()))
            self._scenes[key] = clean + (self.ambient if model.attenuation else 0.0)
        image, blocks = self._scenes[key], {}
        for name in SHARED:
            if name in model.shared:
                blocks[name] = self._columns(name, image)
                image = image + self._known.get(name, 0.0)
        return blocks

    def _columns(self, name: str, image: Tensor) -> Tensor:
        if name == "fixed_pattern":
            return shared_columns.fixed_pattern(image, self.tracks, self._nodes)
        if name == "reflection":
            return shared_columns.reflection(self.tracks, self.normals)
        if name == "tone":
            return shared_columns.tone(image, self._known.get("frame_offset", torch.zeros_like(image)))
        return {
            "vignetting": shared_columns.vignetting,
            "agc": shared_columns.agc,
            "frame_offset": shared_columns.frame_offset,
        }[name](image, self.tracks)

    @cached_property
    def _scenes(self) -> dict[Model, Tensor]:
        return {}

    @property
    def sees_pattern(self) -> bool:
        """Whether points move through the image, so that its places can be told from the scene."""
        return self._moves

    def early_and_late(self, model: Model) -> tuple[Tensor, Tensor, Tensor]:
        """What the points' own parts say of the first and the last fifth of the record [P] each, and which points [P]
        were seen in both."""
        values, basis, _ = self._own(model)
        own = self._own_part(basis, values - sum(self.contributions(model).values()))
        own = own + (self.ambient if model.attenuation else 0.0)
        passed = (self.times_s - self.times_s.min()) / self._span
        first, last = passed <= 0.2, passed >= 0.8
        used = self.weights > 0
        both = used[:, first].any(1) & used[:, last].any(1)
        return own[:, first].mean(1), own[:, last].mean(1), both

    def explained(self, more: Tensor, less: Tensor) -> float:
        """What courses over time [F, k], one weight for each point, gain over fewer of them (see ``gain``)."""
        level = torch.ones(self.frames, 1, dtype=more.dtype)
        criteria, costs = [], []
        for courses in (less, more):
            basis = torch.cat([level, courses], 1).expand(len(self.weights), -1, -1)
            left = self.tracks.values - self._own_part(basis, self.tracks.values)
            counts = (self.weights > 0).sum(1)
            used = counts > basis.shape[2] + 1
            variance = ((self.weights * left**2).sum(1)[used] / (counts[used] - basis.shape[2])).clamp_min(FLOOR)
            costs.append(float((basis.shape[2] * counts[used].double().log()).sum()))
            criteria.append(float((counts[used] * variance.log()).sum()))
        cost = costs[1] - costs[0]
        return (criteria[0] - criteria[1]) / cost if cost > 0 else 0.0

    def falloff(self, model: Model) -> tuple[float, float]:
        """By what share the image is brighter in its corners than in its middle (negative where it fades), and what such
        a falloff gains when the rest of the pattern is a random field as strong as it turns out to be.

        A random field has a radial part, too; a falloff is there when that part stands out of what its other parts lead
        one to expect. The strength of the field is found by expectation and maximisation, and the falloff has to earn its
        two numbers against the field's nodes, of which each is about one observation of it.
        """
        none = replace(model, shared=model.shared - {"vignetting", "fixed_pattern"})
        shared = self._shared(none)
        image = self._scenes[replace(model, shared=frozenset())]
        values, basis, _ = self._own(none)
        radial, field = (
            shared_columns.vignetting(image, self.tracks),
            shared_columns.fixed_pattern(image, self.tracks, FINE_NODES),
        )
        columns = torch.cat([values[..., None], field, radial, *shared.values()], dim=2)
        gram = self._gram(basis, columns)
        scale = gram.diagonal()[1:].clamp_min(1e-150).rsqrt()
        inner, right = scale[:, None] * gram[1:, 1:] * scale, scale * gram[1:, 0]
        inner = inner + 1e-8 * torch.eye(len(inner), dtype=inner.dtype)
        n, half = field.shape[2], field.shape[2] // 2
        loose = torch.zeros(len(inner), dtype=inner.dtype)  # inverse variances of the field's nodes in scaled units
        loose[:n] = 1e-2 / scale[:n] ** 2
        for _ in range(STRENGTHS):
            inverse = torch.linalg.inv(inner + loose.diag())
            found = ((inverse @ right) ** 2 + inverse.diagonal()) * scale**2
            for part in (slice(0, half), slice(half, n)):
                loose[part] = 1.0 / (found[part].mean().clamp_min(1e-12) * scale[part] ** -2)
        inverse = torch.linalg.inv(inner + loose.diag())
        two = slice(n, n + radial.shape[2])
        numbers = (inverse @ right)[two]
        stands_out = float(numbers @ torch.linalg.solve(inverse[two, two], numbers))
        return float((numbers * scale[two]).sum()), stands_out / (radial.shape[2] * math.log(n))

    @property
    def _nodes(self) -> int:
        """Along the sides of the grid on which a fixed pattern is looked for."""
        return NODES if self.tracks.weights.sum() > MANY else NODES_FEW


def _settled(name: str, numbers: Tensor) -> Tensor:
    """The numbers of a shared effect without the part that only renames the scene's own levels and their scale, which
    otherwise wander off from one linearisation to the next."""
    if name in ("frame_offset", "agc"):
        return numbers - numbers.mean()
    if name == "fixed_pattern":
        return torch.cat([half - half.mean() for half in numbers.chunk(2)])
    return numbers


def _median(values: Tensor, keep: Tensor) -> Tensor:
    """Median [P] over the entries of values [P, F] that are kept; 0 where none is."""
    return torch.where(keep, values, torch.nan).nanmedian(1).values.nan_to_num(0.0)
