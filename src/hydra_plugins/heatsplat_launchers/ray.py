"""Jobs as tasks of a Ray cluster."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobReturn

from hydra_plugins.heatsplat_launchers._jobs import (
    DiedError,
    Job,
    JobLauncher,
    attempt,
    checked_retries,
    execute_contained,
    python_path,
)


@dataclass
class RayConf:
    """Settings of ``Ray``."""

    _target_: str = "hydra_plugins.heatsplat_launchers.ray.Ray"
    address: str = "auto"
    num_cpus: int = 1
    num_gpus: float = 0
    retries: int = 2


ConfigStore.instance().store(group="hydra/launcher", name="heatsplat_ray", node=RayConf, provider="heatsplat")


class Ray(JobLauncher):
    """Every job is a task with a process of its own, wherever the cluster has room.

    Args:
        address: of the cluster: auto (RAY_ADDRESS, or the one that runs on this machine), host:port, ray://host:port, or
            local for a cluster of this machine that lives as long as the sweep.
        num_cpus: cores that a job takes.
        num_gpus: GPUs that a job takes; 0.25 puts four jobs on one.
        retries: how often a job whose process or node died starts again by itself, from its last checkpoint.
    """

    def __init__(self, address: str = "auto", num_cpus: int = 1, num_gpus: float = 0, retries: int = 2) -> None:
        self.address, self.num_cpus, self.num_gpus, self.retries = address, num_cpus, num_gpus, checked_retries(retries)

    def outcomes(self, jobs: Sequence[Job]) -> Iterator[JobReturn | Exception]:
        try:
            import ray
        except ImportError as error:
            raise ImportError("launcher=ray needs Ray: pip install -e '.[ray]'") from error

        ray.init(address=self.address, log_to_driver=False, runtime_env={"env_vars": {"PYTHONPATH": python_path()}})
        try:
            # One call per process: a job's memory is given back, and its peak is its own.
            options = {"num_cpus": self.num_cpus, "num_gpus": self.num_gpus, "max_calls": 1}
            again = {"max_retries": self.retries, "retry_exceptions": [DiedError]}
            remote = ray.remote(**options, **again)(execute_contained)
            for running in [remote.remote(*self.arguments(job)) for job in jobs]:
                yield attempt(lambda running=running: ray.get(running))
        finally:
            ray.shutdown()
