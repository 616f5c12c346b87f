"""Where training images were taken from, as a run found it, for other programs."""

from __future__ import annotations

import json

import pytorch_lightning as pl

from heatsplat.geometry.transforms import camera_entry
from heatsplat.io.files import write_atomically

CAMERAS_FILE = "transforms.json"


class LearnedCameras(pl.Callback):
    """Writes transforms.json at the end of a run that learned cameras (``cameras=refined``); other runs have none.

    **Convention:** nerfstudio's (``camera_entry``), in the coordinates of the data set. Images are the training images as they
    were trained on: undistorted, of that size, by the names that they have in the data set. ``time_s`` counts from the first.
    """

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not module.cameras.learns:
            return
        origin = module.scene.notes.get("origin", (0.0, 0.0, 0.0))
        frames = []
        for frame in module.scene.train.frames:
            entry = {"file_path": frame.name} | ({} if frame.time_s is None else {"time_s": frame.time_s})
            frames.append(entry | camera_entry(module.cameras.of(frame), origin))
        text = json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1)
        write_atomically(module.output_dir / CAMERAS_FILE, text)
