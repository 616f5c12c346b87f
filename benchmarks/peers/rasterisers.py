"""Rasteriser by rasteriser: forward and backward of one view in turns, and how far the gradients of each are from float64.

Three channels wherever the two are compared, since others draw no fewer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.peers.scenes import SharedScene
from benchmarks.renderer.peers import Renderer, backend
from benchmarks.renderer.scenes import Case, build
from heatsplat.geometry.neighbours import neighbour_distances
from heatsplat.kernels.scheduling import use_threads

LEAVES = ("means", "quats", "scales", "opacities", "features")
Row = dict[str, Any]
Drawn = tuple[dict[str, Any], Tensor]  # arguments of rasterization, cameras under "camera"; random weights of the image


def of_points(scene: SharedScene, channels: int) -> Drawn:
    """A scene as ``benchmarks.renderer.scenes.build`` makes them, of the points and the first camera of another.

    Gaussians are as large as the distance to their neighbours, somewhat more or less along each axis; all else is random.
    """
    generator = torch.Generator().manual_seed(0)
    count, camera = len(scene.points), scene.first
    size = neighbour_distances(scene.points).square().mean(1, keepdim=True).sqrt()
    drawn = {
        "means": scene.points.float(),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": size * torch.exp(0.5 * torch.randn(count, 3, generator=generator)),
        "opacities": torch.sigmoid(1.5 * torch.randn(count, generator=generator) + 0.35),
        "features": torch.rand(count, channels, generator=generator),
        "camera": {
            "viewmats": camera.viewmat.float(),
            "Ks": camera.K.float(),
            "width": camera.width,
            "height": camera.height,
        },
    }
    return drawn, torch.randn(camera.height, camera.width, channels, generator=generator)


def timings(
    scenes: Mapping[str, Callable[[int], Drawn]], peers: Mapping[str, Renderer], threads: Sequence[int], rounds: int
) -> list[Row]:
    """Milliseconds of each peer and of ours, in turns, and their ratio; minima over rounds, the first one not counted.

    Args:
        scenes: name -> what is drawn with so many channels.
        peers: name -> renderer, which uses as many threads as torch does.
        threads: numbers of threads; both programs have as many.
        rounds: in turns.
    """
    rows = []
    for name, drawn in scenes.items():
        three, one = drawn(3), drawn(1)
        for count in threads:
            use_threads(count)
            torch.set_num_threads(count)
            runs = {f"{peer}, C = 3": (renderer, three) for peer, renderer in peers.items()}
            runs |= {"heatsplat, C = 3": (backend("cpu"), three), "heatsplat, C = 1": (backend("cpu"), one)}
            times: dict[str, list[float]] = {run: [] for run in runs}
            for _ in range(rounds + 1):
                for run, (renderer, scene) in runs.items():
                    repeats = 5 if run.startswith("heatsplat") else 1  # short runs are disturbed as a whole
                    times[run].append(min(seconds_of(renderer, *scene) for _ in range(repeats)))
            best = {run: 1e3 * min(values[1:]) for run, values in times.items()}
            for peer in peers:
                slow = best[f"{peer}, C = 3"]
                rows.append(
                    {
                        "scene": name,
                        "Gaussians": len(three[0]["means"]),
                        "image": "{width}x{height}".format(**three[0]["camera"]),
                        "threads": count,
                        "peer": peer,
                        "peer_ms": slow,
                        "ms": best["heatsplat, C = 3"],
                        "ratio": slow / best["heatsplat, C = 3"],
                        "ms_one_channel": best["heatsplat, C = 1"],
                        "load": os.getloadavg()[0],
                    }
                )
    return rows


def seconds_of(renderer: Renderer, scene: Mapping[str, Any], weights: Tensor) -> float:
    """Seconds of drawing a scene and of the gradient of the weighted sum of its pixels."""
    leaves = {name: scene[name].clone().requires_grad_() for name in LEAVES}
    start = time.perf_counter()
    (renderer(**leaves, **scene["camera"]) * weights).sum().backward()
    return time.perf_counter() - start


def agreement(drawn: Drawn, peers: Mapping[str, Renderer]) -> list[Row]:
    """How far images (largest difference) and gradients (relative L2) of each renderer are from the float64 oracle."""
    exact = _gradients(backend("reference"), drawn, torch.float64)
    rows = []
    for name, renderer in {**peers, "heatsplat": backend("cpu")}.items():
        found = _gradients(renderer, drawn, torch.float32)
        row = {"renderer": name, "image": (found["image"] - exact["image"]).abs().max().item()}
        rows.append(row | {n: ((found[n] - exact[n]).norm() / exact[n].norm()).item() for n in LEAVES})
    return rows


def _gradients(renderer: Renderer, drawn: Drawn, dtype: torch.dtype) -> dict[str, Tensor]:
    scene, weights = drawn
    leaves = {name: scene[name].to(dtype, copy=True).requires_grad_() for name in LEAVES}
    image = renderer(**leaves, **scene["camera"])
    (image * weights.to(dtype)).sum().backward()
    return {"image": image.detach().double()} | {name: leaf.grad.double() for name, leaf in leaves.items()}


def made_up(case: Sequence[int]) -> Callable[[int], Drawn]:
    """The made-up scene [N, width, height] of the renderer study, with so many channels."""
    return lambda channels: build(Case(*case, channels=channels))
