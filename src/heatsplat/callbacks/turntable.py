"""A small moving picture: around the scene, in the middle of its record."""

from __future__ import annotations

from dataclasses import replace

import pytorch_lightning as pl
from PIL import Image

from heatsplat.callbacks.images import scene_bounds
from heatsplat.contracts import check_count
from heatsplat.io.pictures import Bar, bar_unit, compose, image_panel
from heatsplat.io.quantities import clock_of, moment
from heatsplat.shots import shot_frames

TURNTABLE_FILE = "renders/turntable.webp"
QUALITY = 70  # of WebP, of 100


class Turntable(pl.Callback):
    """Writes renders/turntable.webp at the end of the test: an orbit, or a way through the cameras where there is none.

    What no training view has seen is shown as the model makes it; ``src/render.py`` tells it apart.

    Args:
        frames: images of the turn.
        size: pixels of an image's longer side, at most.
        milliseconds: each is shown.
    """

    def __init__(self, frames: int = 24, size: int = 320, milliseconds: int = 120) -> None:
        for name, value in {"frames": frames, "size": size, "milliseconds": milliseconds}.items():
            check_count(f"callbacks.turntable.{name}", value)
        self.frames, self.size, self.milliseconds = frames, size, milliseconds

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        scene, known = module.scene, module.scene.range_of(module.modality)
        shot = {"count": self.frames, "finer": module.supersample}
        try:
            frames = shot_frames(scene, "orbit", **shot)
        except ValueError:  # all cameras on one line of sight
            frames = shot_frames(scene, "path", **shot)
        bar = Bar(*scene_bounds(scene, module.modality), bar_unit(known))
        shown = []
        for frame in frames:
            image = module.predict(replace(frame, camera=frame.camera.within(self.size))).cpu()
            title = "" if frame.time_s is None else moment(frame.time_s, clock_of(scene))
            shown.append(Image.fromarray(compose([image_panel(image, "", bar, known)], title)))
        path = module.output_dir / TURNTABLE_FILE
        path.parent.mkdir(parents=True, exist_ok=True)
        options = {"quality": QUALITY, "method": 2, "duration": self.milliseconds, "loop": 0}
        shown[0].save(path, save_all=True, append_images=shown[1:], **options)
