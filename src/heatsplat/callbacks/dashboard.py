"""The layout of TensorBoard's custom scalars: what belongs together is drawn together."""

from __future__ import annotations

import pytorch_lightning as pl

from heatsplat.callbacks.board import board

# Category -> panel -> regular expressions of tags; several runs are drawn into one panel.
LAYOUT = {
    "Quality against seconds of training": {
        "PSNR (dB)": ["Multiline", ["^val_by_seconds/psnr$"]],
        "MAE (°C)": ["Multiline", ["^val_by_seconds/mae_c$"]],
        "SSIM": ["Multiline", ["^val_by_seconds/ssim$"]],
    },
    "Quality against steps": {
        "PSNR (dB), recorded, clean and of companions": ["Multiline", ["^val/(.*_)?psnr$"]],
        "MAE (°C), recorded and clean": ["Multiline", ["^val/(clean_)?mae_c$"]],
    },
    "What is minimised": {
        "all terms": ["Multiline", ["^loss/.*"]],
    },
    "How many Gaussians": {
        "Gaussians": ["Multiline", ["^density/count$"]],
        "added at once": ["Multiline", ["^density/added$"]],
        "removed at once": ["Multiline", ["^density/removed$"]],
    },
    "What it costs": {
        "steps per second": ["Multiline", ["^cost/steps_per_second$"]],
        "memory (MB)": ["Multiline", ["^cost/peak_memory_mb$"]],
    },
    "How fast parameters learn": {
        "learning rates": ["Multiline", ["^learning_rate/.*"]],
    },
}


class Dashboard(pl.Callback):
    """Lays out the tab "custom scalars" of TensorBoard, once per run."""

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        writer = board(module)
        if writer is not None:
            writer.add_custom_scalars(LAYOUT)
