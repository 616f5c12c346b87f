"""One hard case: a function in the form that is printed and in ours, and the truth in 120 digits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from heatsplat.training.rng import generator_for

DIGITS = 120
RELATIVE_STEP = "1e-40"  # of the difference quotient in DIGITS: 80 digits of a slope survive
TYPES = {"float32": torch.float32, "float64": torch.float64}

Forms = Callable[..., "Tensor | tuple[Tensor, ...]"]


@dataclass(frozen=True)
class Case:
    """A function of several numbers, evaluated draw by draw.

    Args:
        name: what is hard.
        ranges: what is drawn from where, with units, for the reader.
        printed: the printed or obvious form, for the reader.
        error: what an error is divided by, for the reader.
        draw: inputs by name, each [n] float64 with values of float32, so that no form is blamed for its input.
        naive, ours: functions of the inputs as tensors [n] of one type; one output [n] or several.
        exact: the outputs of one draw, given as mpmath numbers.
        by: the input by which slopes are taken, or None for none.
        constants: inputs that ours takes in float64 whatever the type (moments and frequencies).
        scale: what errors of values are divided by, given the exact values; by default their sum.
        slope_scale: what errors of slopes are divided by, given the exact values and slopes; by default the slopes' sum.
        promise: ours errs by at most this many machine epsilons (1.2e-7 in float32, 2.2e-16 in float64).
        types: the types in which ours exists.
    """

    name: str
    ranges: str
    printed: str
    error: str
    draw: Callable[[], dict[str, Tensor]]
    naive: Forms
    ours: Forms
    exact: Callable[..., Sequence]
    by: str | None = None
    constants: tuple[str, ...] = ()
    scale: Callable[[Sequence], object] = lambda exact: sum(map(abs, exact))
    slope_scale: Callable[[Sequence, Sequence], object] = lambda exact, slopes: sum(map(abs, slopes))
    promise: float = 5.0
    types: tuple[str, ...] = ("float32", "float64")


def log_uniform(name: str, low: float, high: float, count: int) -> Tensor:
    """Draws [count] float64 that are values of float32, the ends among them; the name seeds the draw."""
    return (low * (high / low) ** _shares(name, count)).float().double()


def uniform(name: str, low: float, high: float, count: int) -> Tensor:
    """Draws [count] as ``log_uniform``, but uniform."""
    return (low + (high - low) * _shares(name, count)).float().double()


def _shares(name: str, count: int) -> Tensor:
    shares = torch.rand(count, generator=generator_for(0, 0, name), dtype=torch.float64)
    shares[:2] = torch.tensor([0.0, 1.0])[:count]
    return shares


def truths(case: Case, inputs: dict[str, Tensor]) -> tuple[list[Sequence], list[Sequence] | None]:
    """Exact outputs of every draw and, where asked for, their slopes: lists [n] of tuples of mpmath numbers."""
    return _truths(case.exact, case.by, tuple(inputs), tuple(zip(*(x.tolist() for x in inputs.values()), strict=True)))


@lru_cache  # a kernel has the truth of the form that it stands for
def _truths(
    exact: Callable[..., Sequence], by: str | None, names: tuple[str, ...], rows: tuple[tuple[float, ...], ...]
):
    import mpmath

    values, slopes = [], []
    with mpmath.workdps(DIGITS):
        for row in rows:
            numbers = dict(zip(names, map(mpmath.mpf, row), strict=True))
            values.append(tuple(exact(**numbers)))
            if by is not None:
                at = numbers[by]
                step = mpmath.mpf(RELATIVE_STEP) * (abs(at) if at != 0 else 1)
                after, before = (exact(**{**numbers, by: at + sign * step}) for sign in (1, -1))
                slopes.append(tuple((a - b) / (2 * step) for a, b in zip(after, before, strict=True)))
    return values, slopes if by is not None else None


def evaluated(case: Case, form: Forms, inputs: dict[str, Tensor], dtype: torch.dtype, constants: Sequence[str]):
    """Outputs of a form and their slopes by ``case.by``, both lists of numbers, [n, outputs]; slopes may be None."""
    given = {name: x.clone() if name in constants else x.to(dtype) for name, x in inputs.items()}
    if case.by is not None:
        given[case.by].requires_grad_()
    outputs = form(**given)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    values = torch.stack([x.detach().double() for x in outputs], 1).tolist()
    if case.by is None:
        return values, None
    slopes = []
    for output in outputs:
        (slope,) = torch.autograd.grad(output.sum(), given[case.by], retain_graph=True, allow_unused=True)
        slopes.append(torch.zeros(len(output)) if slope is None else slope)
    return values, torch.stack([x.double() for x in slopes], 1).tolist()


def worst(found: list[Sequence[float]], exact: list[Sequence], units: list) -> float:
    """The largest error over draws and outputs, in units of each draw; infinite where a value is not finite."""
    import mpmath

    largest = 0.0
    with mpmath.workdps(DIGITS):
        for values, truth, unit in zip(found, exact, units, strict=True):
            if not all(map(math.isfinite, values)):
                return math.inf
            for value, reference in zip(values, truth, strict=True):
                error = abs(value - reference)
                if error != 0:
                    largest = max(largest, float(error / unit) if unit != 0 else math.inf)
    return largest


def measured(case: Case) -> dict[tuple[str, str, str], float | None]:
    """Worst errors by (form, kind, type): "printed" or "ours", "value" or "slope", "float32" or "float64"."""
    inputs = case.draw()
    values, slopes = truths(case, inputs)
    exact = {"value": (values, [case.scale(row) for row in values])}
    if slopes is not None:
        exact["slope"] = slopes, [case.slope_scale(*rows) for rows in zip(values, slopes, strict=True)]
    found: dict[tuple[str, str, str], float | None] = {}
    for form, function, constants in (("printed", case.naive, ()), ("ours", case.ours, case.constants)):
        for name, dtype in TYPES.items():
            absent = form == "ours" and name not in case.types
            results = (None, None) if absent else evaluated(case, function, inputs, dtype, constants)
            for kind, result in zip(("value", "slope"), results, strict=True):
                found[form, kind, name] = None if result is None else worst(result, *exact[kind])
    return found
