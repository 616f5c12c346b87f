"""Jobs in the queue of a SLURM cluster, or as processes of this machine that behave like them (submitit)."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from hydra.core.utils import JobReturn

from heatsplat.errors import SceneError
from hydra_plugins.heatsplat_launchers._jobs import DiedError, Job, JobLauncher, attempt, execute, python_path

try:
    from hydra_plugins.hydra_submitit_launcher.config import BaseQueueConf
except ImportError:  # the extra "slurm" is not installed, and Hydra says so where a configuration asks for it
    BaseQueueConf = None

POLL_SECONDS = 2
QUEUE_SECONDS = 30  # between looks at the queue, which all users of a cluster share
FILE_SECONDS = 60  # in which a result written on another node appears on a shared disk


class Requeued:
    """A job as submitit pickles it: when its time is over it is put back into the queue as it is.

    It goes on from the checkpoint in its folder, which it wrote when it heard that its time was over.
    """

    def __call__(self, *arguments: Any) -> JobReturn:
        return execute(*arguments)

    def checkpoint(self, *arguments: Any) -> Any:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *arguments)


class SubmititLauncher(JobLauncher):
    """One array of jobs on ``cluster``; settings as those of hydra-submitit-launcher."""

    cluster: str

    def __init__(self, **params: Any) -> None:
        self.params = params

    def outcomes(self, jobs: Sequence[Job]) -> Iterator[JobReturn | Exception]:
        import submitit
        from omegaconf import OmegaConf

        params = {
            name: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            for name, value in self.params.items()
        }
        init = {"folder": params.pop("submitit_folder")}
        if "max_num_timeout" in params:
            init[f"{self.cluster}_max_num_timeout"] = params.pop("max_num_timeout")
        executor = submitit.AutoExecutor(cluster=self.cluster, **init)
        common = set(BaseQueueConf.__dataclass_fields__)
        executor.update_parameters(
            **{name if name in common else f"{self.cluster}_{name}": value for name, value in params.items()}
        )
        os.environ["PYTHONPATH"] = python_path()  # jobs inherit the environment
        arguments = zip(*(self.arguments(job) for job in jobs), strict=True)
        for waiting in self.submitted(executor, arguments):
            yield attempt(lambda waiting=waiting: self.wait(waiting))

    def submitted(self, executor: Any, arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """All jobs, handed over to the executor."""
        return executor.map_array(Requeued(), *arguments)

    def wait(self, job: Any) -> JobReturn:
        """What a submitted job returned. Raises what ended it."""
        while not job.done():
            time.sleep(POLL_SECONDS)
        return job.results()[0]


class Local(SubmititLauncher):
    """All jobs at once, as processes of this machine that know time limits and requeue as on a cluster."""

    cluster = "local"


class Slurm(SubmititLauncher):
    """An array of the cluster's queue."""

    cluster = "slurm"

    def outcomes(self, jobs: Sequence[Job]) -> Iterator[JobReturn | Exception]:
        """As of any launcher. Raises SceneError on a machine that is not of a cluster."""
        if shutil.which("srun") is None:
            raise SceneError(
                "launcher=slurm: SLURM is not on this machine (no srun). Start the sweep on one that can submit jobs; "
                "launcher=submitit_local rehearses it here"
            )
        return super().outcomes(jobs)

    def submitted(self, executor: Any, arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """As above. Raises SceneError, with what sbatch says, where it takes no job."""
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        if (cores := executor.parameters.get("cpus_per_task")) is not None:
            # Not every srun takes them over from sbatch (not that of 22.05 and 23.02), and a job would have one core.
            given = executor.parameters.get("srun_args", [])
            executor.update_parameters(slurm_srun_args=[f"--cpus-per-task={cores}", *given])
        try:
            return super().submitted(executor, arguments)
        except (FailedJobError, FailedSubmissionError) as error:
            raise SceneError(
                f"launcher=slurm: sbatch took no job: {' '.join(str(error).split())}. What it is asked for are the "
                "settings of hydra.launcher, such as hydra.launcher.partition, hydra.launcher.gpus_per_node and "
                "hydra.launcher.timeout_min (all of them: conf/launcher/slurm.yaml)"
            ) from error

    def wait(self, job: Any) -> JobReturn:
        """As above. A job that is neither in the queue nor has a result has died.

        submitit asks SLURM's accounting (sacct), which not every cluster has, and would wait for ever.
        """
        looked = time.monotonic()
        while not job.done():
            time.sleep(POLL_SECONDS)
            if time.monotonic() - looked > QUEUE_SECONDS:
                looked = time.monotonic()
                if not _queued(job.job_id) and not _appears(job.paths.result_pickle):
                    raise DiedError(f"SLURM job {job.job_id} left the queue without a result; see {job.paths.stderr}")
        return job.results()[0]


def _queued(number: str) -> bool:
    """Whether a job is in SLURM's queue, waiting or running; True where the queue cannot be asked."""
    if shutil.which("squeue") is None:
        return True
    asked = subprocess.run(["squeue", "--noheader", "--job", number], capture_output=True, text=True)
    if asked.returncode:
        return "Invalid job id" not in asked.stderr
    return bool(asked.stdout.strip())


def _appears(path: Any) -> bool:
    """Whether a file is there within a minute."""
    until = time.monotonic() + FILE_SECONDS
    while not path.exists() and time.monotonic() < until:
        time.sleep(POLL_SECONDS)
    return path.exists()
