"""How many pixels of held-out images lie within the intervals that a trained scene gives of them."""

from __future__ import annotations

import pytorch_lightning as pl
import torch

from heatsplat.uncertainty import Uncertainty


class Coverage(pl.Callback):
    """Adds to the scores of a test how often the interval of one standard deviation is right, and how wide it is.

    Images are those of ``SceneData.val``, each judged by the calibration on the others.
    """

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        results = module.results
        with torch.inference_mode(False), torch.no_grad():  # a test allows no gradient, of which uncertainty is made
            told = Uncertainty(module)
            results.put("test", "coverage_68", told.coverage())
        results.definitions["coverage_68"] = (
            "0.68 is right: share of pixels of held-out images within one standard deviation of what is rendered, the "
            "camera's noise included; each image by the calibration on the others"
        )
        known = module.scene.range_of(module.modality) is not None
        results.put("test", "deviation_c", told.usual if known else None, "the scene has no temperature bounds")
        results.definitions["deviation_c"] = "°C: median standard deviation of the pixels of held-out images"
