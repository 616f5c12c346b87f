"""What the renderer study renders: made-up Gaussians that cover the image alike at any number, or real points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor


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
        where = f"{self.gaussians:,} at {self.width}x{self.height}"
        if self.points != "synthetic":
            where = Path(self.points).stem
        return f"{where}, C={self.channels}" + (f" M={self.modalities}" if self.modalities > 1 else "")


def build(case: Case) -> tuple[dict[str, Any], Tensor]:
    """The arguments of ``rasterization`` up to the height, cameras under "camera"; and random weights [H, W, C].

    Made-up Gaussians shrink as their number grows, so that about a hundred of them meet in every pixel.
    """
    generator = torch.Generator().manual_seed(0)
    means, scales, camera = (_made_up if case.points == "synthetic" else _from_file)(case, generator)
    count = len(means)
    opacities = torch.sigmoid(1.5 * torch.randn(case.modalities, count, generator=generator) + 0.35)
    scene = {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": scales,
        "opacities": opacities if case.modalities > 1 else opacities[0],
        "features": torch.rand(count, case.channels, generator=generator),
        "camera": camera,
    }
    return scene, torch.randn(camera["height"], camera["width"], case.channels, generator=generator)


def _made_up(case: Case, generator: torch.Generator) -> tuple[Tensor, Tensor, dict[str, Any]]:
    focal, count = 0.9 * case.width, case.gaussians
    size = torch.tensor([case.width, case.height]) / focal
    depths = 3 + 4 * torch.rand(count, 1, generator=generator)
    means = torch.cat([(torch.rand(count, 2, generator=generator) - 0.5) * 1.15 * size * depths, depths], 1)
    footprint = 2.7 * (case.width * case.height / (512 * 410) * 100_000 / count) ** 0.5  # pixels
    scales = torch.exp(0.6 * torch.randn(count, 3, generator=generator) - 0.25) * footprint * 5 / focal
    K = torch.tensor([[focal, 0, case.width / 2], [0, focal, case.height / 2], [0, 0, 1.0]])
    return means, scales, {"viewmats": torch.eye(4), "Ks": K, "width": case.width, "height": case.height}


def _from_file(case: Case, generator: torch.Generator) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Points and the first camera of an npz file with means3d, viewmats, Ks, width and height; sizes are made up."""
    file = np.load(case.points)
    means = torch.from_numpy(file["means3d"]).float()
    scales = torch.exp(0.5 * torch.randn(len(means), 3, generator=generator)) * 0.02
    camera = {
        "viewmats": torch.from_numpy(file["viewmats"][0]).float(),
        "Ks": torch.from_numpy(file["Ks"][0]).float(),
        "width": int(file["width"]),
        "height": int(file["height"]),
    }
    return means, scales, camera
