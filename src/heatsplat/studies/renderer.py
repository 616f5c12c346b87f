"""How fast the CPU renderer is: against its peers in paired ratios, and against the floor of this processor.

Rules: one process, rounds interleaved between renderers, minima reported; forward and backward of one view with random
weights on the image; compile time excluded. A ratio compares two times of the same run.
"""

from __future__ import annotations

import csv
import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import torch
from torch import Tensor

from heatsplat.geometry.projection import project_gaussians
from heatsplat.kernels.peak import vector_rate
from heatsplat.kernels.scheduling import use_threads
from heatsplat.renderers.base import ALPHA_MAX, ALPHA_MIN, BLUR, FOV_MARGIN, rasterization

log = logging.getLogger("heatsplat")

# Vector instructions per block of sixteen pixels, counted in the loops of kernels/compositing.py for C = M = 1.
FORWARD_INSTRUCTIONS, BACKWARD_INSTRUCTIONS = 29, 46
NUMBERS_PER_GAUSSIAN = 11  # mean, quaternion, scales, opacity; read forward, and their gradients written backward

Renderer = Callable[..., Tensor]


@dataclass(frozen=True)
class Case:
    """One measured configuration: N Gaussians, image size, C channels, M modalities, threads, and whose points."""

    gaussians: int = 100_000
    width: int = 512
    height: int = 410
    channels: int = 1
    modalities: int = 1
    threads: int = 2
    points: str = "synthetic"

    @property
    def name(self) -> str:
        what = f"C={self.channels} M={self.modalities} {self.threads} thread(s)"
        if self.points != "synthetic":
            return f"{Path(self.points).stem} {what}"
        return f"N={self.gaussians} {self.width}x{self.height} {what}"


def run(
    output_dir: Path | str,
    counts: Sequence[int] = (10_000, 30_000, 100_000, 300_000),
    sizes: Sequence[Sequence[int]] = ((160, 128), (256, 205), (512, 410), (720, 480)),
    channels: Sequence[int] = (1, 3, 4),
    modalities: Sequence[int] = (1, 2),
    threads: Sequence[int] = (1, 2),
    rounds: int = 5,
    torch_tiles: Sequence[Sequence[int]] = ((10_000, 160, 128), (10_000, 512, 410)),
    peers: dict[str, str] | None = None,
    garden: str | None = None,
) -> list[dict[str, Any]]:
    """Rows of the table, which is also written to renderer.csv, renderer.md and renderer.png in ``output_dir``.

    Args:
        output_dir: folder of the results.
        counts, sizes, channels, modalities, threads: what is varied: N over all sizes, then C, M and threads at 100,000
            Gaussians (or the nearest of ``counts``) and 512x410 (or the middle of ``sizes``).
        rounds: interleaved repetitions; the minimum counts.
        torch_tiles: (N, width, height) at which the pure-torch tile renderer runs beside, with C = 3; it takes seconds.
        peers: name -> "module:function" of further renderers with the arguments of ``rasterization`` up to the height,
            returning the image, such as a binding to a built peer; they run where torch_tiles does. gsplat joins by
            itself where there is a GPU.
        garden: file of real points (npz with means3d, viewmats, Ks, width, height), or None.
    """
    output_dir = Path(output_dir)
    output_dir.mkdir(parents=True, exist_ok=True)
    most = max(threads)
    count = min(counts, key=lambda n: abs(n - 100_000))
    width, height = min(sizes, key=lambda size: abs(size[0] - 512))
    middle = Case(count, width, height, threads=most)
    cases = [Case(n, w, h, threads=most) for w, h in sizes for n in counts]
    cases += [replace(middle, channels=c) for c in channels if c != 1]
    cases += [replace(middle, channels=2, modalities=m) for m in modalities if m != 1]
    cases += [replace(middle, channels=2)] if max(modalities) > 1 else []
    cases += [replace(middle, threads=t) for t in threads if t != most]
    if garden is not None:
        cases.append(Case(points=str(garden), threads=most))
    rates = {t: vector_rate(t) for t in threads}
    rows = [_row(case, {"cpu": _backend("cpu")}, rounds, rates) for case in cases]
    others = {"torch tiles": render_torch_tiles} | {name: _load(path) for name, path in (peers or {}).items()}
    if torch.cuda.is_available():
        others["gsplat"] = _backend("gsplat")
    for n, w, h in torch_tiles:
        case = Case(n, w, h, channels=3, threads=most)
        rows.append(_row(case, {"cpu": _backend("cpu")} | others, max(2, rounds // 2), rates))
    _write(rows, output_dir, rates)
    return rows


def _row(case: Case, renderers: dict[str, Renderer], rounds: int, rates: dict[int, float]) -> dict[str, Any]:
    """Times of one case in milliseconds, the floor, and the ratios to the first renderer."""
    use_threads(case.threads)
    torch.set_num_threads(case.threads)
    scene, weights = build(case)
    times = {name: [] for name in renderers}
    blocks = 0
    for step in range(rounds + 1):
        for name, renderer in renderers.items():
            leaves = {key: scene[key].clone().requires_grad_() for key in ("means", "quats", "scales", "opacities")}
            features = scene["features"].clone().requires_grad_()
            start = time.perf_counter()
            image = renderer(**leaves, features=features, **scene["camera"])
            middle = time.perf_counter()
            (image * weights.to(image.device)).sum().backward()
            if name == "cpu" and step == 0:
                blocks = _evaluated_blocks(image)
            if step > 0:  # the first round compiles
                times[name].append((middle - start, time.perf_counter() - middle))
    own = np.array(times["cpu"]) * 1e3
    forward, backward = own.min(0)
    floor = blocks * np.array([FORWARD_INSTRUCTIONS, BACKWARD_INSTRUCTIONS]) / rates[case.threads] * 1e3
    row = {
        "case": case.name,
        "gaussians": len(scene["means"]),
        "pixels": scene["camera"]["width"] * scene["camera"]["height"],
        "channels": case.channels,
        "modalities": case.modalities,
        "threads": case.threads,
        "forward_ms": forward,
        "backward_ms": backward,
        "floor_forward_ms": floor[0],
        "floor_backward_ms": floor[1],
        "share_of_floor_forward": floor[0] / forward,
        "share_of_floor_backward": floor[1] / backward,
        "megabytes": 8e-6 * len(scene["means"]) * (NUMBERS_PER_GAUSSIAN + case.channels),
        "load": os.getloadavg()[0],
    }
    for name in renderers:
        if name != "cpu":
            row[f"{name} / cpu"] = float(np.median([sum(t) for t in times[name]]) / np.median(own.sum(1)) * 1e3)
    log.info("%s: forward %.1f ms, backward %.1f ms", case.name, forward, backward)
    return row


def _evaluated_blocks(image: Tensor) -> int:
    """Blocks of sixteen pixels that a rendering evaluated, after saturation."""
    node = image.grad_fn
    while node is not None and not hasattr(node, "frame"):
        node = node.next_functions[0][0] if node.next_functions else None
    frame = node.frame
    begins, ends = frame.tile_starts[:-1], frame.tile_ends
    steps = np.zeros(frame.tile_starts[-1] + 1, np.int64)  # +1 where a tile begins, -1 behind the last it looked at
    np.add.at(steps, begins, 1)
    np.add.at(steps, ends, -1)
    masks = frame.instances[: frame.tile_starts[-1], 1][steps[:-1].cumsum() > 0]
    return int(np.unpackbits(masks.view(np.uint8)).sum())


def _backend(backend: str) -> Renderer:
    def render(means, quats, scales, opacities, features, viewmats, Ks, width, height) -> Tensor:
        tensors = [means, quats, scales, opacities, features]
        if backend == "gsplat":
            tensors = [tensor.cuda() for tensor in tensors]
        split = None if opacities.ndim == 1 else (1,) * len(opacities)
        return rasterization(
            *tensors, viewmats, Ks, width, height, modality_channels=split, backend=backend, depth=False
        ).features  # fmt: skip

    return render


def _load(path: str) -> Renderer:
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def build(case: Case) -> tuple[dict[str, Any], Tensor]:
    """Gaussians whose footprint shrinks as their number grows, or the garden's points; and random weights [H, W, C]."""
    generator = torch.Generator().manual_seed(0)
    if case.points == "synthetic":
        focal, count = 0.9 * case.width, case.gaussians
        size = torch.tensor([case.width, case.height]) / focal
        depths = 3 + 4 * torch.rand(count, 1, generator=generator)
        means = torch.cat([(torch.rand(count, 2, generator=generator) - 0.5) * 1.15 * size * depths, depths], 1)
        footprint = 2.7 * (case.width * case.height / (512 * 410) * 100_000 / count) ** 0.5  # pixels
        scales = torch.exp(0.6 * torch.randn(count, 3, generator=generator) - 0.25) * footprint * 5 / focal
        viewmat, width, height = torch.eye(4), case.width, case.height
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    else:
        file = np.load(case.points)
        means = torch.from_numpy(file["means3d"]).float()
        viewmat, K = torch.from_numpy(file["viewmats"][0]).float(), torch.from_numpy(file["Ks"][0]).float()
        width, height, count = int(file["width"]), int(file["height"]), len(means)
        scales = torch.exp(0.5 * torch.randn(count, 3, generator=generator)) * 0.02
    split = case.modalities > 1
    opacities = torch.sigmoid(1.5 * torch.randn(case.modalities, count, generator=generator) + 0.35)
    scene = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": scales,
        "opacities": opacities if split else opacities[0],
        "features": torch.rand(count, case.channels, generator=generator),
        "camera": {"viewmats": viewmat, "Ks": K, "width": width, "height": height},
    }
    return scene, torch.randn(height, width, case.channels, generator=generator)


def render_torch_tiles(means, quats, scales, opacities, features, viewmats, Ks, width, height, tile=16) -> Tensor:
    """The image [H, W, C] by plain torch, tile by tile, as a careful user would write it; the peer without kernels."""
    screen = project_gaussians(means, quats, scales, viewmats, Ks, width, height, BLUR, FOV_MARGIN)
    with torch.no_grad():
        order = screen.depths.argsort(stable=True)
        reach = (2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN)).sqrt()[:, None] * screen.variances.sqrt()
        low, high = screen.means - reach, screen.means + reach
    rows = []
    for top in range(0, height, tile):
        row = []
        for left in range(0, width, tile):
            bottom, right = min(top + tile, height), min(left + tile, width)
            inside = (low[:, 0] < right) & (high[:, 0] > left) & (low[:, 1] < bottom) & (high[:, 1] > top)
            ids = order[inside[order] & (screen.depths[order] > 0.01)]
            y, x = torch.meshgrid(torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij")
            dx = x.reshape(-1, 1) - screen.means[ids, 0]
            dy = y.reshape(-1, 1) - screen.means[ids, 1]
            p, q, r = screen.whitening[ids].T
            power = -0.5 * ((p * (dx - q * dy)) ** 2 + (r * dy) ** 2)
            alpha = (opacities[ids] * power.exp()).clamp(max=ALPHA_MAX)
            alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
            left_over = torch.cumprod(1 - alpha, dim=1)
            weights = alpha * torch.cat([torch.ones_like(left_over[:, :1]), left_over[:, :-1]], dim=1)
            row.append((weights @ features[ids]).reshape(bottom - top, right - left, -1))
        rows.append(torch.cat(row, dim=1))
    return torch.cat(rows, dim=0)


def _write(rows: list[dict[str, Any]], output_dir: Path, rates: dict[int, float]) -> None:
    """The table as CSV and Markdown, and time against N, pixels and channels as a picture."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with open(output_dir / "renderer.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    peers = [column for column in columns if column.endswith(" / cpu")]
    lines = [
        "# The CPU renderer",
        "",
        "Floor: the vector instructions of the evaluated pixel blocks at the measured rate of multiply-adds ("
        + ", ".join(f"{t} threads: {rate / 1e9:.1f} G/s" for t, rate in rates.items())
        + " on 16 lanes). Minima over interleaved rounds.",
        "",
        "| case | forward ms | of floor | backward ms | of floor | load | " + " | ".join(peers) + " |",
        "|---" * (6 + len(peers)) + "|",
    ]
    for row in rows:
        ratios = [f"{row[peer]:.0f}x" if peer in row else "" for peer in peers]
        lines.append(
            f"| {row['case']} | {row['forward_ms']:.2f} | {row['share_of_floor_forward']:.0%} "
            f"| {row['backward_ms']:.2f} | {row['share_of_floor_backward']:.0%} "
            f"| {row['load']:.1f} | " + " | ".join(ratios) + " |"
        )
    text = "\n".join(lines) + "\n"
    (output_dir / "renderer.md").write_text(text, encoding="utf-8")
    log.info("%s", text)
    figure = matplotlib.figure.Figure(figsize=(13, 4), layout="constrained")
    for axis, key in zip(figure.subplots(1, 3), ("gaussians", "pixels", "channels"), strict=True):
        fixed = [other for other in ("gaussians", "pixels", "channels", "modalities", "threads") if other != key]
        groups: dict[tuple, list] = {}
        for row in rows:
            groups.setdefault(tuple(row[name] for name in fixed), []).append(row)
        for values, group in groups.items():
            group = sorted({row[key]: row for row in group}.values(), key=lambda row: row[key])
            if len(group) > 1:
                label = ", ".join(f"{name} {value}" for name, value in zip(fixed[:2], values[:2], strict=True))
                total = [row["forward_ms"] + row["backward_ms"] for row in group]
                axis.loglog([row[key] for row in group], total, "o-", label=label)
        axis.set_xlabel(key)
        axis.set_ylabel("forward + backward (ms)")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(output_dir / "renderer.png", dpi=120)
