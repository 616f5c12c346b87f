"""The page viewer.html in the folder of a run."""

from __future__ import annotations

import logging

import pytorch_lightning as pl

from heatsplat.contracts import check_count
from heatsplat.io.files import size_told
from heatsplat.viewer.page import CAMERAS, FILE, write_viewer

log = logging.getLogger("heatsplat")


class ViewerPage(pl.Callback):
    """Writes viewer.html at the end of the test: the trained scene in one file, to look at in a browser, offline.

    Of methods without Gaussians that stay as they are (``ThermalModel.stays_here``) it says that there is none.

    Args:
        cameras: how many training cameras are in it at most, with small images.

    Raises:
        SceneError: fewer than one camera: said before a run trains.
    """

    def __init__(self, cameras: int = CAMERAS) -> None:
        check_count("callbacks.viewer.cameras", cameras)
        self.cameras = cameras

    def on_test_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if module.thermal.stays_here:
            log.info("no %s: %s", FILE, module.thermal.stays_here)
            return
        path = write_viewer(module, module.output_dir / FILE, self.cameras)
        log.info("%s (%s): open it in a browser", path, size_told(path.stat().st_size))
