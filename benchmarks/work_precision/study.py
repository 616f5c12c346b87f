"""What accuracy costs: error in kelvin against microseconds per Gaussian and frame, ours beside usual solvers.

The rules stand first in the document (report.py). Everything is measured in one run; what was given up is listed.
"""

from __future__ import annotations

import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.work_precision import report
from benchmarks.work_precision.problems import Problem, problems
from benchmarks.work_precision.solvers import ADAPTIVE, NAMES, RADAU, Missing, OverLimit, integrate
from heatsplat.composition import compose
from heatsplat.io.tables import write_csv
from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.studies.options import listed, subset_of

log = logging.getLogger("heatsplat")


@dataclass
class Row:
    """One point: a solver with one setting on one problem.

    Args:
        problem, solver, setting, type: which.
        ours: whether the product solves it so.
        us: microseconds per Gaussian and frame, all frames in order.
        us_alone: the same where each frame is asked for by itself, as training does.
        worst_k, rms_k: errors in kelvin; infinite if it diverged.
        setup_s: seconds spent once for a record, not in ``us``.
        given_up: why there is no result, or "".
    """

    problem: str
    solver: str
    setting: str
    type: str
    ours: bool
    us: float
    us_alone: float
    worst_k: float
    rms_k: float
    setup_s: float = 0.0
    given_up: str = ""


@dataclass
class _Timed:
    row: Row
    run: Callable[[], Tensor]
    values: Tensor  # temperatures [F, N]
    seconds: float


def run(output_dir: Path | str, document: str | None = None, pictures: str | None = None, **settings: Any) -> list[Row]:
    """Every point of ``measurements``, which is also written as CSV, Markdown and pictures into ``output_dir``.

    Args:
        output_dir: folder of the results.
        document: Markdown file to write as well, or None.
        pictures: folder for the document's pictures, or None.
        settings: of ``measurements``. The document is written only with those of conf/study/work_precision.yaml: it says that
            its command has none, and few Gaussians or problems replace no whole page.
    """
    begin, load = time.perf_counter(), os.getloadavg()[0]
    rows, titles = measurements(**settings)
    output_dir = Path(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    write_csv(output_dir / "work_precision.csv", map(asdict, rows), [field.name for field in fields(Row)])
    load, seconds = max(load, os.getloadavg()[0]), time.perf_counter() - begin
    usual = compose(["study=work_precision"], "study")["study"]
    whole = all(usual[key] == value for key, value in settings.items())
    rules = report.rules(settings, load, seconds)
    text = report.write(rows, titles, rules, output_dir, document if whole else None, pictures if whole else None)
    log.info("%s", text)
    return rows


def measurements(
    gaussians: int,
    frames: int,
    frequencies: int,
    sample: int,
    types: Sequence[str],
    steps: Mapping[str, Sequence[float]],
    tolerances: Sequence[float],
    rates: Sequence[int],
    rounds: int,
    once_above_s: float,
    limit_s: float,
    adaptive_limit_s: float,
    only: Sequence[str] | None = None,
    solvers: Sequence[str] | None = None,
) -> tuple[list[Row], dict[str, str]]:
    """Every point, and the titles of the problems by name. Threads are set to one meanwhile.

    Args:
        gaussians, frames: N and F.
        frequencies: K of the harmonic sources.
        sample: how many Gaussians the reference is computed for.
        types: "float32", "float64" or both.
        steps: seconds of a step of the solvers with fixed steps, for each problem, in falling order.
        tolerances: of adaptive solvers, in kelvin, in falling order.
        rates: sizes of the tables over log rate.
        rounds: interleaved rounds; the minimum counts.
        once_above_s: what takes longer runs only once.
        limit_s, adaptive_limit_s: an integration is given up after so many seconds of the processor.
        only: names of problems; None for all.
        solvers: names of time-stepping solvers; None for all, [] for none.

    Raises:
        SceneError: a name is unknown, or there is no problem.
    """
    makers = problems(gaussians, frames, frequencies)
    only = list(makers) if only is None else subset_of("study.only", only, makers)
    solvers = list(NAMES) if solvers is None else listed(solvers) and subset_of("study.solvers", solvers, NAMES)
    before = thread_count(), torch.get_num_threads()
    use_threads(1)
    torch.set_num_threads(1)
    rows, titles = [], {}
    try:
        with torch.no_grad(), warnings.catch_warnings(), np.errstate(over="ignore", invalid="ignore"):
            warnings.filterwarnings("ignore", "Functional iteration did not converge")  # it shows in the error
            for name in only:
                problem = makers[name]()
                titles[name] = problem.title
                truth = problem.reference(sample)
                timed, given_up = _forms(problem, tuple(types), tuple(rates)), []
                for solver in solvers:
                    adaptive = solver in ADAPTIVE
                    knobs, limit = (tolerances, adaptive_limit_s) if adaptive else (steps[name], limit_s)
                    of_type = [kind for kind in types if solver != RADAU or kind == "float64"]  # scipy has no other
                    for found in _integrations(problem, solver, of_type, knobs, limit):
                        (given_up if isinstance(found, Row) else timed).append(found)
                _finish(problem, timed, truth, rounds, once_above_s)
                rows += [one.row for one in timed] + given_up
                log.info("%s: %d points", name, len(timed))
    finally:
        use_threads(before[0])
        torch.set_num_threads(before[1])
    return rows, titles


def _forms(problem: Problem, types: tuple[str, ...], rates: tuple[int, ...]) -> list[_Timed]:
    """The solutions without time steps; one moment of each is computed untimed, which compiles kernels."""
    timed = []
    for form in problem.forms(types, rates):
        form.build()(problem.moments_s[0])
        start = time.process_time()
        at = form.build()
        row = _row(problem, form.name, form.knob, form.type, ours=form.ours, setup_s=time.process_time() - start)
        timed.append(_timed(row, lambda at=at: torch.stack([at(t) for t in problem.moments_s])))
    return timed


def _integrations(
    problem: Problem, solver: str, types: Sequence[str], knobs: Sequence[float], limit_s: float
) -> Iterator[_Timed | Row]:
    """The integrations by a solver from the coarsest setting on, until one is given up; that one as a row alone."""
    adaptive, hopeless = solver in ADAPTIVE, ""
    for kind in types:
        expected = 0.0
        for i, knob in enumerate(knobs):
            row = _row(problem, solver, f"tolerance {knob:g} K" if adaptive else f"{knob:g} s", kind)
            row.given_up = hopeless
            try:
                if expected > limit_s:
                    raise OverLimit
                if not hopeless:
                    found = _timed(row, integrate(problem, solver, knob, getattr(torch, kind), limit_s))
            except OverLimit:
                row.given_up = f"over {limit_s:g} s"
            except AssertionError:  # torchdiffeq says so
                row.given_up = "no step is small enough"
            except Missing as missing:
                log.warning("%s", missing)
                row.given_up = str(missing)
            if row.given_up:
                hopeless = row.given_up if adaptive and i == 0 else ""  # in the other type too
                yield row
                break
            yield found
            if not adaptive and i + 1 < len(knobs):
                expected = found.seconds * knob / knobs[i + 1]


def _row(problem: Problem, solver: str, setting: str, kind: str, ours: bool = False, setup_s: float = 0.0) -> Row:
    return Row(problem.name, solver, setting, kind, ours, math.nan, math.nan, math.nan, math.nan, setup_s)


def _timed(row: Row, once: Callable[[], Tensor]) -> _Timed:
    start = time.process_time()  # on one thread the wall's, but for other programs
    values = once()
    return _Timed(row, once, values, time.process_time() - start)


def _finish(problem: Problem, timed: list[_Timed], truth: np.ndarray, rounds: int, once_above_s: float) -> None:
    """Fills errors and times of rows; in further rounds the runs of all solvers take turns."""
    for _ in range(rounds - 1):
        for one in timed:
            if one.seconds <= once_above_s:
                one.seconds = min(one.seconds, _timed(one.row, one.run).seconds)
    moments, count = problem.moments_s, len(problem.initial)
    for one in timed:
        error = one.values[:, : len(truth)].double().numpy().T - truth
        one.row.us = 1e6 * one.seconds / (count * len(moments))
        stepped = one.row.solver in NAMES  # up to each frame anew
        one.row.us_alone = one.row.us * (sum(moments) / moments[-1] if stepped else 1.0)
        finite = np.isfinite(error).all()
        one.row.worst_k = float(np.abs(error).max()) if finite else math.inf
        one.row.rms_k = float(np.sqrt(np.mean(error**2))) if finite else math.inf
