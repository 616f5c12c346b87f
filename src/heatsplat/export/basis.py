"""The temperature of every Gaussian over time as a few curves that all of them share, to a stated error."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

FIRST = 17  # moments to begin with, evenly over the span; bends that are known come on top
CHECKS = 7  # moments between the samples at which nothing was fitted, and
ROUGHEST = 8  # more, in the intervals that were roughest when the samples ran out
GOLDEN = (5**0.5 - 1) / 2  # checks lie at its multiples: evenly, and on no sample
OVERSAMPLED = 16  # of the subspace in which singular vectors are sought: more than are wanted, and
TURNS = 2  # how often it is turned towards the values
ROWS = 16384  # Gaussians whose errors are looked at together
STEPS = 32767  # of a coefficient of 16 bits, to each side


@dataclass(frozen=True)
class TimeBasis:
    """Values of N Gaussians over time: ``offsets[i] + Σ_k coefficients[i, k] curves[k](t)``, linear between samples.

    Args:
        times_s: [T] float64 increasing samples in seconds since the first training frame; one of them, or none, where
            nothing changes.
        offsets: [N] float32.
        coefficients: [N, r] float32.
        curves: [r, T] float32.
        worst: largest error found of any Gaussian, at all samples and at ``checks`` moments between them; where samples ran
            out, some of these are where values bend most.
        checks: how many these were.
    """

    times_s: Tensor
    offsets: Tensor
    coefficients: Tensor
    curves: Tensor
    worst: float
    checks: int

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
    values_at: Callable[[float], Tensor],
    first_s: float,
    last_s: float,
    tolerance: float,
    most_times: int = 257,
    most_curves: int = 48,
    bends: Sequence[float] = (),
    clipped: bool = False,
) -> TimeBasis:
    """The shortest basis whose worst error over all Gaussians and moments stays below ``tolerance``, as far as was looked.

    Intervals are halved until their middle lies on the straight line between their ends to a third of the tolerance, the
    worst first; the singular vectors of all samples, in the order of their values, are then taken until every residual is
    below half of it. Coefficients have 16 bits and are measured as such. ``TimeBasis.worst`` says what was reached: where
    ``most_times`` or ``most_curves`` ended it, that is more than the tolerance.

    Args:
        values_at: gives the values [N] at a moment in seconds.
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
    seen = {moment: values_at(moment).detach().float().cpu() for moment in moments}
    queue: list[tuple[float, float, float]] = []

    def error_of(found: Tensor, true: Tensor) -> float:
        return ((found.clamp(0, 1) - true.clamp(0, 1)) if clipped else found - true).abs().max().item()

    def halve(start: float, end: float) -> None:
        middle = 0.5 * (start + end)
        seen[middle] = values_at(middle).detach().float().cpu()
        error = error_of(0.5 * (seen[start] + seen[end]), seen[middle])
        if error > tolerance / 3:
            heapq.heappush(queue, (-error, start, end))

    if any(not torch.equal(seen[moments[0]], values) for values in seen.values()):
        for start, end in zip(moments, moments[1:], strict=False):
            halve(start, end)
        while queue and len(seen) + 2 <= most_times:
            _, start, end = heapq.heappop(queue)
            middle = 0.5 * (start + end)
            halve(start, middle)
            halve(middle, end)
    times = torch.tensor(sorted(seen), dtype=torch.float64)
    samples = torch.stack([seen.pop(moment) for moment in times.tolist()], dim=1)
    offsets = samples.double().mean(1).float()
    coefficients, curves, worst = _factors(samples - offsets[:, None], tolerance / 2, most_curves)
    basis = TimeBasis(times, offsets, coefficients, curves, worst, 0)
    if not basis.rank and worst == 0.0:
        return constant_basis(offsets)
    checked = [first_s + (i * GOLDEN) % 1.0 * (last_s - first_s) for i in range(1, CHECKS + 1)]
    for _, start, end in heapq.nsmallest(ROUGHEST // 2, queue):
        checked += [0.75 * start + 0.25 * end, 0.25 * start + 0.75 * end]
    for moment in checked:
        worst = max(worst, error_of(basis.at(moment), values_at(moment).detach().float().cpu()))
    return TimeBasis(times, offsets, coefficients, curves, worst, len(checked))


def _factors(residual: Tensor, tolerance: float, most: int) -> tuple[Tensor, Tensor, float]:
    """Coefficients [N, r], curves [r, T] and the largest error of their products for values [N, T], r at most ``most``."""
    worst = residual.abs().max().item() if residual.numel() else 0.0
    if worst <= tolerance:
        return residual.new_zeros(len(residual), 0), residual.new_zeros(0, residual.shape[1]), worst
    directions = _directions(residual, most)
    coefficients = torch.stack([rounded(column) for column in (residual @ directions).unbind(1)], dim=1)

    def error_of(rank: int) -> float:
        found = (
            (some - own[:, :rank] @ directions[:, :rank].T).abs().max().item()
            for some, own in zip(residual.split(ROWS), coefficients.split(ROWS), strict=True)
        )
        return max(found)

    few, enough = 0, directions.shape[1]
    worst = error_of(enough)
    while worst <= tolerance and enough - few > 1:
        middle = (few + enough) // 2
        error = error_of(middle)
        few, enough, worst = (few, middle, error) if error <= tolerance else (middle, enough, worst)
    return coefficients[:, :enough].contiguous(), directions[:, :enough].T.contiguous(), worst


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
        for _ in range(TURNS):
            within = torch.linalg.qr(values.T @ (values @ within)).Q
    inner = (values @ within if wide < count else values).double()
    vectors = torch.linalg.eigh(inner.T @ inner).eigenvectors.flip(1).float()
    return (within @ vectors)[:, :most]


def rounded(column: Tensor) -> Tensor:
    """A column [N] as 16-bit steps of its largest magnitude hold it: what ``steps_of`` stores, read back."""
    steps, size = steps_of(column)
    return steps.float() * size


def steps_of(column: Tensor) -> tuple[Tensor, float]:
    """A column [N] in whole steps of -32767 to 32767, int16, and the size of a step."""
    largest = column.abs().max().item() if column.numel() else 0.0
    size = largest / STEPS if largest > 0 else 1.0
    return (column / size).round().clamp(-STEPS, STEPS).to(torch.int16), size
