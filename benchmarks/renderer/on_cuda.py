"""Training steps on CUDA, Triton's kernels against plain torch, and gsplat with and without our contract: study=cuda"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from benchmarks.renderer.scenes import Case, build
from benchmarks.renderer.steps import STILL, at_home, still_scene
from heatsplat.composition import compose
from heatsplat.contracts import SceneError, check_count, check_option
from heatsplat.io.tables import markdown_table, write_csv
from heatsplat.kernels import gpu
from heatsplat.renderers import rasterization
from heatsplat.runs.run import build_module
from heatsplat.runs.stepping import Stepper

VIEWS = 10  # that steps and renders take in turn
WARM_UP = 8  # rounds in which kernels are compiled and memory is found

log = logging.getLogger("heatsplat")

Row = dict[str, Any]


def run(
    output_dir: Path | str,
    cases: Sequence[Sequence[int]],
    rounds: int,
    methods: dict[str, Sequence[str]],
    device: str = "cuda",
) -> dict[str, list[Row]]:
    """Rows by table, which are also written as CSV and as cuda.md into ``output_dir``.

    Figures are medians over ``rounds``, milliseconds of wall time of work that has ended on the device; what a row compares takes
    turns.

    Args:
        output_dir: folder of the results.
        cases: Gaussians, width and height.
        rounds: of each figure.
        methods: name -> what the command line of the run says.
        device: "cuda" or "cpu", where both ways of a step are the same, and gsplat is left out.

    Raises:
        SceneError: there is no such device, or PyTorch sees none, or an option counts nothing.
    """
    check_option("study.device", device, ("cuda", "cpu"), SceneError)
    check_count("study.rounds", rounds)
    if device == "cuda" and not torch.cuda.is_available():
        raise SceneError(
            "study=cuda times steps on CUDA, and PyTorch sees no CUDA device here; study=steps is for the CPU"
        )
    output_dir = Path(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    tables: dict[str, list[Row]] = {"steps": [], "renderer": []}
    for count, width, height in cases:
        case = Case(count, width, height)
        for name, says in methods.items():
            tables["steps"].append(
                {"case": case.name, "method": name} | _step_row(case, says, rounds, device, output_dir)
            )
            log.info("%s", tables["steps"][-1])
        if device == "cuda":
            tables["renderer"].append({"case": case.name} | _render_row(case, rounds))
            log.info("%s", tables["renderer"][-1])
    where = torch.cuda.get_device_name() if device == "cuda" else "CPU"
    lines = [f"# {where}, torch {torch.__version__}", ""]
    for name, rows in tables.items():
        if rows:
            write_csv(output_dir / f"{name}.csv", rows)
            cells = [[f"{cell:.3g}" if isinstance(cell, float) else cell for cell in row.values()] for row in rows]
            lines += [*markdown_table(list(rows[0]), cells), ""]
    (output_dir / "cuda.md").write_text("\n".join(lines), encoding="utf-8")
    return tables


def _step_row(case: Case, says: Sequence[str], rounds: int, device: str, output_dir: Path) -> Row:
    """Milliseconds of a step with Triton's kernels and without, and the megabytes that it takes on the device."""
    scene, _ = build(case)
    config = compose([*STILL, "max_steps=1000", f"cap_max={2 * len(scene['means'])}", *says])
    module, views = build_module(config, output_dir), still_scene(scene)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    stepper = Stepper(module, views, step=500, device=device)
    at_home(module, scene)
    seen = [views.train[k].to(device) for k in range(VIEWS)]

    def stepping(kernels: bool) -> Callable[[int], None]:
        def step(k: int) -> None:
            with patch.object(gpu, "available", gpu.available if kernels else lambda: False):
                stepper.step(seen[k % VIEWS])

        return step

    fused, plain = _medians([stepping(True), stepping(False)], rounds, device)
    memory = torch.cuda.max_memory_allocated() / 1e6 if device == "cuda" else float("nan")
    return {"ms": fused, "plain torch ms": plain, "ratio": plain / fused, "MB": memory}


def _render_row(case: Case, rounds: int) -> Row:
    """Milliseconds of a forward and backward pass of gsplat by itself and behind our contract, and their largest difference."""
    from gsplat import rasterization as alone  # here: only where there is CUDA

    scene, weights = build(case)
    camera, weights = scene["camera"], weights.cuda()
    names = ("means", "quats", "scales", "opacities", "features")
    leaves = {name: scene[name].cuda().requires_grad_() for name in names}
    size, pose = (camera["width"], camera["height"]), camera["viewmats"].float().cuda()[None]
    K = camera["Ks"].float().cuda()[None]

    def theirs() -> torch.Tensor:
        return alone(*leaves.values(), pose, K, *size, packed=False)[0][0]

    def ours() -> torch.Tensor:
        return rasterization(**leaves, **camera, backend="gsplat", depth=False).features

    def passing(render: Callable[[], torch.Tensor]) -> Callable[[int], None]:
        return lambda k: (render() * weights).sum().backward()

    gsplat_ms, ours_ms = _medians([passing(theirs), passing(ours)], rounds, "cuda")
    with torch.no_grad():
        difference = (theirs() - ours()).abs().max().item()
    return {"gsplat ms": gsplat_ms, "ours ms": ours_ms, "ratio": ours_ms / gsplat_ms, "largest difference": difference}


def _medians(works: Sequence[Callable[[int], None]], rounds: int, device: str) -> list[float]:
    """Milliseconds of each, medians over rounds in which they take turns."""
    took: list[list[float]] = [[] for _ in works]
    for k in range(WARM_UP + rounds):
        for work, times in zip(works, took, strict=True):
            start = time.perf_counter()
            work(k)
            if device == "cuda":
                torch.cuda.synchronize()
            times.append(1e3 * (time.perf_counter() - start))
    return [sorted(times[WARM_UP:])[rounds // 2] for times in took]
