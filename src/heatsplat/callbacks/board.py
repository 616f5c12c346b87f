"""Where callbacks write: numbers to the loggers of a run, pictures and tables to TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytorch_lightning as pl
from pytorch_lightning.loggers import TensorBoardLogger
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.compat.tensorflow_stub import pywrap_tensorflow
from torch.utils.tensorboard import SummaryWriter

from heatsplat.kernels.checksum import crc_update

pywrap_tensorflow.crc_update = crc_update  # its own, in Python, takes 0.17 s for a megabyte of pictures


def board(module: pl.LightningModule) -> SummaryWriter | None:
    """The TensorBoard writer of the run, or None where it has none among its loggers."""
    return next((logger.experiment for logger in module.loggers if isinstance(logger, TensorBoardLogger)), None)


def add_scalars(module: pl.LightningModule, values: Mapping[str, float], step: int, by_steps: bool = True) -> None:
    """Hands numbers by tag to the loggers of the run; to TensorBoard alone where ``step`` counts something else than steps, since
    others keep one count for all."""
    for logger in module.loggers:
        if isinstance(logger, TensorBoardLogger):
            for tag, value in values.items():
                logger.experiment.add_scalar(tag, value, step)
        elif values and by_steps:
            logger.log_metrics(dict(values), step)


def add_picture(module: pl.LightningModule, tag: str, picture: np.ndarray, png: bytes, step: int) -> None:
    """Adds a picture [H, W, 3] that was encoded already, where the run has a TensorBoard.

    The writer's ``add_image`` encodes anew, a third of the time of a panel (measured).
    """
    writer = board(module)
    if writer is not None:
        height, width = picture.shape[:2]
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=png)
        writer._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)
