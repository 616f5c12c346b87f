"""How much memory a rendering and its gradients take, in a process that did nothing else."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from pathlib import Path

from benchmarks.renderer.peers import backend
from benchmarks.renderer.scenes import Case, build
from heatsplat.kernels.scheduling import use_threads

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def megabytes_above_parameters(case: Case) -> float | None:
    """10^6 bytes that the process holds at most, above what it held with parameters and compiled kernels.

    Gradients, image, scratch and what the renderer keeps for the next step are all in it. None where the system does
    not tell.
    """
    if not CLEAR.exists():
        return None
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (case,))


def _measure(case: Case) -> float:
    use_threads(case.threads)
    _step(replace(case, gaussians=1000, width=64, height=64))  # loads libraries, compiles
    scene, weights = build(case)
    CLEAR.write_text("5")  # the largest resident size so far is forgotten
    before = _resident("VmRSS")
    for _ in range(2):
        _step(case, scene, weights)
    return (_resident("VmHWM") - before) * 1024 / 1e6


def _step(case: Case, scene=None, weights=None) -> None:
    if scene is None:
        scene, weights = build(case)
    leaves = {key: scene[key].requires_grad_() for key in ("means", "quats", "scales", "opacities", "features")}
    (backend("cpu")(**leaves, **scene["camera"]) * weights).sum().backward()
    for leaf in leaves.values():
        leaf.grad = None


def _resident(field: str) -> int:
    """Kilobytes."""
    return next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if line.startswith(field))
