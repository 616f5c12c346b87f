"""Ways to integrate a problem from frame to frame: fixed steps, torchdiffeq's, and scipy's Radau.

All take the same equation and step onto every frame and every kink of the drivers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.work_precision.problems import Problem


class OverLimit(Exception):
    """An integration took longer than it may."""


class Missing(Exception):
    """A library of solvers is not installed."""


class _Clocked:
    """An equation that stops an integration that is over its limit."""

    def __init__(self, equation, limit_s: float) -> None:
        self.equation, self.end = equation, time.process_time() + limit_s
        self.decay, self.constant_rate = equation.decay, equation.constant_rate

    def slope(self, t: float, x: Tensor) -> Tensor:
        if time.process_time() > self.end:
            raise OverLimit
        return self.equation.slope(t, x)


def euler(equation, t: float, x: Tensor, h: float, weights) -> Tensor:
    return x + h * equation.slope(t, x)


def rk4(equation, t: float, x: Tensor, h: float, weights) -> Tensor:
    a = equation.slope(t, x)
    b = equation.slope(t + h / 2, x + h / 2 * a)
    c = equation.slope(t + h / 2, x + h / 2 * b)
    d = equation.slope(t + h, x + h * c)
    return x + h / 6 * (a + 2 * (b + c) + d)


def exponential_euler(equation, t: float, x: Tensor, h: float, weights) -> Tensor:
    """Exact for the linear part; what drives is held at its value at the step's beginning."""
    return x + weights(t, x, h)[0] * equation.slope(t, x)


def etd2(equation, t: float, x: Tensor, h: float, weights) -> Tensor:
    """Cox and Matthews 2002, Eq. 22: the driver is taken to be linear over the step."""
    one, two, decay = weights(t, x, h)
    before = equation.slope(t, x)
    guess = x + one * before
    return guess + two * (equation.slope(t + h, guess) - before + decay * (guess - x))


FIXED: dict[str, Callable] = {
    "explicit Euler": euler, "RK4": rk4, "exponential Euler": exponential_euler, "ETD2": etd2,
}  # fmt: skip
RADAU = "Radau (scipy)"  # float64 only
ADAPTIVE = ("dopri5 (torchdiffeq)", RADAU)
IMPLICIT_ADAMS = "implicit Adams (torchdiffeq)"
NAMES = (*FIXED, IMPLICIT_ADAMS, *ADAPTIVE)


class _Weights:
    """h φ1, h φ2 and the rate of an equation, [N] each; kept while neither step nor rate changes."""

    def __init__(self, equation) -> None:
        self.equation, self.kept = equation, {}

    def __call__(self, t: float, x: Tensor, h: float) -> tuple[Tensor, Tensor, Tensor]:
        if h in self.kept:
            return self.kept[h]
        decay = self.equation.decay(t, x)
        y = decay * h
        small = y < (
            1e-2 if y.dtype == torch.float32 else 1e-4
        )  # where rounding of the quotient passes the series' rest
        safe = torch.where(small, 1.0, y)
        one = torch.where(small, 1 - y * (1 / 2 - y / 6 * (1 - y / 4)), -torch.expm1(-safe) / safe)
        two = torch.where(small, 1 / 2 - y / 6 * (1 - y / 4), (1 - one) / safe)
        found = h * one, h * two, decay
        if self.equation.constant_rate:
            self.kept[h] = found
        return found


def integrate(problem: Problem, name: str, knob: float, dtype: torch.dtype, limit_s: float) -> Callable[[], Tensor]:
    """A function that integrates once and returns temperatures [F, N].

    Args:
        knob: seconds of a step, or the tolerance (relative to 1 K) of an adaptive solver.
        limit_s: it raises OverLimit after this many seconds of the processor.

    Raises:
        Missing: torchdiffeq is needed and not installed.
    """
    equation, initial = problem.equation(dtype), problem.initial.to(dtype)
    stops = sorted({*problem.moments_s, *problem.kinks_s})
    if name in FIXED:
        return lambda: _fixed(FIXED[name], _Clocked(equation, limit_s), initial, stops, problem.moments_s, knob)
    if name == RADAU:
        return lambda: _radau(_Clocked(equation, limit_s), initial, problem.moments_s, knob)
    try:
        from torchdiffeq import odeint
    except ImportError:
        raise Missing(f"{name} is left out: pip install torchdiffeq") from None

    def run() -> Tensor:
        clocked = _Clocked(equation, limit_s)
        moments = torch.tensor([0.0, *problem.moments_s], dtype=torch.float64)

        def slope(t: Tensor, x: Tensor) -> Tensor:
            return clocked.slope(float(t), x)

        if name == IMPLICIT_ADAMS:
            grid = torch.tensor(_steps([0.0, *stops], knob), dtype=torch.float64)
            options = {"grid_constructor": lambda f, y, t: grid}
            return odeint(slope, initial, moments, rtol=1e-7, atol=1e-7, method="implicit_adams", options=options)[1:]
        options = {"dtype": torch.float64, "max_num_steps": 2**31 - 1}
        if problem.kinks_s:
            options["jump_t"] = torch.tensor(problem.kinks_s, dtype=torch.float64)
        return odeint(slope, initial, moments, rtol=0.0, atol=knob, method="dopri5", options=options)[1:]

    return run


def _steps(stops: list[float], step_s: float) -> list[float]:
    """Moments from stop to stop in equal steps of at most ``step_s``."""
    found = [stops[0]]
    for start, stop in zip(stops[:-1], stops[1:], strict=True):
        count = max(1, math.ceil((stop - start) / step_s - 1e-9))
        found += [start + (stop - start) * j / count for j in range(1, count)] + [stop]
    return found


def _fixed(step, equation, x: Tensor, stops: list[float], moments: tuple[float, ...], step_s: float) -> Tensor:
    weights, frames, values, t = _Weights(equation), set(moments), [], 0.0
    for stop in stops:
        count = max(1, math.ceil((stop - t) / step_s - 1e-9))
        h = (stop - t) / count
        for j in range(count):
            x = step(equation, t + j * h, x, h, weights)
        t = stop
        if stop in frames:
            values.append(x)
    return torch.stack(values)


def _radau(equation, x: Tensor, moments: tuple[float, ...], tolerance: float) -> Tensor:
    """scipy's Radau IIA of order 5 on all Gaussians at once with a diagonal Jacobian; its own steps, onto no kink."""
    from scipy.integrate import solve_ivp
    from scipy.sparse import diags

    found = solve_ivp(
        lambda t, y: equation.slope(t, torch.from_numpy(y)).numpy(),
        (0.0, moments[-1]),
        x.numpy(),
        method="Radau",
        t_eval=moments,
        rtol=1e-13,  # the tolerance is absolute: temperatures may be in kelvin or counted from a reference
        atol=tolerance,
        jac=lambda t, y: diags(-equation.decay(t, torch.from_numpy(y)).numpy(), format="csc"),
    )
    return torch.from_numpy(found.y.T)
