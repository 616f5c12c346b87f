"""Jobs side by side on this machine, each in a process of its own (joblib's loky)."""

import os
import signal
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread

from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobReturn

from heatsplat.training.machine import cores
from hydra_plugins.heatsplat_launchers._jobs import (
    DiedError,
    Job,
    JobLauncher,
    attempt,
    checked_retries,
    execute_contained,
    log,
)

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

GRACE_S = 120.0  # seconds for a checkpoint, once the launcher is gone


@dataclass
class JoblibConf:
    """Settings of ``Joblib``."""

    _target_: str = "hydra_plugins.heatsplat_launchers.joblib.Joblib"
    n_jobs: int = -1
    retries: int = 1


ConfigStore.instance().store(group="hydra/launcher", name="heatsplat_joblib", node=JoblibConf, provider="heatsplat")


def end_with(launcher: int) -> None:
    """Has this process end soon after the one that launched it, whatever killed that: its job writes a checkpoint first."""

    def watch() -> None:
        while os.getppid() == launcher:
            time.sleep(1.0)
        end = time.monotonic() + GRACE_S
        # The first signal stops the job after its step (runs.signals.stoppable), the last this process.
        while time.monotonic() < end:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


class Joblib(JobLauncher):
    """As many processes as jobs run at a time, each with its own queue: one that is killed takes no other down.

    (In joblib's own pool, and in hydra-joblib-launcher with it, one killed process ends all.) A process runs one job
    after the other, so that libraries are loaded and kernels compiled once.

    Args:
        n_jobs: jobs at a time; -1 for one per core.
        retries: how often a job whose process was killed starts again by itself, from its last checkpoint.
    """

    def __init__(self, n_jobs: int = -1, retries: int = 1) -> None:
        if n_jobs < 1 and n_jobs != -1:
            raise ValueError(f"hydra.launcher.n_jobs must be 1 or more, or -1 for one per core, got {n_jobs}")
        self.n_jobs, self.retries = n_jobs, checked_retries(retries)

    def outcomes(self, jobs: Sequence[Job]) -> Iterator[JobReturn | Exception]:
        try:
            from joblib.externals.loky.process_executor import ProcessPoolExecutor, TerminatedWorkerError
        except ImportError as error:
            raise ImportError("launcher=joblib needs joblib: pip install -e '.[sweep]'") from error

        at_a_time = min(cores() if self.n_jobs == -1 else self.n_jobs, len(jobs))
        # Libraries read these when they are loaded; what the job itself sets (torch, kernels) comes too late for some.
        share = str(max(job.threads or cores() for job in jobs))
        environment = dict.fromkeys(THREADS, share)
        processes: SimpleQueue[ProcessPoolExecutor | None] = SimpleQueue()
        for _ in range(at_a_time):
            processes.put(None)

        def run(job: Job) -> JobReturn:
            process = processes.get()
            try:
                for _ in range(self.retries + 1):
                    process = process or ProcessPoolExecutor(
                        max_workers=1, env=environment, initializer=end_with, initargs=(os.getpid(),)
                    )
                    try:
                        return process.submit(execute_contained, *self.arguments(job)).result()
                    except TerminatedWorkerError:
                        process = None
                        log.warning("#%d: its process was killed", job.number)
                raise DiedError(f"its process was killed {self.retries + 1} times (out of memory?)")
            finally:
                processes.put(process)

        threads = ThreadPoolExecutor(at_a_time)
        try:
            for future in [threads.submit(run, job) for job in jobs]:
                yield attempt(future.result)
        finally:
            threads.shutdown(
                cancel_futures=True
            )  # after Ctrl-C: what runs writes its checkpoint, the rest never starts
            while not processes.empty():
                process = processes.get()
                if process is not None:
                    process.shutdown()
