"""A page on which a scene can be watched while it trains."""

from __future__ import annotations

import logging
import time
from contextlib import nullcontext
from typing import Any

import pytorch_lightning as pl

from heatsplat.callbacks.progress import scores_told
from heatsplat.callbacks.timing import CostMeter
from heatsplat.contracts import SceneError, check_count, check_numbers
from heatsplat.export.snapshot import snapshot
from heatsplat.viewer.live import LiveServer
from heatsplat.viewer.page import page
from heatsplat.viewer.payload import payload

log = logging.getLogger("heatsplat")

MOST_PORT = 65535


class LiveViewer(pl.Callback):
    """Serves viewer.html of the state of training, which the page replaces by newer ones while it is open.

    A state is made between two steps, from all Gaussians, and only while a browser asks for it: training waits meanwhile. It
    draws no random numbers and changes no parameter, so that weights are the same without. Its seconds count as
    ``cost.watching_seconds``, not as those of training (``CostMeter``). The first state is made as soon as somebody looks, the
    last one when training ends and somebody does, unless it was stopped by hand.

    Of methods without Gaussians that stay as they are (``ThermalModel.stays_here``) it says that there is none.

    Args:
        port: at which is listened; 0 takes a free one.
        host: address at which is listened.
        every_s: least seconds between two states.
        share: of the time since the start that states may take, above 0 and at most 1, but for the first and the last one.
        idle_s: seconds after the last request in which the page counts as open. It asks every two.
        cameras: how many training cameras are in the page at most, with small images.
        coarser: how many times as far as in viewer.html temperatures over time may be from the model's.

    Raises:
        SceneError: a setting is out of range; with the start of training, where the port is taken.
    """

    def __init__(
        self,
        port: int = 7007,
        host: str = "127.0.0.1",
        every_s: float = 10.0,
        share: float = 0.05,
        idle_s: float = 30.0,
        cameras: int = 12,
        coarser: float = 4.0,
    ) -> None:
        check_count("callbacks.live.port", port, 0)
        check_count("callbacks.live.cameras", cameras)
        settings = {"every_s": every_s, "share": share, "idle_s": idle_s, "coarser": coarser}
        for name, value in settings.items():
            check_numbers(f"callbacks.live.{name}", value, error=SceneError, above=0)
        if port > MOST_PORT:
            raise SceneError(f"callbacks.live.port must be {MOST_PORT} or less, got {port}")
        if share > 1:
            raise SceneError(f"callbacks.live.share must be 1 or less, the share of the run's time, got {share}")
        self.port, self.host, self.cameras = port, host, cameras
        self.every_s, self.share, self.idle_s, self.coarser = every_s, share, idle_s, coarser
        self._server: LiveServer | None = None
        self._meter: CostMeter | None = None
        self._began = self._ended = 0.0  # of training, and of the last state
        self._spent = self._last = 0.0  # seconds of all states, and of the last one
        self._states = 0
        self._scores = ""

    # The server lives as long as training ----------------------------------------------------------------------------

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if module.thermal.stays_here:
            log.info("no live viewer: %s", module.thermal.stays_here)
            return
        title = f"{module.scene.name} · {module.config.get('name') or type(module.thermal).__name__}"
        self._server = LiveServer(title, self.host, self.port)
        self._meter = next((one for one in trainer.callbacks if isinstance(one, CostMeter)), None)
        log.info("watch it train: %s", self._server.url)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._began = time.monotonic()

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        if self._server is not None and self._server.watched(self.idle_s) and self._due():
            self._make(trainer, module)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if not trainer.sanity_checking and (told := scores_told(trainer.callback_metrics)):
            self._scores = f"{', '.join(told)} at step {trainer.global_step:,}"

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._server is None:
            return
        done = trainer.global_step >= module.schedule.end
        if done and self._server.watched(self.idle_s):  # who stops it by hand does not want to wait
            self._make(trainer, module)
        self._server.end("Training has ended" if done else "Training was stopped", self.idle_s)

    def teardown(self, trainer: pl.Trainer, module: pl.LightningModule, stage: str) -> None:
        self._close()

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        self._close()

    def _close(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None

    # States ----------------------------------------------------------------------------------------------------------

    def _due(self) -> bool:
        """Whether the time of another state has come, if it takes as long as the last one."""
        if not self._states:
            return True
        now = time.monotonic()
        return now - self._ended >= self.every_s and self._spent + self._last <= self.share * (now - self._began)

    def _make(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        began = time.monotonic()
        with nullcontext() if self._meter is None else self._meter.apart("watching", module):
            self._states += 1
            try:
                self._server.show(self._page(trainer, module), self._states)
            except SceneError as error:  # such as no Gaussian that can be seen, as yet
                self._server.tell(problem=str(error))
            else:
                self._server.tell(problem="")
        self._ended = time.monotonic()
        self._last = self._ended - began
        self._spent += self._last

    def _page(self, trainer: pl.Trainer, module: pl.LightningModule) -> str:
        header, block = payload(module, snapshot(module, self.coarser), self.cameras)
        header["live"] = {
            "run": self._server.run,
            "state": self._states,
            "step": trainer.global_step,
            "steps": module.schedule.end,
            "seconds": None if self._meter is None else self._meter.train_seconds,
            "scores": self._scores,
        }
        return page(header, block)
