"""One run: graceful interruption, fit, test; and the module of a run that is over."""

from __future__ import annotations

import logging
import signal
import sys
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import pytorch_lightning as pl
from pytorch_lightning.profilers import PassThroughProfiler

from heatsplat.contracts import SceneError
from heatsplat.io.results import RunResults
from heatsplat.training.module import SplatTraining

log = logging.getLogger(__name__)


class Unprofiled(PassThroughProfiler):
    """Lightning's profiler that measures nothing, without the generator that it makes around each of a hundred hooks a step."""

    _nothing = nullcontext()

    def profile(self, action_name: str) -> AbstractContextManager:
        return self._nothing


class StopOnInterrupt(pl.Callback):
    """Ends training after the current step when Ctrl-C was pressed; a second Ctrl-C aborts at once.

    SIGTERM stays with whoever listens outside (``runs.signals.stoppable``): Lightning, which takes it when training starts, would
    end the run on its own after the step, without a checkpoint and with exit code 0.
    """

    def __init__(self) -> None:
        self.interrupted = False
        self._sigterm: Any = None

    def ask(self, *_: Any) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True
        log.warning("Interrupted: finishing this step and writing a checkpoint. Press Ctrl-C again to abort at once.")

    def on_train_start(self, *_: Any) -> None:
        if self._sigterm is not None:
            signal.signal(signal.SIGTERM, self._sigterm)

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if self.interrupted:
            trainer.should_stop = True

    @contextmanager
    def listening(self):
        """Takes over Ctrl-C while the block runs (in the main thread; elsewhere the block just runs)."""
        try:
            before = signal.signal(signal.SIGINT, self.ask)
        except ValueError:
            yield
            return
        self._sigterm = signal.getsignal(signal.SIGTERM)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


def fit(
    module: SplatTraining,
    data: pl.LightningDataModule,
    trainer: pl.Trainer,
    ckpt: str | None = None,
    test: bool = True,
) -> RunResults:
    """Trains, then tests; what was measured. After Ctrl-C the process ends with code 130 and says how to go on."""
    stop = next(callback for callback in trainer.callbacks if isinstance(callback, StopOnInterrupt))
    data.restarts = module.schedule.restarts
    with stop.listening():
        trainer.fit(module, datamodule=data, ckpt_path=ckpt)
    if stop.interrupted:
        last = module.output_dir / "checkpoints" / "last.ckpt"
        trainer.save_checkpoint(last)
        log.warning("Stopped at step %d. Go on with the same command and ckpt=%s", trainer.global_step, last)
        sys.exit(130)
    if test:
        trainer.test(module, datamodule=data, verbose=False)
    return module.results


def restore(module: SplatTraining, data: pl.LightningDataModule, checkpoint: dict[str, Any]) -> SplatTraining:
    """The module with the weights of a checkpoint, ready to predict views of the data module's scene.

    Raises:
        SceneError: the weights are not finite, or the scene lacks what the module needs.
    """
    data.setup("test")
    module.attach(data.scene)
    module.make_room(checkpoint)
    module.load_state_dict(checkpoint["state_dict"])
    broken = [name for name, parameter in module.named_parameters() if not bool(parameter.isfinite().all())]
    if broken:
        raise SceneError(
            f"the checkpoint holds NaN or infinite values in {', '.join(broken)}; heatsplat writes no such file"
        )
    return module.eval()
