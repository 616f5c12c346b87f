"""What the launchers share: which jobs are left to run, how one runs in another process, what becomes of one that died.

The name begins with an underscore because Hydra executes every other file of a plugin a second time.
"""

from __future__ import annotations

import logging
import os
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from heatsplat.io.command_lines import as_dict
from heatsplat.io.files import write_atomically
from heatsplat.io.recorded import CONFIG, OVERRIDES, config_of, overrides_of
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults

log = logging.getLogger("heatsplat")

MANY = 20  # jobs that take long enough to compose to say so


class DiedError(RuntimeError):
    """The process of a job ended before the job did."""


@dataclass(frozen=True)
class Job:
    """One job of a sweep.

    Args:
        number: its number in the sweep, which is part of its folder's name.
        overrides: what it sets.
        folder: where its results go.
        threads: CPU threads that it uses; None for all cores.
        anew: whether results in its folder are of files of configuration that say other things now.
    """

    number: int
    overrides: tuple[str, ...]
    folder: Path
    threads: int | None
    anew: bool = False


class JobLauncher(Launcher):
    """Runs the jobs that have no results yet, and waits for every one whatever becomes of the others.

    A job whose process died leaves FAILED with the reason in its folder, as one that raised does by itself; started
    again in the same folder, either goes on from its last checkpoint.
    """

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    @abstractmethod
    def outcomes(self, jobs: Sequence[Job]) -> Iterator[JobReturn | Exception]:
        """Starts all jobs, then gives for each in turn what it returned, or what ended it."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        Path(self.config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
        if len(job_overrides) >= MANY:
            log.info("composing the settings of %d jobs, which name their folders", len(job_overrides))
        jobs = [self._job(initial_job_idx + i, overrides) for i, overrides in enumerate(job_overrides)]
        ended = {job.number: done for job in jobs if (done := _finished(job)) is not None}
        left = [job for job in jobs if job.number not in ended]
        for job in left:
            log.info("#%d: %s", job.number, " ".join(filter_overrides(job.overrides)))
        if left:
            for job, outcome in zip(left, self.outcomes(left), strict=True):
                if not isinstance(outcome, JobReturn):
                    self.write_down(job)
                    outcome = _died(job, outcome)
                ended[job.number] = outcome
                failed = ended[job.number].status == JobStatus.FAILED
                log.info(
                    "#%d %s; %d of %d jobs ended", job.number, "FAILED" if failed else "done", len(ended), len(jobs)
                )
        return [ended[job.number] for job in jobs]

    def _job(self, number: int, overrides: Sequence[str]) -> Job:
        return planned(self.hydra_context, self.config, number, overrides)

    def write_down(self, job: Job) -> None:
        """Writes what a job was to be, unless it came to that itself: the table of a sweep is of folders that say so."""
        if (job.folder / OVERRIDES).exists():
            return
        with composed(self.hydra_context, self.config, job.number, job.overrides) as own:
            config = OmegaConf.masked_copy(own, [key for key in own if key != "hydra"])
            write_atomically(job.folder / CONFIG, OmegaConf.to_yaml(config))
        write_atomically(job.folder / OVERRIDES, OmegaConf.to_yaml(filter_overrides(job.overrides)))

    def arguments(self, job: Job) -> tuple[Any, ...]:
        """The arguments with which ``execute`` runs the job in any process; cloudpickle can pickle them."""
        return job, self.hydra_context, self.config, self.task_function, Singleton.get_state()


def planned(context: HydraContext, config: DictConfig, number: int, overrides: Sequence[str]) -> Job:
    """A job of a sweep with its folder, which Hydra names by the job's own configuration."""
    with composed(context, config, number, overrides) as own:
        folder = Path(own.hydra.sweep.dir, own.hydra.sweep.subdir)
        return Job(number, tuple(overrides), folder, OmegaConf.select(own, "threads"), _differs(own, folder))


def _differs(config: DictConfig, folder: Path) -> bool:
    """Whether a folder has results of other settings than are composed, which the command line need not tell: files may have
    been edited since."""
    if not (folder / METRICS_FILE).exists():
        return False
    from heatsplat.runs.resume import differences

    try:
        before = config_of(folder)
    except (ValueError, OSError):  # the job says so itself
        return True
    own = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    return bool(before and differences(OmegaConf.to_container(own, resolve=False), before))


@contextmanager
def composed(context: HydraContext, config: DictConfig, number: int, overrides: Sequence[str]) -> Iterator[DictConfig]:
    """The configuration of one job of a sweep, which is Hydra's current one while it lasts."""
    before = HydraConfig.instance().cfg
    try:
        yield _configuration(context, config, number, overrides)
    finally:
        HydraConfig.instance().cfg = before


def checked_retries(retries: int) -> int:
    """How often a job starts again by itself. Raises ValueError for less than never."""
    if retries < 0:
        raise ValueError(f"hydra.launcher.retries must be 0 or more, got {retries}")
    return retries


def python_path() -> str:
    """PYTHONPATH with which other processes import what this one did, installed or not."""
    return os.pathsep.join(filter(None, [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH")]))


def execute(
    job: Job, context: HydraContext, config: DictConfig, task_function: TaskFunction, state: dict[Any, Any]
) -> JobReturn:
    """What a job returned, run here: in a process that Hydra did not start."""
    setup_globals()
    Singleton.set_state(state)
    return run_job(
        hydra_context=context,
        task_function=task_function,
        config=_configuration(context, config, job.number, job.overrides),
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
    )


def execute_contained(*arguments: Any) -> JobReturn:
    """As ``execute``, in a process that lives on.

    Raises:
        DiedError: the job was stopped. The SystemExit itself would end whoever waits for the job.
    """
    try:
        return execute(*arguments)
    except (SystemExit, KeyboardInterrupt) as stopped:
        raise DiedError(f"stopped before it was done ({type(stopped).__name__} {stopped})") from None


def attempt(wait: Callable[[], JobReturn]) -> JobReturn | Exception:
    """What ``wait`` returns or raises."""
    try:
        return wait()
    except Exception as error:
        return error


def _configuration(context: HydraContext, config: DictConfig, number: int, overrides: Sequence[str]) -> DictConfig:
    """The configuration of one job of a sweep, which is Hydra's current one from now on."""
    job = context.config_loader.load_sweep_config(config, list(overrides))
    with open_dict(job):
        job.hydra.job.num = number
        job.hydra.job.id = f"{job.hydra.job.name}_{number}"
    HydraConfig.instance().set_config(job)
    return job


def _finished(job: Job) -> JobReturn | None:
    """What a job returned that has results of its settings already, else None."""
    from heatsplat.runs.resume import learned_by

    file = job.folder / METRICS_FILE
    if not file.exists():
        return None
    try:
        results = RunResults.read(file)
        before = overrides_of(job.folder)
    except (ValueError, OSError):  # the job says so itself, and takes no other down
        return None
    if job.anew or learned_by(before) != learned_by(as_dict(job.overrides)):
        return None  # the job compares what was composed, and refuses the results of other settings
    log.info("#%d has results already; skipped. Delete %s to run it again.", job.number, job.folder)
    done = JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED)
    done.return_value = results.test.get("psnr")
    return done


def _died(job: Job, error: Exception) -> JobReturn:
    """The result of a job whose process did not live to return one, with the reason in its folder."""
    reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
    reason = reason.encode("utf-8", "backslashreplace").decode()  # neither logs nor files hold surrogates
    log.error("#%d died: %s", job.number, reason)
    if not (job.folder / FAILED).exists():
        write_atomically(job.folder / FAILED, reason + "\n")
    failed = JobReturn(overrides=job.overrides, status=JobStatus.FAILED)
    failed.return_value = error
    return failed
