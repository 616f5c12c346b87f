"""Panels that people look at: ground truth or what was recorded, render and error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from torch import Tensor

from heatsplat.callbacks.board import add_picture
from heatsplat.contracts import Frame, SceneData, SceneError, View, check_count, check_option, evenly_spread
from heatsplat.io.files import LONGEST_STEM, short_name
from heatsplat.io.pictures import (
    Panel,
    bounds_of,
    comparison_panels,
    compose,
    difference,
    error_limit_of,
    write_figure,
    write_png,
)
from heatsplat.io.quantities import clock_of, moment
from heatsplat.metrics.mae import mae_c
from heatsplat.metrics.psnr import psnr

RANGE_VIEWS = 12  # training views over which the ends of the colours are taken
RANGE_PIXELS = 20_000  # of each of them, at most, and of each test view for the ends of the errors
KEPT = 12  # test views that wait in memory for the errors of all; what is beyond is rendered again


class ImagePanels(pl.Callback):
    """Draws ground truth | render | error in °C of a few views into TensorBoard and as PNG into renders/.

    In place of the ground truth, of which a real scene has none, stands what was recorded.

    So too, with "_rgb" and the like after the name, the images that a model explains besides (its companions). The same
    validation views every time (renders/val holds their latest state, TensorBoard all of them), and test views
    at the end (renders/test). Colours have the same ends in all panels, those of the training images; test panels share
    the ends of the error, too.

    Args:
        val_views: how many validation views, spread evenly; 0 for none.
        test_views: how many test views, spread evenly; -1 for all, 0 for none.
        figures: "pdf" or "svg" writes test panels for print, too; None does not.
    """

    def __init__(self, val_views: int = 3, test_views: int = 8, figures: str | None = None) -> None:
        check_option("callbacks.images.figures", figures, (None, "pdf", "svg"), SceneError)
        check_count("callbacks.images.val_views", val_views, 0)
        check_count("callbacks.images.test_views", test_views, -1)
        self.val_views, self.test_views, self.figures = val_views, test_views, figures
        self._bounds: tuple[float, float] | None = None
        self._chosen: list[int] = []
        self._kept: dict[int, dict[str, Any]] = {}
        self._errors: dict[str, list[np.ndarray]] = {}

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
            self._chosen.append(batch_idx)
            for modality, image in _images(module, outputs).items():
                found = magnitudes(outputs["view"], modality, image, module.scene)
                self._errors.setdefault(modality, []).append(found[:: max(1, len(found) // RANGE_PIXELS)].copy())
            if len(self._kept) < KEPT:
                self._kept[batch_idx] = outputs

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Draws the views, now that the errors of all are known."""
        limits = {modality: error_limit_of(np.concatenate(found)) for modality, found in self._errors.items()}
        for i in self._chosen:
            outputs = self._kept.pop(i, None)
            if outputs is None:
                outputs = module.test_step(module.transfer_batch_to_device(module.scene.test[i], module.device, 0), i)
            self._draw("test", module, outputs, trainer.global_step, limits)
        self._chosen, self._errors = [], {}

    def _draw(
        self,
        split: str,
        module: pl.LightningModule,
        outputs: dict[str, Any],
        step: int,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        view = outputs["view"]
        self._bounds = self._bounds or scene_bounds(module.scene, module.modality)
        for modality, image in _images(module, outputs).items():
            name = file_stem(view.frame) + ("" if modality == module.modality else f"_{modality}")
            shown, title = panels(view, modality, image, module.scene, self._bounds, (limits or {}).get(modality))
            path = module.output_dir / "renders" / split / f"{name}.png"
            picture = compose(shown, title)
            png = write_png(path, picture)
            if self.figures is not None and split == "test":
                write_figure(path.with_suffix(f".{self.figures}"), shown, title)
            add_picture(module, f"{split}/{name}", picture, png, step)


def _images(module: pl.LightningModule, outputs: Mapping[str, Any]) -> dict[str, Tensor]:
    """The images of a step's outputs by modality."""
    return {module.modality: outputs["prediction"]} | outputs.get("companions", {})


def scene_bounds(scene: SceneData, modality: str) -> tuple[float, float]:
    """Ends of the colours of all images of a scene, in °C or image values: those of some training images."""
    known = scene.range_of(modality)
    values = []
    for i in evenly_spread(len(scene.train), RANGE_VIEWS):
        view = scene.train[i]
        image = view.image(modality).float().mean(-1).cpu()
        pixels = (image if view.mask is None else image[view.mask.cpu()]).flatten()
        pixels = pixels[pixels.isfinite()]
        values.append(pixels[:: max(1, len(pixels) // RANGE_PIXELS)].numpy())
    pixels = np.concatenate(values)
    ends = bounds_of(pixels) if pixels.size else (0.0, 1.0)
    return ends if known is None else tuple(float(known.to_celsius(end)) for end in ends)


def panels(
    view: View,
    modality: str,
    prediction: Tensor,
    scene: SceneData,
    bounds: tuple[float, float] | None = None,
    error_limit: float | None = None,
) -> tuple[list[Panel], str]:
    """Ground truth or what was recorded, render and error of one image of a view, and a title with its scores.

    The image of a real camera has its drift and blur, and nobody knows what it would have recorded without them: a render that
    leaves them out has no scores against it.
    """
    prediction, target = prediction.float().cpu(), view.image(modality).cpu()
    mask = None if view.mask is None else view.mask.cpu()
    thermal_range = scene.range_of(modality)
    clean = modality == "clean"
    true = view.clean is not None if clean else scene.truth is not None
    title = [view.frame.name]
    if clean and not true:
        title.append("clean: without what the camera adds, which is in the difference")
    elif modality != "thermal":
        title.append(modality)
    if view.frame.time_s is not None:
        title.append(f"t = {moment(view.frame.time_s, clock_of(scene))}")
    if true or not clean:
        scores = [(psnr(prediction, target, mask), "PSNR {:.2f} dB")]
        if thermal_range is not None and target.shape[-1] == 1:
            scores.append((mae_c(prediction, target, thermal_range, mask), "MAE {:.3g} °C"))
        title += [text.format(value) for value, text in scores if value is not None]
    against = "ground truth" if true else "recorded"
    return comparison_panels(target, prediction, thermal_range, mask, bounds, error_limit, against), "   ·   ".join(
        title
    )


def magnitudes(view: View, modality: str, prediction: Tensor, scene: SceneData) -> np.ndarray:
    """Magnitudes [n] of the errors of an image where it counts, in °C or image values."""
    target = view.image(modality).cpu()
    mask = None if view.mask is None else view.mask.cpu()
    counted, error = difference(target, prediction.float().cpu(), scene.range_of(modality), mask)
    return np.abs(error[counted])


def file_stem(frame: Frame) -> str:
    """A file name for pictures of a frame, unique in its scene whatever folders the images came from."""
    return f"{frame.frame_id:04d}_{short_name(Path(frame.name).stem, LONGEST_STEM)}"
