"""Sweeps in many processes: the same bits as in one, whatever is killed; all results in one table."""

import inspect
import json
import os
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf
from running import run

from heatsplat import cli
from heatsplat.contracts import SceneError
from heatsplat.io.results import RunResults
from heatsplat.studies.sweeps import collect
from heatsplat.training.machine import cores

ROOT = Path(__file__).resolve().parents[2]
SHORT = (
    "method=3dgs", "data.size=tiny", "data.downscale=4", "max_steps=8", "callbacks.images=null", "callbacks.probes=null",
    "callbacks.costs.fps_repeats=1", "callbacks.costs.warmup_steps=1", "callbacks.statistics=null",
    "trainer.limit_val_batches=1", "trainer.limit_test_batches=1", "trainer.val_check_interval=8",
)  # fmt: skip
SPY = "+callbacks.spy._target_=interrupting.Interrupt"
# A job that is left alone, one whose process is killed after step 4 of 8, and one that cannot be built.
ROWS = (
    f"{{whole:{{set:['{SPY}']}},"
    f"cut:{{set:['{SPY}','+callbacks.spy.step=4','+callbacks.spy.name=%s']}},"
    "broken:{set:['init.opacity=2.0']}}"
)


def sweep(folder: Path, launcher: str, name: str, *settings: str) -> subprocess.CompletedProcess:
    """A finished sweep of the three rows under a launcher, with ``name`` as the signal that cuts the second."""
    command = [
        sys.executable, str(ROOT / "src" / "train.py"), "-m", *SHORT, "seed=0", f"launcher={launcher}", *settings,
        f"hydra.sweeper.rows={ROWS % name}", f"hydra.sweep.dir={folder}",
    ]  # fmt: skip
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")]))
    return subprocess.run(
        command, capture_output=True, text=True, timeout=600, env={**os.environ, "PYTHONPATH": paths}
    )  # fmt: skip


def job(folder: Path, number: int) -> Path:
    (path,) = folder.glob(f"3dgs_static_{number}_*")
    return path


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def check(done: subprocess.CompletedProcess, folder: Path, alone: Path, threads: int, goes_on_from: int) -> None:
    """One job failed and says why, the others have the bits of a run ``alone``, and the table has all three."""
    said = done.stdout + done.stderr
    assert done.returncode == 1 and "init.opacity must lie in (0, 1)" in said, said
    assert "init.opacity" in (job(folder, 2) / "FAILED").read_text()
    expected = weights(alone)
    for number in (0, 1):
        assert not (job(folder, number) / "FAILED").exists()
        found = weights(job(folder, number))
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[name], expected[name]) for name in expected), f"job {number} differs"
        used = json.loads((job(folder, number) / "threads.json").read_text())
        assert used["torch"] == used["kernels"] == threads
        assert used["from_step"] == (goes_on_from if number else 0)
    assert (job(folder, 1) / "interrupted").exists()
    table = (folder / "table.md").read_text()
    assert (
        "| whole | 1 |" in table
        and "| cut | 1 |" in table
        and "- broken on static: ValueError('init.opacity must" in table
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Folder of the same run, in this process and without a sweep."""
    folder = tmp_path_factory.mktemp("alone")
    run(folder, *SHORT, "seed=0", "test=false", "threads=2")
    return folder


def launched(folder: Path, *jobs: list[str]) -> tuple[list[int], list[JobStatus]]:
    """Numbers of the jobs that a launcher starts in the folders 0, 1 and so on, where each fails, and what became of all."""
    from hydra_plugins.heatsplat_launchers._jobs import Job, JobLauncher

    started = []

    class Launcher(JobLauncher):
        def outcomes(self, jobs):
            started.extend(job.number for job in jobs)
            return iter([RuntimeError("not tried")] * len(jobs))

        def _job(self, number, overrides):
            return Job(number, tuple(overrides), folder / str(number), None)

        def write_down(self, job):
            pass

    launcher = Launcher()
    launcher.config = OmegaConf.create(
        {"hydra": {"hydra_logging": None, "verbose": False, "sweep": {"dir": str(folder)}}}
    )
    returned = launcher.launch(jobs, 0)
    return started, [job.status for job in returned]


def test_damaged_results_of_one_job_do_not_keep_the_others_from_running(tmp_path):
    """The job that has them is run and fails by itself, with the file's name; here it would end the sweep."""
    for number, text in enumerate(('{"test": {"psnr": 3', None)):
        (tmp_path / str(number)).mkdir()
        if text is not None:
            (tmp_path / str(number) / "metrics.json").write_text(text)
    assert launched(tmp_path, ["seed=0"], ["seed=1"]) == ([0, 1], [JobStatus.FAILED] * 2)


def test_results_of_other_settings_are_not_a_jobs_own(tmp_path):
    """The job is run, and refuses its folder by itself; where and how it runs is no other setting."""
    before = ["max_steps=40", "seed=0", "row=a", "threads=1", "callbacks.images=null"]
    for number in range(5):
        (tmp_path / str(number) / ".hydra").mkdir(parents=True)
        (tmp_path / str(number) / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(before))
        RunResults().write(tmp_path / str(number) / "metrics.json")
    jobs = (
        ["seed=0", "max_steps=40", "row=b", "threads=2", "launcher=joblib"],
        ["seed=0", "max_steps=80", "row=a"],
        ["seed=0", "max_steps=40", "+thermal.clip=null"],
        ["seed=0", "max_steps=40", "callbacks=plateau"],
        ["seed=0", "max_steps=40", "+trainer.gradient_clip_val=1e-4", "trainer.val_check_interval=9"],
    )
    done, failed = JobStatus.COMPLETED, JobStatus.FAILED
    assert launched(tmp_path, *jobs) == ([1, 2, 3, 4], [done, *[failed] * 4])


def composing(folder: Path, scene: str = "cooling"):
    """A launcher of a sweep in ``folder`` whose configuration is a small file there, and whose jobs all die."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path

    from hydra_plugins.heatsplat_launchers import _jobs

    class Launcher(_jobs.JobLauncher):
        def outcomes(self, jobs):
            return iter([RuntimeError("out of memory")] * len(jobs))

    (folder / "train.yaml").write_text(f"method: 3dgs\nseed: 0\nthreads: 1\ndata: {{scene: {scene}}}\n")
    loader = ConfigLoaderImpl(create_config_search_path(str(folder)))
    settings = [f"hydra.sweep.dir={folder}/sweep", "hydra.sweep.subdir=${hydra:job.num}", "hydra/hydra_logging=none"]
    launcher = Launcher()
    launcher.hydra_context = type("Context", (), {"config_loader": loader})
    launcher.config = loader.load_configuration("train", settings, RunMode.MULTIRUN)
    return launcher


def test_results_of_a_file_that_was_edited_since_are_not_a_jobs_own(tmp_path):
    """The job is run, and compares what was composed, as with launcher=basic."""
    jobs, done, failed = [["seed=0"], ["seed=1", "threads=2"]], JobStatus.COMPLETED, JobStatus.FAILED
    composing(tmp_path).launch(jobs, 0)
    for number in range(2):
        RunResults().write(tmp_path / "sweep" / str(number) / "metrics.json")
    statuses = [[job.status for job in composing(tmp_path, scene).launch(jobs, 0)] for scene in ("cooling", "heated")]
    assert statuses == [[done, done], [failed, failed]]
    (tmp_path / "sweep" / "0" / ".hydra" / "config.yaml").write_text("{")
    assert [job.status for job in composing(tmp_path).launch(jobs, 0)] == [failed, done]


def test_a_job_that_dies_before_it_wrote_anything_is_in_the_table(tmp_path, monkeypatch, caplog):
    """As one that is taken out of a queue before it starts, or whose node cannot load what it needs."""
    from hydra_plugins.heatsplat_launchers import _jobs

    caplog.set_level("INFO", "heatsplat")
    jobs = ["method=3dgs", "seed=0"], ["method=3dgs", "seed=1"]
    composing(tmp_path).launch(jobs, 0)
    monkeypatch.setattr(_jobs, "MANY", 2)
    composing(tmp_path).launch(jobs, 0)  # the same once more
    assert caplog.text.count("composing the settings of 2 jobs") == 1
    (row,) = collect(tmp_path / "sweep")
    assert (row.scene, row.label, row.failed) == ("cooling", "3dgs", ["RuntimeError: out of memory"] * 2)


@pytest.mark.parametrize("launcher", ["joblib.Joblib", "ray.Ray"])
def test_a_job_is_started_at_least_once(launcher):
    module, _, name = launcher.partition(".")
    made = getattr(import_module(f"hydra_plugins.heatsplat_launchers.{module}"), name)
    with pytest.raises(ValueError, match="hydra.launcher.retries must be 0 or more, got -1"):
        made(retries=-1)
    assert made(retries=0).retries == 0


def test_without_slurm_its_rehearsal_is_named(monkeypatch, tmp_path):
    from hydra_plugins.heatsplat_launchers.submitit import Slurm

    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SceneError, match=r"no srun.*launcher=submitit_local rehearses it here"):
        Slurm().outcomes([])


@pytest.mark.parametrize(
    ("launcher", "mode", "told"),
    [("slurm", RunMode.RUN, True), ("slurm", RunMode.MULTIRUN, False), ("basic", RunMode.RUN, False)],
)
def test_a_single_run_says_that_its_launcher_has_nothing_to_start(launcher, mode, told, monkeypatch, caplog, tmp_path):
    choices = {"study": None, "launcher": launcher}
    hydra_config = OmegaConf.create({"mode": mode, "runtime": {"choices": choices}, "sweeper": {}})
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra_config)
    monkeypatch.setattr("heatsplat.runs.run.train_in", lambda *_: RunResults())
    with caplog.at_level("WARNING", logger="heatsplat"):
        inspect.unwrap(cli.train)({}, tmp_path)
    assert (
        "launcher=slurm starts the jobs of a sweep; this single run trains right here: add -m" in caplog.text
    ) == told


NO_SUBMITIT = pytest.mark.skipif(
    find_spec("submitit") is None, reason="hydra-submitit-launcher is not installed: pip install -e '.[slurm]'"
)


def submitted(folder: Path, monkeypatch, sbatch: str, jobs: int, **settings) -> list:
    """What waits for each of so many jobs, handed to a cluster whose sbatch is a line of shell."""
    from hydra_plugins.heatsplat_launchers._jobs import Job
    from hydra_plugins.heatsplat_launchers.submitit import Slurm

    for name, line in {"srun": "", "sbatch": sbatch}.items():
        (folder / name).write_text(f"#!/bin/sh\n{line}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))  # which the launcher sets
    monkeypatch.setattr(Slurm, "wait", lambda self, job: job)
    launcher = Slurm(submitit_folder=str(folder / "%j"), **settings)
    launcher.hydra_context = launcher.config = launcher.task_function = None
    return list(launcher.outcomes([Job(number, (), folder, None) for number in range(jobs)]))


@NO_SUBMITIT
def test_what_sbatch_has_against_the_jobs_is_told_in_a_sentence(tmp_path, monkeypatch):
    no = "echo 'sbatch: error: invalid partition specified: gpu' >&2; exit 1"
    with pytest.raises(SceneError, match=r"invalid partition specified: gpu\. .*hydra\.launcher\.partition"):
        submitted(tmp_path, monkeypatch, no, 2, partition="gpu")


@NO_SUBMITIT
@pytest.mark.parametrize("jobs", [1, 2])
def test_srun_is_told_the_cores_of_a_job_too(tmp_path, monkeypatch, jobs):
    """Not every srun takes them over from sbatch."""
    sbatch = f'cp "$1" {tmp_path}/script; echo Submitted batch job 7'
    assert len(submitted(tmp_path, monkeypatch, sbatch, jobs, cpus_per_task=8, gpus_per_node=None)) == jobs
    script = (tmp_path / "script").read_text().splitlines()
    (srun,) = (line for line in script if line.startswith("srun "))
    assert "#SBATCH --cpus-per-task=8" in script and " --cpus-per-task=8 " in srun


@pytest.mark.slow  # processes of their own load torch five times over; shares and going on: test_stop_and_go_on.py
@pytest.mark.skipif(find_spec("joblib") is None, reason="joblib is not installed: pip install -e '.[sweep]'")
def test_jobs_side_by_side_share_the_cores_and_survive_a_killed_process(tmp_path, alone):
    folder = tmp_path / "sweep"
    done = sweep(folder, "joblib", "SIGKILL", "hydra.launcher.n_jobs=2")
    check(done, folder, alone, threads=max(1, cores() // 2), goes_on_from=2)
    told = json.loads((job(folder, 0) / "threads.json").read_text())
    assert told["OMP_NUM_THREADS"] == told["NUMBA_NUM_THREADS"] == str(max(1, cores() // 2))


@pytest.mark.slow
@NO_SUBMITIT
def test_a_job_whose_time_is_over_goes_back_into_the_queue_and_on_from_its_checkpoint(tmp_path, alone):
    """SIGUSR2 is what SLURM sends before the time limit; checkpoints come every two steps, and one more now."""
    folder = tmp_path / "sweep"
    done = sweep(folder, "submitit_local", "SIGUSR2")
    assert len(list(folder.glob("3dgs_static_*"))) == 3  # requeued into its own folder
    check(done, folder, alone, threads=1, goes_on_from=5)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install -e '.[ray]'")
def test_ray_starts_a_killed_job_again(tmp_path, alone):
    folder = tmp_path / "sweep"
    done = sweep(folder, "ray", "SIGKILL", "hydra.launcher.address=local")
    assert len(list(folder.glob("3dgs_static_*"))) == 3  # started again in its own folder
    check(done, folder, alone, threads=1, goes_on_from=2)
