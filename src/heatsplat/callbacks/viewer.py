"""The page viewer.html in the folder of a run."""

from __future__ import annotations

import pytorch_lightning as pl

from heatsplat.viewer.page import FILE, write_viewer


class ViewerPage(pl.Callback):
    """Writes viewer.html at the end of the test: the trained scene in one file, to look at in a browser, offline."""

    def on_test_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        write_viewer(module, module.output_dir / FILE)
