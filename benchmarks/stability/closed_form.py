"""Newton's cooling with harmonic sources (physics.relaxation and its fused kernel), and the frequencies of the sources."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.stability.case import Case, log_uniform, uniform
from heatsplat.physics.frequencies import frequency_grid
from heatsplat.physics.fused import visible_temperature
from heatsplat.physics.relaxation import harmonic_response, phases, relax, temperature

COUNT = 300
RATES, FREQUENCIES, TIMES = (1e-12, 1e4), (1e-5, 3e2), (1e-3, 1e5)
AMBIENT, INITIAL = 290.0, 300.0


def _responses() -> dict[str, Tensor]:
    return {
        "rate": log_uniform("rate", *RATES, COUNT),
        "omega": log_uniform("omega", *FREQUENCIES, COUNT),
        "time": log_uniform("time", *TIMES, COUNT),
    }


def _responses_printed(rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """ETGS, Eq. 8: the bracket behind A and the one behind B, with τ = 1/a."""
    tau = 1 / rate
    turn, phase, decay = omega * tau, omega * time, torch.exp(-time / tau)
    front = tau / (1 + turn * turn)
    return (
        front * (phase.sin() - turn * phase.cos() + turn * decay),
        front * (phase.cos() + turn * phase.sin() - decay),
    )


def _responses_ours(rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Of ten bodies at a time, each with a frequency and a time of its own."""
    tens = zip(*(x.split(10) for x in (rate, omega, time)), strict=True)
    pairs = [[found.diagonal() for found in harmonic_response(*ten)] for ten in tens]
    sine, cosine = zip(*pairs, strict=True)
    return torch.cat(sine), torch.cat(cosine)


def _responses_fused(rate: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    gains, still = torch.eye(2)[:, :, None].contiguous(), torch.zeros(2)
    pairs = [
        visible_temperature(t, torch.tensor(0.0), still, a.expand(2), w[None], gains)
        for a, w, t in zip(rate, omega, time, strict=True)
    ]
    return torch.stack(pairs).unbind(1)


def _responses_exact(rate, omega, time):
    import mpmath

    response = (mpmath.expj(omega * time) - mpmath.exp(-rate * time)) / mpmath.mpc(rate, omega)
    return response.imag, response.real


def _insulated() -> dict[str, Tensor]:
    return {
        "conductance": torch.cat([log_uniform("conductance", 1e-30, 1e-2, COUNT - 1), torch.zeros(1).double()]),
        "capacity": log_uniform("capacity", 0.1, 100.0, COUNT),
        "omega": log_uniform("slow", 1e-3, 1.0, COUNT),
        "time": uniform("hour", 1.0, 4e3, COUNT),
        "gain": uniform("gain", 0.0, 0.02, COUNT),
    }


def _insulated_printed(conductance, capacity, omega, time, gain) -> Tensor:
    """ETGS, Eq. 8, with τ = C/h and a source gain C cos ωt."""
    cosine = _responses_printed(conductance / capacity, omega, time)[1]
    return AMBIENT + (INITIAL - AMBIENT) * torch.exp(-time * conductance / capacity) + gain * cosine


def _insulated_ours(conductance, capacity, omega, time, gain) -> Tensor:
    rows = zip(conductance / capacity, omega, time, gain, strict=True)
    ambient, initial = (torch.tensor(x, dtype=gain.dtype) for x in (AMBIENT, INITIAL))
    nothing = torch.zeros(1, 1, dtype=gain.dtype)
    return torch.cat(
        [temperature(t, ambient, initial[None], a[None], w[None], nothing, g[None, None]) for a, w, t, g in rows]
    )


def _insulated_exact(conductance, capacity, omega, time, gain):
    import mpmath

    rate = conductance / capacity
    decay = mpmath.exp(-rate * time)
    response = ((mpmath.expj(omega * time) - decay) / mpmath.mpc(rate, omega)).real
    return (AMBIENT + (INITIAL - AMBIENT) * decay + gain * response,)


def _phases_ours(omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    found = [phases(w[None], t) for w, t in zip(omega, time, strict=True)]
    sine = torch.cat([x.sinc * x.x for x in found])
    return sine, torch.cat([x.cosc * x.x for x in found])


def _phases_exact(omega, time):
    import mpmath

    return mpmath.sin(omega * time), 2 * mpmath.sin(omega * time / 2) ** 2


def _backwards_exact(rate, time):
    import mpmath

    limited = min(rate, 1 / -time)
    return (AMBIENT + (INITIAL - AMBIENT) * mpmath.exp(-limited * time),)


def _backwards_ours(rate: Tensor, time: Tensor) -> Tensor:
    ambient, initial = (torch.tensor(x, dtype=rate.dtype) for x in (AMBIENT, INITIAL))
    return torch.cat([relax(t, ambient, initial[None], a[None]) for a, t in zip(rate, time, strict=True)])


def _highest_ours(gain: Tensor) -> Tensor:
    moments = torch.tensor([0.0, 1e-3, 1e5], dtype=torch.float64)
    return torch.stack([frequency_grid(moments, 2, 1e-4, g.item())[-1] for g in gain])


def _highest_printed(gain: Tensor) -> Tensor:
    return ((1 / gain**2 - 1).sqrt() / 1e-4).clamp(max=math.pi / 1e-3)


def _highest_exact(gain):
    import mpmath

    return (min(mpmath.sqrt(1 / gain**2 - 1) / mpmath.mpf(1e-4), mpmath.pi / mpmath.mpf(1e-3)),)


def _grid_ours(moment: Tensor) -> tuple[Tensor, ...]:
    """The only frequency of a record in which a moment comes twice."""
    grids = [frequency_grid(torch.stack([0 * t, t, t]), 1, 1.0, 0.5) for t in moment]
    return (torch.cat(grids),)


def _grid_printed(moment: Tensor) -> tuple[Tensor, ...]:
    lowest, gap = 1 / moment, moment - moment
    highest = torch.minimum(0.5 / gap, torch.full_like(gap, math.sqrt(3) / (2 * math.pi)))
    return (2 * math.pi * lowest * (highest / lowest) ** (gap / gap),)  # the exponent is (k - 1)/(K - 1) with K = 1


def _grid_exact(moment):
    import mpmath

    return (2 * mpmath.pi / moment,)


def _unit(exact):
    return 1


CASES = (
    Case(
        "Responses to sin ωt and cos ωt of a body with rate a",
        "a 1e-12 .. 1e4 1/s, ω 1e-5 .. 300 rad/s, t 1e-3 .. 1e5 s; slope by a",
        "ETGS Eq. 8 with τ = C/h",
        "\\|S\\| + \\|C\\|",
        _responses, _responses_printed, _responses_ours, _responses_exact,
        by="rate", constants=("omega", "time"), promise=4.2,
    ),
    Case(
        "The same in the fused kernel of heat",
        "as above",
        "ETGS Eq. 8 with τ = C/h",
        "\\|S\\| + \\|C\\|",
        _responses, _responses_printed, _responses_fused, _responses_exact,
        by="rate", constants=("omega", "time"), promise=5.0, types=("float32",),
    ),
    Case(
        "A body with (almost) no heat exchange",
        "h 1e-30 .. 0.01 and 0, C 0.1 .. 100, ω 0.001 .. 1 rad/s, t 1 .. 4000 s, 300 K before 290 K, source up to 0.02 K/s",
        "ETGS Eq. 8 with τ = C/h",
        "300 K",
        _insulated, _insulated_printed, _insulated_ours, _insulated_exact,
        constants=("omega", "time"), scale=lambda exact: 300, promise=4.0,
    ),
    Case(
        "A time before the first training frame",
        "a 1e-12 .. 1e4 1/s, t -1e5 .. -1e-3 s; defined as at most one time constant backwards; slope by a",
        "e^{-at}",
        "300 K; slope: itself",
        lambda: {"rate": log_uniform("early", *RATES, COUNT), "time": -log_uniform("before", *TIMES, COUNT)},
        lambda rate, time: AMBIENT + (INITIAL - AMBIENT) * torch.exp(-rate * time),
        _backwards_ours, _backwards_exact,
        by="rate", constants=("time",), scale=lambda exact: 300, promise=2.0,
    ),
    Case(
        "sin ωt and 1 - cos ωt late in a long record",
        "ω 1e-5 .. 300 rad/s, t 1e-3 .. 1e5 s: up to 3e7 rad",
        "sin and cos of the product",
        "1",
        lambda: {name: x * (1 + 1e-9) for name, x in _responses().items() if name != "rate"},
        lambda omega, time: (torch.sin(omega * time), 1 - torch.cos(omega * time)),
        _phases_ours, _phases_exact, constants=("omega", "time"), scale=_unit, promise=4.0, types=("float64",),
    ),
    Case(
        "The highest frequency that a body follows",
        "least gain α 0.05 .. 1 - 6e-8",
        "√(1/α² - 1)/τ (ETGS Eq. 32)",
        "itself",
        lambda: {"gain": (1 - log_uniform("loss", 6e-8, 0.95, COUNT)).float().double()},
        _highest_printed, _highest_ours, _highest_exact, constants=("gain",), promise=8.0, types=("float64",),
    ),
    Case(
        "One frequency, and two frames at the same time",
        "K = 1, moments 0, t, t with t 1 .. 1e5 s",
        "(k - 1)/(K - 1), 1/(2 Δt_min) (ETGS Eq. 28, 7)",
        "itself",
        lambda: {"moment": log_uniform("moment", 1.0, 1e5, 30)},
        _grid_printed, _grid_ours, _grid_exact, constants=("moment",), promise=4.0, types=("float64",),
    ),
)  # fmt: skip
