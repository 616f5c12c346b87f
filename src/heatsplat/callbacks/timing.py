"""What a run costs: seconds, steps and frames per second, memory."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch

from heatsplat.callbacks.board import add_scalars
from heatsplat.contracts import check_count
from heatsplat.metrics.definitions import COSTS

try:
    import resource
except ImportError:  # Windows
    resource = None

OF_EVERY_TEST = {"render_fps", "peak_memory_mb", "gaussians"}  # costs that a test measures, even without training
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class CostMeter(pl.Callback):
    """Measures what a run costs and puts it into ``module.results.cost``.

    * ``choosing_seconds``: wall time before training in which the effects of the scene were chosen (method=auto), 0 where there
      was nothing to choose; in none of the others.
    * ``train_seconds``: wall time of training steps, everything that happens in them included (data, render, backward,
      optimiser, density control, callbacks, writing checkpoints). Excluded: validation with its pictures and curves,
      the test, set-up, the first ``warmup_steps`` steps after every start, in which kernels are compiled, and what a callback
      keeps ``apart``.
    * ``cpu_seconds``: processor seconds of this process in the same steps, all of its threads added up. A run on one thread
      takes as many beside other runs as alone, but for what they take of caches and memory, so they compare runs of a busy
      machine. On several threads those that wait for work count while they spin (``OMP_WAIT_POLICY=PASSIVE``: they sleep);
      on a GPU they are those of the host.
    * ``steps_per_second``: the steps timed so, by their ``train_seconds``.
    * ``warmup_seconds``, ``evaluation_seconds``: the time of the excluded steps, and of validation during training.
    * ``watching_seconds``: in which training waited for a state of the live viewer; only of runs that were watched.
    * ``wall_seconds``: all of the training run, from its first step to its end.
    * ``render_fps``: one by the median time of a rendered test view, as ``predict`` gives it.
    * ``peak_memory_mb``: in 10^6 bytes; on a GPU what tensors took at most, otherwise the largest resident memory of
      the process since the run's start, its libraries included.

    A resumed run goes on counting where the checkpoint left off.

    Args:
        every: steps between entries in TensorBoard.
        warmup_steps: steps that are not counted, after every start.
        fps_views: test views over which the frame rate is measured.
        fps_repeats: renders of each of them.
    """

    def __init__(self, every: int = 50, warmup_steps: int = 3, fps_views: int = 4, fps_repeats: int = 10) -> None:
        check_count("callbacks.costs.every", every)
        check_count("callbacks.costs.warmup_steps", warmup_steps, 0)
        check_count("callbacks.costs.fps_views", fps_views)
        check_count("callbacks.costs.fps_repeats", fps_repeats)
        self.every, self.warmup_steps = every, warmup_steps
        self.fps_views, self.fps_repeats = fps_views, fps_repeats
        self.seconds = {"train": 0.0, "warmup": 0.0, "evaluation": 0.0}
        self._cpu_before = 0.0
        self.steps = 0
        self.peak_mb = 0.0
        self._since: float | None = None
        self._cpu_since = 0.0
        self._phase = "train"
        self._warming = 0

    # The clock: one phase runs at a time -----------------------------------------------------------------------------

    def _switch(self, phase: str | None, module: pl.LightningModule) -> None:
        """Ends the running phase and starts another; None stops the clock."""
        if module.device.type == "cuda":
            torch.cuda.synchronize(module.device)
        self.seconds, self._cpu_before = self._reading(), self.cpu_seconds
        self._since = None if phase is None else time.perf_counter()
        self._cpu_since = time.process_time()
        self._phase = phase or self._phase

    @property
    def _training_phase(self) -> str:
        return "warmup" if self._warming else "train"

    @contextmanager
    def apart(self, phase: str, module: pl.LightningModule) -> Iterator[None]:
        """Counts what happens in the block as a phase of its own, which then has its ``<phase>_seconds``."""
        before = None if self._since is None else self._phase
        self.seconds.setdefault(phase, 0.0)
        self._switch(phase, module)
        try:
            yield
        finally:
            self._switch(before, module)
            self._publish(module)

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        _reset_peak(module.device)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._warming = self.warmup_steps
        self._switch(self._training_phase, module)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        if self._warming:
            self._warming -= 1
            if not self._warming:
                self._switch("train", module)
            return
        self.steps += 1
        if trainer.global_step % self.every == 0:
            self._publish(module)
            shown = {
                name: module.results.cost[name] for name in ("train_seconds", "steps_per_second", "peak_memory_mb")
            }
            known = {f"cost/{name}": value for name, value in shown.items() if value is not None}
            add_scalars(module, known, trainer.global_step)

    def on_validation_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._since is not None:
            self._switch("evaluation", module)
            self._publish(module)

    def on_validation_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if self._since is not None:
            self._switch(self._training_phase, module)

    def on_train_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        self._switch(None, module)
        self._publish(module)

    def on_exception(self, trainer: pl.Trainer, module: pl.LightningModule, exception: BaseException) -> None:
        self._since = None

    # What is reported ------------------------------------------------------------------------------------------------

    def _reading(self) -> dict[str, float]:
        """Seconds of every phase up to now, without stopping the clock."""
        running = 0.0 if self._since is None else time.perf_counter() - self._since
        return {phase: value + running * (phase == self._phase) for phase, value in self.seconds.items()}

    @property
    def train_seconds(self) -> float:
        """Seconds of training up to now."""
        return self._reading()["train"]

    @property
    def cpu_seconds(self) -> float:
        """Processor seconds of training up to now, likewise."""
        running = self._since is not None and self._phase == "train"
        return self._cpu_before + (time.process_time() - self._cpu_since if running else 0.0)

    def _publish(self, module: pl.LightningModule) -> None:
        """Puts what is known into the results, on which other callbacks read the training seconds."""
        put = module.results.put
        seconds = self._reading()
        if self.steps:
            put("cost", "train_seconds", seconds["train"])
            put("cost", "cpu_seconds", self.cpu_seconds)
            put("cost", "steps_per_second", self.steps / seconds["train"])
        else:
            for name in ("train_seconds", "cpu_seconds", "steps_per_second"):
                put("cost", name, None, f"the run was not longer than its {self.warmup_steps} steps of warm-up")
        put("cost", "choosing_seconds", module.config.get("choosing_seconds", 0.0))
        for phase, value in seconds.items():
            if phase != "train":
                put("cost", f"{phase}_seconds", value)
        put("cost", "wall_seconds", sum(seconds.values()))
        self._publish_peak(module)
        put("cost", "gaussians", len(module.splats))

    def on_test_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        if sum(self.seconds.values()) == 0:
            for name in COSTS:
                if name not in OF_EVERY_TEST:
                    module.results.put("cost", name, None, "this run evaluated a checkpoint and trained nothing")

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        module.results.put("cost", "gaussians", len(module.splats))
        frames = module.scene.test.frames
        if frames:
            count = min(self.fps_views, len(frames))
            chosen = [frames[i * len(frames) // count] for i in range(count)]
            module.results.put("cost", "render_fps", 1.0 / statistics.median(self._render_seconds(module, chosen)))
        else:
            module.results.put("cost", "render_fps", None, "the scene has no test views")
        self._publish_peak(module)

    def _publish_peak(self, module: pl.LightningModule) -> None:
        peak = _peak_mb(module.device)
        if peak is None:
            why = "this system does not tell how much memory a process took"
            module.results.put("cost", "peak_memory_mb", None, why)
            return
        self.peak_mb = max(self.peak_mb, peak)
        module.results.put("cost", "peak_memory_mb", self.peak_mb)

    def _render_seconds(self, module: pl.LightningModule, frames: list) -> list[float]:
        """Seconds of repeated renders, each frame's first one left out."""
        cuda = module.device.type == "cuda"
        times = []
        for frame in frames:
            for repeat in range(self.fps_repeats + 1):
                start = time.perf_counter()
                module.predict(frame)
                if cuda:
                    torch.cuda.synchronize(module.device)
                if repeat:
                    times.append(time.perf_counter() - start)
        return times

    # Resume ----------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        return {
            "seconds": self._reading(),
            "cpu_seconds": self.cpu_seconds,
            "steps": self.steps,
            "peak_mb": self.peak_mb,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.seconds, self._cpu_before = dict(state["seconds"]), state["cpu_seconds"]
        self.steps, self.peak_mb = state["steps"], state["peak_mb"]


def _reset_peak(device: torch.device) -> None:
    """Forgets earlier peaks, so that the runs of one process (a sweep) do not inherit each other's."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return
    try:
        CLEAR.write_text("5")  # Linux: sets the peak to what is resident now
    except OSError:
        return


def _peak_mb(device: torch.device) -> float | None:
    """Peak memory in 10^6 bytes: allocated tensors on a GPU, resident memory of the process otherwise; None where unknown."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    try:
        line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e6
    except (OSError, StopIteration):
        if resource is None:
            return None
        # Bytes on macOS, KiB elsewhere; cannot be reset, so a sweep's later runs may show an earlier run's peak.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6
