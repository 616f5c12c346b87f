"""Panels that people look at: ground truth, render and error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from torch import Tensor

from heatsplat.callbacks.board import board
from heatsplat.contracts import Frame, SceneData, View, evenly_spread
from heatsplat.io.pictures import comparison_picture, write_png
from heatsplat.metrics import mae_c, psnr


class ImagePanels(pl.Callback):
    """Draws ground truth | render | error in °C of a few views into TensorBoard and as PNG into renders/.

    So too, with "_rgb" and the like after the name, the images that a model explains besides (its companions). The same
    validation views every time (renders/val holds their latest state, TensorBoard all of them), and test views
    at the end (renders/test).

    Args:
        val_views: how many validation views, spread evenly; 0 for none.
        test_views: how many test views, spread evenly; -1 for all, 0 for none.
    """

    def __init__(self, val_views: int = 3, test_views: int = 8) -> None:
        self.val_views, self.test_views = val_views, test_views

    def on_validation_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        count = min(len(module.scene.val), int(trainer.num_val_batches[0]))
        if not trainer.sanity_checking and batch_idx in evenly_spread(count, self.val_views):
            self._draw("val", module, outputs, trainer.global_step)

    def on_test_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        count = min(len(module.scene.test), int(trainer.num_test_batches[0]))
        if batch_idx in evenly_spread(count, count if self.test_views < 0 else self.test_views):
            self._draw("test", module, outputs, trainer.global_step)

    def _draw(self, split: str, module: pl.LightningModule, outputs: dict[str, Any], step: int) -> None:
        view, writer = outputs["view"], board(module)
        for modality, image in ({module.modality: outputs["prediction"]} | outputs.get("companions", {})).items():
            name = file_stem(view.frame) + ("" if modality == module.modality else f"_{modality}")
            picture = panels(view, modality, image, module.scene)
            write_png(module.output_dir / "renders" / split / f"{name}.png", picture)
            if writer is not None:
                writer.add_image(f"{split}/{name}", picture, step, dataformats="HWC")


def panels(view: View, modality: str, prediction: Tensor, scene: SceneData) -> np.ndarray:
    """Ground truth, render and error of one image of a view, with its scores, uint8 RGB."""
    prediction, target = prediction.float().cpu(), view.image(modality).cpu()
    mask = None if view.mask is None else view.mask.cpu()
    thermal_range = scene.thermal_range if modality in ("thermal", "clean") else None
    title = [view.frame.name]
    if view.frame.time_s is not None:
        title.append(f"t = {view.frame.time_s:.4g} s")
    scores = [(psnr(prediction, target, mask), "PSNR {:.2f} dB")]
    if thermal_range is not None and target.shape[-1] == 1:
        scores.append((mae_c(prediction, target, thermal_range, mask), "MAE {:.3g} °C"))
    title += [text.format(value) for value, text in scores if value is not None]
    return comparison_picture(target, prediction, thermal_range, mask, title="   ·   ".join(title))


def file_stem(frame: Frame) -> str:
    """A file name for pictures of a frame, unique in its scene whatever folders the images came from."""
    return f"{frame.frame_id:04d}_{Path(frame.name).stem}"
