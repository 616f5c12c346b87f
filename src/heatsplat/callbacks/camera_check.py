"""Whether training images fit the trained scene better from a little beside: then their cameras are off."""

from __future__ import annotations

import logging
import statistics

import pytorch_lightning as pl
import torch

from heatsplat.contracts import Camera, check_count, evenly_spread

log = logging.getLogger("heatsplat")

# Fall of the squared error from which cameras are told to be off. It falls by nothing where they are right, and by a sixth where
# images lag or all cameras are off by the same.
OFF = 0.2


class CameraCheck(pl.Callback):
    """Aligns the cameras of some training images with the trained scene, before the test, and says what came of it.

    ``run.camera_check`` of metrics.json has the medians over these images: "moved_px", by how much what they show moved, and
    "error_falls", the share of the mean squared error that is gone then. Where cameras are right, nothing is: the scene was
    fitted to them. Where it is much, the log recommends ``cameras=refined``. Fields are not checked, nor what was trained finer
    than its images (``supersample``), which single pixels do not fit.

    Args:
        views: how many training images, evenly spread.
        steps: in which each is aligned; 15 go 0.6 pixels.
        least_steps: of training, from which on a scene is good enough to tell.
    """

    def __init__(self, views: int = 6, steps: int = 15, least_steps: int = 1000) -> None:
        check_count("callbacks.camera_check.views", views, 0)
        check_count("callbacks.camera_check.steps", steps)
        check_count("callbacks.camera_check.least_steps", least_steps, 0)
        self.views, self.steps, self.least_steps = views, steps, least_steps

    def on_test_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if len(module.splats) == 0 or module.supersample > 1 or module.schedule.end < self.least_steps:
            return
        falls, moved = [], []
        for number in evenly_spread(len(module.scene.train), self.views):
            view = module.scene.train[number].to(module.device, module.dtype)
            if not view.counts:  # it fits from anywhere
                continue
            with torch.no_grad():
                given = module.cameras.of(view.frame)
            found = module.aligned(view, given, self.steps)
            with torch.no_grad():
                before, after = (float(module.squared_error(view, camera)) for camera in (given, found))
            falls.append(1 - after / before if before > 0 else 0.0)
            moved.append(_moved_px(given, found, module.scene.points))
        if not falls:
            return
        fall, pixels = statistics.median(falls), statistics.median(moved)
        module.results.run["camera_check"] = {"images": len(falls), "moved_px": pixels, "error_falls": fall}
        if fall > OFF and not module.cameras.learns:
            log.warning(
                "Training cameras look off: moved by %.2g pixels, they take %.0f %% from the squared errors of training images. "
                "Try cameras=refined, which learns where they stood (docs/your_own_data.md); images that are late look alike.",
                pixels, 100 * fall,
            )  # fmt: skip


def _moved_px(camera: Camera, other: Camera, points: torch.Tensor) -> float:
    """By how many pixels of a camera another sees the scene's points beside, in the median of those in its image; 0 of none."""
    (pixels, depths), (beside, _) = camera.project(points.double()), other.project(points.double())
    apart = (beside - pixels)[camera.inside(pixels, depths)].norm(dim=1)
    return float(apart.median()) if len(apart) else 0.0
