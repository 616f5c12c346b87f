"""Where callbacks write: the TensorBoard of a run."""

from __future__ import annotations

import pytorch_lightning as pl
from torch.utils.tensorboard import SummaryWriter


def board(module: pl.LightningModule) -> SummaryWriter | None:
    """The TensorBoard writer of the run, or None where it has no logger."""
    return None if module.logger is None else module.logger.experiment
