"""The temperature of every Gaussian over time as a few curves that all of them share, to a stated error."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.linalg import qr
from torch import Tensor

FIRST = 17  # moments to begin with, evenly over the span; bends that are known come on top
EXAMINED = 1024  # Gaussians that are sampled over time at first, drawn among all, and
ADDED = 512  # more at a turn: those with the worst errors
TURNS = 4  # how often, at most
CHECKS = 32  # moments between the samples at which nothing was fitted, and
ROUGHEST = 8  # more, in the intervals that were roughest when the samples ran out
GOLDEN = (5**0.5 - 1) / 2  # checks lie at its multiples: evenly, in time or among the samples by turns
AMPLIFIED = 8.0  # what errors at the moments that tell coefficients may grow by elsewhere
OVERSAMPLED = 16  # of the subspace in which singular vectors are sought: more than are wanted, and
TURNED = 2  # how often it is turned towards the values
ROWS = 16384  # Gaussians that are fitted together
CELLS = 1 << 20  # values that are asked for at once: some moments of few Gaussians, or one of many
NARROWEST = 1e-6  # of the span: intervals that are halved no further, where values jump
# Of the worst error, from which on intervals are halved together: half as wide, smooth ones err by as much.
ALIKE = 1 / 4
STEPS = 32767  # of a coefficient of 16 bits, to each side
WEIGHED = 4  # times that Gaussians with larger errors get more weight in the curves
# Shares of the tolerance: between samples, for want of curves, of a step of coefficients; and what may be found at checks, of
# which there are few.
BENT, LACKING, ROUNDED, FOUND = 1 / 3, 1 / 3, 1 / 2, 0.7

ValuesAt = Callable[[Sequence[float], Tensor | None], Tensor]  # values [T, n] at moments


@dataclass(frozen=True)
class TimeBasis:
    """Values of N Gaussians over time: ``offsets[i] + Σ_k coefficients[i, k] curves[k](t)``, linear between samples.

    Args:
        times_s: [T] float64 increasing samples in seconds since the first training frame; one of them, or none, where
            nothing changes.
        offsets: [N] float32.
        coefficients: [N, r] float32.
        curves: [r, T] float32, rounded to 16 bits each.
        worst: largest error that was found: of all Gaussians at ``checks`` moments between the samples at which nothing was
            fitted (where samples ran out, some are where values bend most) and wherever something was; of those that were
            examined at all samples.
        checks: how many these were.
        step: coefficients are multiples of it, or of larger steps where 16 bits do not reach as far.
    """

    times_s: Tensor
    offsets: Tensor
    coefficients: Tensor
    curves: Tensor
    worst: float
    checks: int
    step: float = 0.0

    @property
    def rank(self) -> int:
        return len(self.curves)

    def at(self, time_s: float | None) -> Tensor:
        """Values at a moment, [N]; before the first and after the last sample those of the nearest."""
        if not self.rank:
            return self.offsets
        return self.offsets + self.coefficients @ self._curves_at(time_s)

    def _curves_at(self, time_s: float) -> Tensor:
        after = int(torch.searchsorted(self.times_s, time_s).clamp(1, len(self.times_s) - 1))
        start, end = self.times_s[after - 1].item(), self.times_s[after].item()
        share = min(max((time_s - start) / (end - start), 0.0), 1.0)
        return self.curves[:, after - 1] * (1 - share) + self.curves[:, after] * share


def constant_basis(values: Tensor) -> TimeBasis:
    """The basis of values [N] that do not change."""
    empty = values.new_zeros(len(values), 0, dtype=torch.float32)
    nothing = torch.zeros(0, 0)
    return TimeBasis(torch.zeros(0, dtype=torch.float64), values.float(), empty, nothing, 0.0, 0)


def time_basis(
    values_at: ValuesAt,
    count: int,
    first_s: float,
    last_s: float,
    tolerance: float,
    most_times: int = 257,
    most_curves: int = 48,
    bends: Sequence[float] = (),
    clipped: bool = False,
) -> TimeBasis:
    """The shortest basis whose worst error over all Gaussians and moments stays below ``tolerance``, as far as was looked.

    Some Gaussians are examined at many moments: intervals are halved until their middle lies on the straight line between
    their ends to a third of the tolerance, the worst first. The curves are the singular vectors of what was found, in the
    order of their values, as many as leave no more than another third. Coefficients of all Gaussians follow from few moments,
    those that tell the curves apart best (pivots, then whatever helps the least certain combination; Drmac and Gugercin
    2016, Zimmermann and Willcox 2016), by least squares. Then all are compared with the truth at moments at which nothing was
    fitted, and those with the worst errors are examined too, until none are left. So values of all N are asked for some
    hundred times, however many samples there are, and as many columns of N are kept.

    Coefficients are rounded before they are compared. ``TimeBasis.worst`` says what was reached: where ``most_times``,
    ``most_curves`` or TURNS ended it, that may be more than the tolerance.

    Args:
        values_at: gives the values [T, n] at moments in seconds, increasing, of the Gaussians whose numbers it gets [n], or
            of all.
        count: N, how many there are.
        first_s, last_s: span of time.
        tolerance: in units of the values.
        most_times: samples at most.
        most_curves: curves at most.
        bends: moments at which values may bend, such as the samples of a weather record; where they fit into a half of
            ``most_times`` they are samples.
        clipped: values count as 0 below 0 and as 1 above 1, and so do their errors.
    """
    moments = torch.linspace(first_s, last_s, FIRST, dtype=torch.float64).tolist()
    inside = [moment for moment in bends if first_s < moment < last_s]
    if FIRST + len(inside) <= most_times // 2:
        moments = sorted({*moments, *inside})

    def found_at(moments: Iterable[float], ids: Tensor | None = None) -> dict[float, Tensor]:
        found, wanted = {}, sorted(set(moments))
        together = max(1, CELLS // (count if ids is None else max(len(ids), 1)))
        for first in range(0, len(wanted), together):
            some = wanted[first : first + together]
            found |= zip(some, values_at(some, ids).detach().float().cpu(), strict=True)
        return found

    def errors(found: Tensor, true: Tensor) -> Tensor:
        return ((found.clamp(0, 1) - true.clamp(0, 1)) if clipped else found - true).abs()

    drawn = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:EXAMINED].sort().values
    narrowest = NARROWEST * (last_s - first_s)
    samples = _Samples(found_at, drawn, moments, BENT * tolerance, most_times, errors, narrowest)
    fitted: dict[float, Tensor] = {}  # moment -> values of all
    best, checked = None, 0
    for _ in range(TURNS):
        rough = samples.refine()
        times, values = samples.table()
        level = values.double().mean(1, keepdim=True).float()
        curves = _rounded(_curves(values, level, LACKING * tolerance, most_curves, errors))
        basis = TimeBasis(times, level[:, 0], values.new_zeros(0), curves, 0.0, 0, ROUNDED * tolerance)
        if len(samples.ids) == count:
            fitted = dict(samples.seen)
        else:
            told = [basis._curves_at(moment) for moment in fitted]
            places = _telling(curves, torch.stack(told, 1) if told else curves[:, :0])
            fitted |= found_at(times[places].tolist())
        basis = _fit(basis, fitted)
        checks = _between(times, range(checked + 1, checked + CHECKS + 1))
        checks += [a + share * (b - a) for a, b in rough[: ROUGHEST // 2] for share in (0.25, 0.75)]
        checked += CHECKS
        fitted |= found_at(checks)
        off = _errors(basis, fitted, errors)
        known = errors(basis.offsets[samples.ids, None] + basis.coefficients[samples.ids] @ curves, values).amax(1)
        basis = replace(basis, worst=max(off.max().item(), known.max().item()), checks=len(checks))
        best = basis if best is None or basis.worst < best.worst else best
        off[samples.ids] = 0.0
        lacking = off.topk(min(ADDED, count)).indices
        lacking = lacking[off[lacking] > 0.5 * tolerance]
        if basis.worst <= FOUND * tolerance or not len(lacking):
            break
        samples.add(lacking)
    return constant_basis(best.offsets) if not best.rank and best.worst == 0.0 else best


class _Samples:
    """Values of some Gaussians at moments that are as close as these need.

    Args:
        found_at: values at moments of the Gaussians with these numbers, by moment.
        ids: [n] their numbers.
        moments: in increasing order, to begin with.
        tolerance: how far the middle of an interval may be from the straight line between its ends.
        most: moments at most.
        errors: of values against true ones.
        narrowest: seconds that an interval keeps at least.
    """

    def __init__(
        self,
        found_at: Callable,
        ids: Tensor,
        moments: Sequence[float],
        tolerance: float,
        most: int,
        errors: Callable,
        narrowest: float,
    ) -> None:
        self.found_at, self.ids, self.moments = found_at, ids, moments
        self.tolerance, self.most, self.errors, self.narrowest = tolerance, most, errors, narrowest
        self.seen: dict[float, Tensor] = found_at(moments, ids)

    def add(self, ids: Tensor) -> None:
        """Examines more Gaussians."""
        self.ids = torch.cat([self.ids, ids])
        for moment, values in self.found_at(self.seen, ids).items():
            self.seen[moment] = torch.cat([self.seen[moment], values])

    def refine(self) -> list[tuple[float, float]]:
        """Halves intervals, the worst first. Returns those that are left when the samples run out, the worst first."""
        queue: list[tuple[float, float, float]] = []
        left: list[tuple[float, float]] = []

        def look(intervals: list[tuple[float, float]]) -> None:
            """Queues those that are not straight, as far as their middles can be known."""
            middles = dict.fromkeys(0.5 * (start + end) for start, end in intervals)
            new = [middle for middle in middles if middle not in self.seen]
            self.seen |= self.found_at(new[: max(self.most - len(self.seen), 0)], self.ids)
            for start, end in intervals:
                if (middle := self.seen.get(0.5 * (start + end))) is not None:
                    line = 0.5 * (self.seen[start] + self.seen[end])
                    error = self.errors(line, middle).max().item()
                    if error > self.tolerance and end - start > self.narrowest:
                        heapq.heappush(queue, (-error, start, end))

        if all(torch.equal(self.seen[self.moments[0]], values) for values in self.seen.values()):
            return left
        look(list(zip(self.moments, self.moments[1:], strict=False)))
        while queue:
            worst, least = [], ALIKE * queue[0][0]
            while queue and queue[0][0] <= least:
                worst.append(heapq.heappop(queue)[1:])
            look([half for whole in worst for half in _halves(*whole)])
            left += [whole for whole in worst if not all(0.5 * sum(half) in self.seen for half in _halves(*whole))]
        return left

    def table(self) -> tuple[Tensor, Tensor]:
        """Moments [T], float64 and increasing, and the values [n, T] at each."""
        times = sorted(self.seen)
        return torch.tensor(times, dtype=torch.float64), torch.stack([self.seen[moment] for moment in times], dim=1)


def _halves(start: float, end: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """The two halves of an interval."""
    middle = 0.5 * (start + end)
    return (start, middle), (middle, end)


def _between(times: Tensor, numbers: Iterable[int]) -> list[float]:
    """Moments by number: odd ones evenly in time, even ones evenly among samples [T], which lie closer where values bend."""
    found = []
    for number in numbers:
        share = (number * GOLDEN) % 1.0
        if number % 2:
            found.append((times[0] + share * (times[-1] - times[0])).item())
        else:
            place = share * (len(times) - 1)
            found.append(torch.lerp(times[int(place)], times[int(place) + 1], place % 1.0).item())
    return found


def _curves(values: Tensor, level: Tensor, tolerance: float, most: int, errors: Callable) -> Tensor:
    """Curves [r, T] of which sums come close to values [n, T] about their level [n, 1]: as many as ``tolerance`` needs.

    They are right singular vectors, which make the mean error least. Weights that grow with the error of a row make the
    largest smaller (as in the iteration of Lawson 1961): a third of it at 192 curves of 2,126 Gaussians under weather.
    """
    change, weights = values - level, torch.ones_like(level)
    tried: list[tuple[float, Tensor]] = []
    for _ in range(1 + WEIGHED):
        directions = _directions(change * weights, most)
        off = errors(level + change @ directions @ directions.T, values).amax(1, keepdim=True)
        tried.append((off.max().item(), directions))
        if tried[0][0] <= tolerance:
            break
        weights = weights * (1 + off / tolerance)
        weights = weights / weights.max()
    directions = min(tried, key=lambda one: one[0])[1]
    coefficients = change @ directions

    def enough(rank: int) -> bool:
        found = level + coefficients[:, :rank] @ directions[:, :rank].T
        return errors(found, values).max().item() <= tolerance

    few, many = -1, directions.shape[1]
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if enough(middle) else (middle, many)
    return directions[:, :many].T.contiguous()


def _telling(curves: Tensor, known: Tensor) -> list[int]:
    """Samples that tell the level and coefficients of curves [r, T], in addition to ``known`` [r, m], the curves elsewhere."""
    level = curves.shape[1] ** -0.5
    every, at = (torch.cat([part.new_full((1, part.shape[1]), level), part]).double() for part in (curves, known))
    found: list[int] = []
    if not known.shape[1]:
        found = qr(every.numpy(), mode="r", pivoting=True)[1][: len(every)].tolist()
    gram = at @ at.T + every[:, found] @ every[:, found].T
    free = torch.ones(every.shape[1], dtype=torch.bool)
    free[found] = False
    while len(found) < every.shape[1]:
        sizes, vectors = torch.linalg.eigh(gram)
        if sizes[0] * AMPLIFIED**2 >= 1.0:
            break
        place = int(((vectors[:, 0] @ every).abs() * free).argmax())
        free[place] = False
        found.append(place)
        gram += every[:, place, None] * every[None, :, place]
    return found


def _fit(basis: TimeBasis, fitted: Mapping[float, Tensor]) -> TimeBasis:
    """The basis with levels and rounded coefficients of all Gaussians by least squares, of values [N] at some moments."""
    at = _level_and_curves(basis, fitted)
    solving = torch.linalg.pinv(at.double())
    found = torch.cat([(some.double() @ solving).float() for some in _by_rows(fitted)])
    return replace(basis, offsets=found[:, 0].contiguous(), coefficients=_rounded(found[:, 1:].T, basis.step).T)


def _errors(basis: TimeBasis, known: Mapping[float, Tensor], errors: Callable) -> Tensor:
    """The largest error [N] of each Gaussian at moments of which values [N] are known."""
    at = _level_and_curves(basis, known)
    own = zip(basis.offsets.split(ROWS), basis.coefficients.split(ROWS), strict=True)
    parts = (
        (torch.cat([level[:, None], some], dim=1) @ at, true)
        for (level, some), true in zip(own, _by_rows(known), strict=True)
    )
    return torch.cat([errors(found, true).amax(1) for found, true in parts])


def _by_rows(known: Mapping[float, Tensor]) -> Iterator[Tensor]:
    """Values [N] at M moments as tables [ROWS, M], one after the other: the whole table of millions takes gigabytes."""
    for some in zip(*(values.split(ROWS) for values in known.values()), strict=True):
        yield torch.stack(some, dim=1)


def _level_and_curves(basis: TimeBasis, moments: Iterable[float]) -> Tensor:
    """What levels and coefficients are factors of, at some moments, [1 + r, m]."""
    return torch.stack([torch.cat([torch.ones(1), basis._curves_at(moment)]) for moment in moments], dim=1)


def _directions(values: Tensor, most: int) -> Tensor:
    """The first right singular vectors of values [N, T], [T, r] with r at most ``most``, in the order of their values.

    Where there are many samples they are sought in a random subspace a little wider, turned twice towards the values (Halko,
    Martinsson and Tropp 2011, 4.4): products of N x T x r in place of N x T x T.
    """
    count = values.shape[1]
    wide = min(count, most + OVERSAMPLED)
    within = torch.eye(count)
    if wide < count:
        within = torch.randn(count, wide, generator=torch.Generator().manual_seed(0))
        for _ in range(TURNED):
            within = torch.linalg.qr(values.T @ (values @ within)).Q
    inner = (values @ within if wide < count else values).double()
    vectors = torch.linalg.eigh(inner.T @ inner).eigenvectors.flip(1).float()
    return (within @ vectors)[:, :most]


def _rounded(rows: Tensor, least: float = 0.0) -> Tensor:
    """Each of some rows [r, n] as ``rounded`` has it."""
    return torch.stack([rounded(row, least) for row in rows]) if len(rows) else rows


def rounded(column: Tensor, least: float = 0.0) -> Tensor:
    """A column [N] as whole steps hold it: what ``steps_of`` stores, read back."""
    steps, size = steps_of(column, least)
    return steps.float() * size


def steps_of(column: Tensor, least: float = 0.0) -> tuple[Tensor, float]:
    """A column [N] in whole steps of -32767 to 32767, int16, and the size of a step: ``least`` or as large as that asks for."""
    largest = column.abs().max().item() if column.numel() else 0.0
    size = max(largest / STEPS, least) or 1.0
    return (column / size).round().clamp(-STEPS, STEPS).to(torch.int16), size
