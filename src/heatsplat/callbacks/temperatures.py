"""The test views as a protocol wants them handed in: one float32 TIFF in °C each."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl

from heatsplat.io.tiff import write_temperature
from heatsplat.shots import file_stems


class TemperatureRenders(pl.Callback):
    """Writes every test view's render, in °C, to ``folder``/<name of the view>.tiff; nothing without a thermal range.

    Names have the folders of their images where test views of several folders are called alike (``shots.file_stems``).

    Args:
        folder: in the run's folder.
        image: "thermal" for what the camera would record, "clean" for what one without flaws would, of methods that tell it.
    """

    def __init__(self, folder: str = "submission", image: str = "thermal") -> None:
        self.folder, self.image = folder, image
        self._named: tuple[Any, dict[str, str]] = (None, {})  # test frames, and what their files are called

    def on_test_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, *_: Any) -> None:
        bounds = module.scene.range_of(module.modality)
        if bounds is None:
            return
        image = outputs["companions"].get(self.image, outputs["prediction"])
        frames = module.scene.test.frames
        if self._named[0] is not frames:
            self._named = frames, file_stems([frame.name for frame in frames])
        stem = self._named[1][outputs["view"].frame.name]
        write_temperature(module.output_dir / self.folder / f"{stem}.tiff", bounds.to_celsius(image.cpu()))
