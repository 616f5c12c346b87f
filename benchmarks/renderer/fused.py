"""Whole training steps, and what is fused in them beside what it replaces: python src/study.py study=steps"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.renderer.clocks import interleaved, set_threads
from benchmarks.renderer.floors import Machine
from benchmarks.renderer.report import training_table
from benchmarks.renderer.scenes import Case, build
from benchmarks.renderer.steps import training_rows
from heatsplat.contracts import SceneError, check_count, check_numbers
from heatsplat.io.tables import markdown_table, write_csv
from heatsplat.kernels.peak import memory_rate, vector_rate
from heatsplat.renderers import rasterization
from heatsplat.studies.options import non_empty
from heatsplat.training.adam import OnePassAdam

MAPS = 3
GROUPS = 24  # frequencies of a heat source

log = logging.getLogger("heatsplat")

Row = dict[str, Any]


def run(
    output_dir: Path | str,
    cases: Sequence[Sequence[int]],
    steps: int,
    rounds: int,
    threads: Sequence[int],
    methods: dict[str, Sequence[str]],
    views: Sequence[int] = (1,),
) -> dict[str, list[Row]]:
    """Rows by table, which are also written as CSV and as steps.md.

    Args:
        output_dir: folder of the results.
        cases, steps, rounds, methods: see ``steps.training_rows``; ``rounds`` times ten for the pairs.
        threads: counts of threads; pairs take the first.
        views: counts of views that one update follows.

    Raises:
        SceneError: a list is empty, or a number counts nothing.
    """
    cases, threads = non_empty("study.cases", cases), non_empty("study.threads", threads)
    views = non_empty("study.views", views)
    non_empty("study.methods", list(methods))
    for case in cases:
        check_numbers("each of study.cases", case, 3, SceneError)
    for key, counts in {"steps": [steps], "rounds": [rounds], "threads": threads, "views": views}.items():
        for count in counts:
            check_count(f"study.{key}", count)
    output_dir = Path(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    tables: dict[str, list[Row]] = {"training": [], "fused": []}
    for count in threads:
        machine = Machine(vector_rate(count), memory_rate(count))
        for each in views:
            runs = {
                name: [*says, f"optim.accumulate={each}", "optim.accumulate_from=0"] for name, says in methods.items()
            }
            tables["training"] += training_rows(machine, count, cases, steps, rounds, runs, output_dir)
    set_threads(threads[0])
    for n, w, h in cases:
        for what, pair in PAIRS.items():
            new, old = (
                times.min() for times in interleaved(pair(Case(n, w, h, threads=threads[0])), 10 * rounds).values()
            )
            row = {"case": f"{n:,} at {w}x{h}", "what": what, "threads": threads[0]}
            tables["fused"].append(row | {"processor_ms": new, "before_ms": old, "ratio": new / old})
    for name, rows in tables.items():
        write_csv(output_dir / f"{name}.csv", rows)
    columns = ("case", "what", "threads", "processor_ms", "before_ms", "ratio")
    cells = [
        [f"{cell:.2f}" if isinstance(cell := row[key], float) else cell for key in columns] for row in tables["fused"]
    ]
    lines = ["# A training step, part by part", "", *training_table(tables["training"]), ""]
    lines += ["# What is fused, beside what it replaces", "", *markdown_table(columns, cells), ""]
    text = "\n".join(lines)
    (output_dir / "steps.md").write_text(text, encoding="utf-8")
    log.info("%s", text)
    return tables


def _timed(work: Callable[[], None]) -> Callable[[], tuple[float]]:
    """A function that does some work and returns the processor seconds of all threads, which other programs add little to."""

    def once() -> tuple[float]:
        start = time.process_time()
        work()
        return (time.process_time() - start,)

    return once


def _trained(case: Case) -> list[torch.nn.Parameter]:
    """What ETGS trains, with gradients."""
    generator = torch.Generator().manual_seed(0)
    widths = ((3,), (3,), (4,), (1,), (), (), (2, GROUPS))
    parameters = [torch.nn.Parameter(torch.randn(case.gaussians, *width, generator=generator)) for width in widths]
    for parameter in parameters:
        parameter.grad = torch.randn(parameter.shape, generator=generator)
    return parameters


def adam_pair(case: Case) -> dict[str, Callable]:
    """The step of all tensors in one kernel, and torch's tensor by tensor."""
    optimizers = [kind(_trained(case), lr=1e-4, eps=1e-15, fused=True) for kind in (OnePassAdam, torch.optim.Adam)]
    return {type(optimizer).__name__: _timed(optimizer.step) for optimizer in optimizers}


def group_pair(case: Case) -> dict[str, Callable]:
    """The penalty of a heat source's groups within the optimiser, and as a term of the loss."""
    inside, outside = (_trained(case)[-1] for _ in range(2))
    mine = OnePassAdam([{"params": [inside], "lr": 1e-4, "group_penalty": 1e-3}])
    theirs = OnePassAdam([outside], lr=1e-4)
    gradient = outside.grad

    def as_term() -> None:
        outside.grad = None
        term = 1e-3 * torch.linalg.vector_norm(outside, dim=(0, 1)).sum()
        torch.autograd.backward([term, outside], [torch.ones(()), gradient])
        theirs.step()

    return {"inside": _timed(mine.step), "term": _timed(as_term)}


def maps_pair(case: Case) -> dict[str, Callable]:
    """A rendering with its backward pass that sums maps natively, and by channels of zeros."""
    scene, weights = build(case)
    maps = torch.rand(case.height, case.width, MAPS, generator=torch.Generator().manual_seed(0))
    shapes = {name: scene[name].clone().requires_grad_() for name in ("means", "quats", "scales", "opacities")}

    def native() -> None:
        output = rasterization(**shapes, features=scene["features"], **scene["camera"], depth=False, maps=MAPS)
        ((output.features * weights).sum() + (output.weighted.image * maps).sum()).backward()

    def by_zeros() -> None:
        rows = torch.zeros(case.gaussians, MAPS, requires_grad=True)
        features = torch.cat([rows, scene["features"]], 1)
        image = rasterization(**shapes, features=features, **scene["camera"], depth=False).features
        ((image[..., MAPS:] * weights).sum() + (image[..., :MAPS] * maps).sum()).backward()

    return {"native": _timed(native), "zeros": _timed(by_zeros)}


PAIRS: dict[str, Callable[[Case], dict[str, Callable]]] = {
    "Adam of all tensors in one kernel, against torch's": adam_pair,
    "penalty of groups within Adam, against a loss term": group_pair,
    "sums of three maps natively, against channels of zeros": maps_pair,
}
