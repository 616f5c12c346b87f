"""Trains a light network of super-resolution on thermal images of other scenes, for ``teacher=PATH`` of a run."""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

from heatsplat.contracts import SceneError, check_count, check_numbers
from heatsplat.geometry.resampling import resampled
from heatsplat.io.command_lines import setting, typed
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import Panel, colorize, compose, write_png
from heatsplat.io.tables import markdown_table
from heatsplat.losses.swinir import SwinIR
from heatsplat.metrics.psnr import psnr
from heatsplat.studies.options import non_empty
from heatsplat.training.rng import generator_for

log = logging.getLogger("heatsplat")

INTERPOLATIONS = ("bicubic", "lanczos")
CROP = 4  # pixels of the fine image at each border that do not count, as in papers of super-resolution


def run(
    output_dir: Path | str,
    data: Callable[..., Any],
    scenes: Sequence[str],
    held_out: Sequence[str],
    factor: int,
    steps: int,
    batch: int,
    patch: int,
    rate: float,
    network: dict[str, Any],
    seed: int,
) -> Path:
    """The file of the network, teacher_x<factor>.pth: the state dictionary of a SwinIR, as published ones are.

    Writes teacher.md and teacher.png beside it: what it makes of scenes that it was not trained on, beside interpolations.
    Images are made small as data.degrade=lr<factor> makes them, and images of all scenes count alike.

    Args:
        output_dir: folder of the results.
        data: gives the data of a scene by ``data(scene=name)``, such as a partial of a data module.
        scenes, held_out: names of those to train on, and of those that only tell how good it is.
        factor: of super-resolution.
        steps, batch, patch: of training: steps, images a step, and the side in coarse pixels of what is cut out of each.
        rate: of Adam at the start; it falls to 0 as half a cosine.
        network: options of SwinIR.
        seed: of the network's start and of what is cut out.

    Raises:
        SceneError: a list has no scene, a scene is in both, its images are smaller than a patch, a number counts nothing, or
            the network cannot be.
    """
    output_dir = Path(output_dir)
    scenes, held_out = non_empty("study.scenes", scenes), non_empty("study.held_out", held_out)
    for key, value in {"factor": factor, "steps": steps, "batch": batch, "patch": patch}.items():
        check_count(f"study.{key}", value)
    check_numbers("study.rate", rate, error=SceneError, above=0)
    check_network(network)
    if both := sorted(set(scenes) & set(held_out)):
        raise SceneError(f"study.held_out names scenes that the network learns from: {', '.join(both)}")
    log.info("rendering %d scenes", len(scenes) + len(held_out))
    fine = torch.cat([images_of(data(scene=name), factor) for name in tqdm(scenes, desc="scenes")])
    shown = torch.cat([images_of(data(scene=name), factor) for name in tqdm(held_out, desc="held out")])
    if min(fine.shape[2:]) < factor * patch:
        raise SceneError(
            f"images of {fine.shape[3]} x {fine.shape[2]} pixels are smaller than a patch of {factor * patch} fine ones: "
            "lower study.patch, or render larger images"
        )
    coarse = made_small(fine, factor)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = SwinIR(scale=factor, **network)
    began = time.perf_counter()
    train(model, fine, coarse, steps, batch, patch, rate, seed)
    minutes = (time.perf_counter() - began) / 60.0
    file = output_dir / f"teacher_x{factor}.pth"
    stored = io.BytesIO()
    torch.save(model.state_dict(), stored)
    write_atomically(file, stored.getvalue())

    scores, guesses = measured(model, shown, factor)
    best = max(INTERPOLATIONS, key=scores.__getitem__)
    rows = [(name, f"{score:.2f}") for name, score in scores.items()]
    write_atomically(
        output_dir / "teacher.md",
        "\n".join(
            [
                f"# A teacher of super-resolution, factor {factor}",
                "",
                f"{len(fine)} images of {len(scenes)} scenes, {steps} steps in {minutes:.1f} min; {len(shown)} images of "
                f"{', '.join(held_out)}, which it was not trained on:",
                "",
                *markdown_table(["enlarged by", "PSNR (dB)"], rows),
                "",
                f"Use it: `python src/train.py method=supirgs super_resolution={factor} {typed(setting('teacher', file))}`",
                "",
            ]
        ),
    )
    panels = [Panel(colorize(image.numpy(), 0.0, 1.0), name) for name, image in guesses.items()]
    write_png(output_dir / "teacher.png", compose(panels, f"{held_out[0]}, {factor} times as fine"))
    log.info("teacher: %.2f dB on scenes it has not seen, %s %.2f dB; %s", scores["network"], best, scores[best], file)
    return file


def check_network(network: dict[str, Any]) -> None:
    """Raises SceneError where options of SwinIR do not go together, or count nothing."""
    sizes = {key: network[key] for key in ("dim", "heads", "window") if key in network}
    for key, value in sizes.items():
        check_count(f"study.network.{key}", value)
    for depth in non_empty("study.network.depths", network["depths"]) if "depths" in network else ():
        check_count("study.network.depths", depth)
    dim, heads = sizes.get("dim"), sizes.get("heads")
    if None not in (dim, heads) and dim % heads:
        raise SceneError(
            f"study.network.dim={dim} channels cannot be shared among study.network.heads={heads}: give a multiple of "
            f"{heads}"
        )


def images_of(data: Any, factor: int) -> Tensor:
    """The thermal images of a scene, [F, 1, H, W], cut so that the factor divides their sides."""
    scene = data.scene
    images = torch.stack([view.thermal[..., 0] for part in (scene.train, scene.test) for view in part])
    height, width = (side - side % factor for side in images.shape[1:])
    return images[:, None, :height, :width].float()


def made_small(fine: Tensor, factor: int) -> Tensor:
    """Images [F, 1, H, W] as ``data.degrade=lr<factor>`` makes them, [F, 1, H / factor, W / factor]."""
    height, width = fine.shape[2] // factor, fine.shape[3] // factor
    return torch.stack([resampled(image[0, ..., None], height, width, "bicubic") for image in fine]).permute(0, 3, 1, 2)


def train(
    model: SwinIR, fine: Tensor, coarse: Tensor, steps: int, batch: int, patch: int, rate: float, seed: int
) -> None:
    """Adam on the mean absolute error of patches, turned and mirrored at random."""
    optimiser = torch.optim.Adam(model.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    model.train()
    bar = tqdm(patches(fine, coarse, steps, batch, patch, seed), total=steps, desc="teacher", unit="step")
    for target, image in bar:
        loss = functional.l1_loss(model(image.expand(-1, 3, -1, -1)), target.expand(-1, 3, -1, -1))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
        bar.set_postfix(loss=f"{loss.item():.4f}", refresh=False)
    model.eval()


def patches(
    fine: Tensor, coarse: Tensor, steps: int, batch: int, patch: int, seed: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of patches, fine [batch, 1, f p, f p] and coarse [batch, 1, p, p], each turned and mirrored at random."""
    factor = fine.shape[2] // coarse.shape[2]
    limits = torch.tensor([len(coarse), coarse.shape[2] - patch + 1, coarse.shape[3] - patch + 1, 4, 2])
    for step in range(steps):
        drawn = torch.rand(batch, 5, generator=generator_for(seed, step, "teacher patches"), dtype=torch.float64)
        pairs = []
        for which, top, left, turns, mirrored in (drawn * limits).long().tolist():
            y, x, side = factor * top, factor * left, factor * patch
            cut = fine[which, :, y : y + side, x : x + side], coarse[which, :, top : top + patch, left : left + patch]
            turned = (one.rot90(turns, (1, 2)) for one in cut)
            pairs.append(tuple(one.flip(2) if mirrored else one for one in turned))
        yield tuple(torch.stack(kind) for kind in zip(*pairs, strict=True))


@torch.no_grad()
def measured(model: SwinIR, fine: Tensor, factor: int) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Mean PSNR of images [F, 1, H, W] that are made small and enlarged again, by who enlarges; and the first of each."""
    coarse, guesses = made_small(fine, factor), {}
    for kernel in INTERPOLATIONS:
        guesses[kernel] = torch.stack(
            [resampled(image[0, ..., None], *fine.shape[2:], kernel)[..., 0] for image in coarse]
        )
    guesses["network"] = torch.cat([model(image[None].expand(-1, 3, -1, -1)).mean(1) for image in coarse])
    scores = {name: _mean_psnr(images, fine[:, 0]) for name, images in guesses.items()}
    return scores, {name: images[0] for name, images in guesses.items()} | {"true": fine[0, 0]}


def _mean_psnr(images: Tensor, true: Tensor) -> float:
    """Mean over images [F, H, W], without their borders."""
    inner = slice(CROP, -CROP)
    cut = (stack[:, inner, inner, None].clamp(0.0, 1.0) for stack in (images, true))
    return sum(psnr(*pair) for pair in zip(*cut, strict=True)) / len(true)
