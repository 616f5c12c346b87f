"""How fast the CPU renderer is: against its peers in paired ratios, and against the floor of this processor.

Rules: one process; what is compared runs interleaved, so that a busy moment hits all alike; figures are minima and
ratios are of minima, since medians tell of other programs; forward and backward of one view with random weights on
the image; compilation is left out.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.history import add_line
from benchmarks.renderer import peers as other
from benchmarks.renderer.clocks import interleaved, set_threads
from benchmarks.renderer.floors import Machine
from benchmarks.renderer.memory import megabytes_above_parameters
from benchmarks.renderer.report import write
from benchmarks.renderer.scenes import Case, build
from benchmarks.renderer.steps import training_rows, work_of
from heatsplat.kernels.peak import memory_rate, vector_rate
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import Photometric

log = logging.getLogger("heatsplat")

Row = dict[str, Any]


def run(
    output_dir: Path | str,
    counts: Sequence[int] = (10_000, 30_000, 100_000, 300_000),
    sizes: Sequence[Sequence[int]] = ((160, 128), (256, 205), (512, 410), (720, 480)),
    channels: Sequence[int] = (1, 3, 4),
    modalities: Sequence[int] = (1, 2),
    threads: Sequence[int] = (1, 2),
    rounds: int = 8,
    torch_tiles: Sequence[Sequence[int]] = ((10_000, 160, 128), (10_000, 512, 410)),
    peers: dict[str, str] | None = None,
    peer_cases: Sequence[Sequence[int]] = ((10_000, 160, 128), (100_000, 512, 410)),
    garden: str | None = None,
    training: dict[str, Any] | None = None,
    memory: Sequence[int] | None = (300_000, 720, 480),
    history: str | None = None,
) -> dict[str, list[Row]]:
    """Rows by table, which are also written as CSV, Markdown and a picture into ``output_dir``.

    Args:
        output_dir: folder of the results.
        counts, sizes: N and [width, height]; every N at every size with one channel and all threads.
        channels, modalities, threads: what else is varied, at 100,000 Gaussians and 512x410 or what comes nearest.
        rounds: interleaved repetitions; the minimum counts.
        torch_tiles: [N, width, height] at which the pure-torch tile renderer runs beside, with C = 3; it takes seconds.
        peers: name -> "module:function" of further renderers with the arguments of ``rasterization`` up to the height,
            returning the image, such as a binding to a built peer. gsplat joins by itself where there is a GPU.
        peer_cases: where ``peers`` run, with C = 3.
        garden: file of real points (npz with means3d, viewmats, Ks, width, height), or None; left out where it is not.
        training: what ``steps.training_rows`` takes beside machine, threads and folder, or None to leave training steps out.
        memory: [N, width, height] at which memory is measured in a process of its own, or None.
        history: file that gets a line with the ratios of this commit and machine, or None.
    """
    output_dir = Path(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    most = max(threads)
    machines = {count: Machine(vector_rate(count), memory_rate(count)) for count in threads}
    middle = _middle(counts, sizes, most)
    cases = [Case(n, w, h, threads=most) for w, h in sizes for n in counts]
    cases += [replace(middle, channels=c) for c in channels if c != middle.channels]
    cases += [replace(middle, channels=c, threads=t) for t in threads if t != most for c in channels]
    if garden is not None and Path(garden).exists():
        cases += [replace(middle, points=str(garden), channels=c) for c in channels]
    tables: dict[str, list[Row]] = {"renderer": [_renderer_row(case, rounds, machines) for case in cases]}
    tables["modalities"] = _modality_rows(middle, modalities, rounds, machines)
    tables["peers"] = _peer_rows(torch_tiles, peer_cases, peers or {}, max(2, rounds // 2), threads)
    tables["loss"] = [_loss_row(w, h, c, most, rounds) for w, h in sizes for c in channels]
    if memory is not None:
        case = Case(*memory, threads=most)
        tables["memory"] = [{"case": case.name, "megabytes": megabytes_above_parameters(case)}]
    if training is not None:
        tables["training"] = training_rows(machines[most], most, **training, output_dir=output_dir)
    write(tables, output_dir, machines)
    if history is not None:
        add_line(Path(history), tables)
    log.info("the study took %.0f s", time.perf_counter() - begin)
    return tables


def _middle(counts: Sequence[int], sizes: Sequence[Sequence[int]], threads: int) -> Case:
    width, height = min(sizes, key=lambda size: abs(size[0] - 512))
    return Case(min(counts, key=lambda n: abs(n - 100_000)), width, height, threads=threads)


# ---- clocks ----


def _best_of(times: int, timed: Callable[[], tuple[float, float]]) -> Callable[[], tuple[float, float]]:
    """A function that runs another some times and returns the quickest: short runs are disturbed as a whole."""
    return lambda: min((timed() for _ in range(times)), key=sum)


def _pass(renderer: other.Renderer, case: Case) -> Callable[[], tuple[float, float]]:
    """A function that renders a case with gradients and returns the seconds of both passes."""
    scene, weights = build(case)

    def timed() -> tuple[float, float]:
        set_threads(case.threads)
        names = ("means", "quats", "scales", "opacities", "features")
        leaves = {name: scene[name].clone().requires_grad_() for name in names}
        start = time.perf_counter()
        image = renderer(**leaves, **scene["camera"])
        if image.is_cuda:
            torch.cuda.synchronize()
        middle = time.perf_counter()
        loss = (image * weights.to(image.device)).sum()
        between = time.perf_counter()
        loss.backward()
        return middle - start, time.perf_counter() - between

    return timed


# ---- tables ----


def _renderer_row(case: Case, rounds: int, machines: dict[int, Machine]) -> Row:
    forward, backward = interleaved({"": _pass(other.backend("cpu"), case)}, rounds)[""].min(0)
    work = work_of(case)
    floors = work.floors(machines[case.threads])
    floor_forward = floors["projection"] + floors["binning"] + floors["forward"]
    floor_backward = floors["backward"] + floors["gradients"]
    log.info("%s, %d thread(s): forward %.1f ms, backward %.1f ms", case.name, case.threads, forward, backward)
    return {
        "case": case.name,
        "gaussians": work.gaussians,
        "pixels": work.pixels,
        "channels": case.channels,
        "threads": case.threads,
        "points": case.points if case.points == "synthetic" else Path(case.points).stem,
        "forward_ms": forward,
        "floor_forward_ms": floor_forward,
        "share_forward": floor_forward / forward,
        "backward_ms": backward,
        "floor_backward_ms": floor_backward,
        "share_backward": floor_backward / backward,
        "load": os.getloadavg()[0],
    }


def _modality_rows(middle: Case, modalities: Sequence[int], rounds: int, machines: dict[int, Machine]) -> list[Row]:
    """Several opacities in one pass against one, with as many channels."""
    rows = []
    for count in (m for m in modalities if m > 1):
        cases = {f"M={m}": replace(middle, channels=count, modalities=m) for m in (1, count)}
        times = interleaved({name: _pass(other.backend("cpu"), case) for name, case in cases.items()}, rounds)
        one, several = (values.sum(1) for values in times.values())
        rows.append(
            {
                "case": cases[f"M={count}"].name,
                "ms": several.min(),
                "ms_of_one": one.min(),
                "ratio": several.min() / one.min(),
                "load": os.getloadavg()[0],
            }
        )
    return rows


def _peer_rows(
    torch_tiles: Sequence[Sequence[int]],
    peer_cases: Sequence[Sequence[int]],
    peers: dict[str, str],
    rounds: int,
    threads: Sequence[int],
) -> list[Row]:
    """The renderer beside others, three channels, all threads and one."""
    renderers = {name: (other.from_path(path), peer_cases) for name, path in peers.items()}
    renderers["torch tiles"] = other.render_torch_tiles, torch_tiles
    if torch.cuda.is_available():
        renderers["gsplat"] = other.backend("gsplat"), peer_cases
    rows = []
    for name, (renderer, cases) in renderers.items():
        for n, w, h in cases:
            case = Case(n, w, h, channels=3, threads=max(threads))
            runs = {name: _pass(renderer, case)}
            for t in sorted(threads):
                runs[f"{t} thread(s)"] = _best_of(5, _pass(other.backend("cpu"), replace(case, threads=t)))
            times = {key: values.sum(1) for key, values in interleaved(runs, rounds).items()}
            peer = times.pop(name)
            row = {"case": case.name, "peer": name, "peer_ms": peer.min()}
            for key, own in times.items():
                row |= {f"ms, {key}": own.min(), f"ratio, {key}": peer.min() / own.min()}
            rows.append(row | {"load": os.getloadavg()[0]})
            log.info("%s: %s takes %.0f times as long", case.name, name, rows[-1][f"ratio, {key}"])
    return rows


def _loss_row(width: int, height: int, channels: int, threads: int, rounds: int) -> Row:
    """The fused loss beside convolutions, forward and backward."""
    generator = torch.Generator().manual_seed(0)
    prediction, target = torch.rand(2, height, width, channels, generator=generator)
    photometric = Photometric()

    def fused(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return sum(photometric(LossInputs(image, target, None, None, None)).values())

    def timed(loss: Callable) -> Callable[[], tuple[float]]:
        def once() -> tuple[float]:
            set_threads(threads)
            image = prediction.clone().requires_grad_()
            start = time.perf_counter()
            loss(image, target).backward()
            return (time.perf_counter() - start,)

        return once

    losses = {"fused": fused, "full window": other.full_window_loss, "separable": other.separable_loss}
    times = interleaved({name: timed(loss) for name, loss in losses.items()}, rounds)
    row = {"case": f"{width}x{height}, C={channels}", "fused_ms": times["fused"].min()}
    for name in ("full window", "separable"):
        row |= {f"{name}, ms": times[name].min(), f"{name}, ratio": times[name].min() / times["fused"].min()}
    return row | {"load": os.getloadavg()[0]}
