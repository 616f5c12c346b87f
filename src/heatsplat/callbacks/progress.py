"""One line that says how far training is."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import pytorch_lightning as pl
from tqdm import tqdm

REFRESH_SECONDS = 0.25  # on a terminal: more often is unreadable and costs time
LOG_SECONDS = 15.0  # in a file, where every refresh is a new line


class Progress(pl.Callback):
    """Shows step, loss, number of Gaussians, steps per second and the time left; scores after each validation.

    Args:
        enabled: False shows nothing.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._bar: tqdm | None = None
        self._next = 0.0

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not self.enabled:
            return
        self._bar = tqdm(
            total=module.schedule.end,
            initial=trainer.global_step,
            desc=module.scene.name,
            unit="step",
            dynamic_ncols=True,
            mininterval=0,  # this callback says when to draw
            file=sys.stderr,
            bar_format="{desc} |{bar:24}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]",
        )
        self._period = REFRESH_SECONDS if sys.stderr.isatty() else LOG_SECONDS
        self._next = time.monotonic() + self._period

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: dict[str, Any], *_: Any
    ) -> None:
        if self._bar is None:
            return
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + self._period
        self._bar.set_postfix_str(f"loss {outputs['loss'].item():.4f}, {len(module.splats):,} Gaussians", refresh=False)
        self._draw(trainer.global_step, module)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._bar is None or trainer.sanity_checking:
            return
        words = [f"step {trainer.global_step}:", *scores_told(trainer.callback_metrics)]
        seconds = module.results.cost.get("train_seconds")
        if seconds is not None:
            words.append(f"after {seconds:.{0 if seconds >= 10 else 1}f} s")
        self._draw(trainer.global_step, module)  # what stands below the scores must not be older than they are
        self._bar.write("  ".join(words), file=sys.stderr)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._bar is not None:
            self._draw(trainer.global_step, module)
        self._close()

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        self._close()

    def _draw(self, step: int, module: pl.LightningModule) -> None:
        self._bar.total = module.schedule.end  # which may have moved
        self._bar.update(step - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def scores_told(metrics: Mapping[str, Any]) -> list[str]:
    """Scores of a validation in words, such as "PSNR 27.31 dB", of those of Lightning's ``callback_metrics`` that are known."""
    found = {key.removeprefix("val/"): float(value) for key, value in metrics.items() if "val/" in key}
    known = (("psnr", "PSNR {:.2f} dB"), ("ssim", "SSIM {:.4f}"), ("mae_c", "MAE {:.3g} °C"))
    return [text.format(found[name]) for name, text in known if name in found]
