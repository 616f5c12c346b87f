"""A callback for jobs of other processes: tells the threads that the job uses, and interrupts it once."""

import json
import os
import signal
import time

import numba
import pytorch_lightning as pl
import torch


class Interrupt(pl.Callback):
    """Sends the job's own process a signal after a step, the first time that it gets there.

    Writes threads.json beside the results: what torch and the kernels run on, and what the libraries were told.

    Args:
        step: after which the signal comes; None for never.
        name: of the signal.
        pause_s: seconds to wait after every step, for a run that outlasts its time limit without a busy core.
    """

    def __init__(self, step: int | None = None, name: str = "SIGKILL", pause_s: float = 0.0) -> None:
        self.step, self.signal, self.pause_s = step, signal.Signals[name], pause_s

    def on_train_start(self, trainer, module):
        used = {"torch": torch.get_num_threads(), "kernels": numba.get_num_threads()}
        told = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
        (module.output_dir / "threads.json").write_text(json.dumps(used | told | {"from_step": trainer.global_step}))

    def on_train_batch_end(self, trainer, module, *_):
        time.sleep(self.pause_s)
        marker = module.output_dir / "interrupted"
        if trainer.global_step == self.step and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), self.signal)
