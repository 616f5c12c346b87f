"""What a job does when it is told to stop, and where it goes on when it is started again."""

import os

import pytest
import torch
from hydra.core.utils import JobStatus
from running import TINY, compose_run, run

from heatsplat import composition
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.resume import resumed
from heatsplat.studies.finished import reason_of
from hydra_plugins.heatsplat_launchers._jobs import DiedError, Job, _died


@pytest.mark.parametrize(("jobs", "expected"), [(1, 6), (2, 3), (4, 1), (9, 1), (-1, 1)])
def test_jobs_side_by_side_get_fair_shares_of_the_cores(jobs, expected, monkeypatch):
    monkeypatch.setattr(composition, "cores", lambda: 6)
    sweep = ("method=3dgs", "launcher=joblib", f"hydra.launcher.n_jobs={jobs}")
    assert compose_run(*sweep).threads is None, "a single run has all cores"
    assert compose_run(*sweep, "hydra.mode=MULTIRUN").threads == expected
    assert compose_run(*sweep, "hydra.mode=MULTIRUN", "threads=5").threads == 5


def configured(*overrides):
    return composition.compose([*TINY, "method=3dgs", "max_steps=8", *overrides])


def stored(folder, name, step, config):
    (folder / "checkpoints").mkdir(exist_ok=True)
    path = folder / "checkpoints" / name
    torch.save({"global_step": step, "heatsplat": {"config": config, "schedule": {"end": 8.0}}}, path)
    os.utime(path, (step, step))


def test_a_run_goes_on_from_the_newest_checkpoint_that_can_be_read_and_is_not_the_last(tmp_path):
    plain = configured()
    assert resumed(plain, tmp_path) == plain
    stored(tmp_path, "step_000002.ckpt", 2, plain)
    stored(tmp_path, "step_000004.ckpt", 4, plain | {"threads": 1, "ckpt": "elsewhere"})
    stored(tmp_path, "last.ckpt", 8, plain)
    broken = tmp_path / "checkpoints" / "step_000006.ckpt"
    broken.write_bytes(b"half a file")
    os.utime(broken, (6, 6))
    assert resumed(plain, tmp_path) == plain | {"ckpt": str(tmp_path / "checkpoints" / "step_000004.ckpt")}
    given = plain | {"ckpt": str(tmp_path / "checkpoints" / "step_000002.ckpt")}
    assert resumed(given, tmp_path) == given


def test_a_stopped_run_is_not_overwritten_by_one_of_other_settings(tmp_path):
    stored(tmp_path, "last.ckpt", 4, configured("optim.means=1e-3"))
    told = (
        r"unfinished run with other settings \(optim.means\), of which last.ckpt is of step 4: .*run.dir \(of a sweep: "
        r"hydra.sweep.dir\).*ckpt=.*/last.ckpt"
    )
    for ckpt in (None, str(tmp_path / "elsewhere" / "checkpoints" / "last.ckpt")):
        with pytest.raises(OccupiedError, match=told):
            resumed(configured() | {"ckpt": ckpt}, tmp_path)
    with pytest.raises(OccupiedError, match=r"\(\S+, \S+, \S+, \S+, \S+ and \d+ more\)"):
        resumed(configured("method=etgs", "optim.means=1e-3"), tmp_path)


def test_a_run_of_more_steps_goes_on_in_the_folder_of_the_shorter_one(tmp_path):
    stored(tmp_path, "last.ckpt", 8, configured())
    ckpt = tmp_path / "checkpoints" / "last.ckpt"
    assert resumed(configured("max_steps=16", f"ckpt={ckpt}"), tmp_path)["ckpt"] == str(ckpt)
    with pytest.raises(OccupiedError, match="max_steps"):
        resumed(configured("max_steps=16"), tmp_path)


def test_a_job_whose_process_died_says_so_in_its_folder(tmp_path):
    job = Job(3, ("seed=1",), tmp_path / "job", None)
    failed = _died(job, DiedError("its process was\nkilled"))
    assert failed.status == JobStatus.FAILED
    assert (job.folder / "FAILED").read_text() == "DiedError: its process was killed\n"
    (job.folder / "FAILED").write_text("what the job said itself")
    _died(job, DiedError("later"))
    assert (job.folder / "FAILED").read_text() == "what the job said itself"


def test_why_a_process_died_is_written_and_read_whatever_its_letters(tmp_path):
    job = Job(3, ("seed=1",), tmp_path / "job", None)
    _died(job, DiedError("no scene a\udcfc at 20 °C"))  # of a file's name that is no UTF-8
    assert reason_of(job.folder) == "DiedError: no scene a\\udcfc at 20 °C"
    (job.folder / "FAILED").write_bytes("ValueError: 20 °C".encode("cp1252"))  # as Windows wrote it
    assert reason_of(job.folder) == "ValueError: 20 \ufffdC"


def test_under_slurm_a_stray_checkpoint_of_the_working_directory_is_not_gone_on_from(tmp_path, monkeypatch):
    for name, value in {
        "SLURM_NTASKS": "1",
        "SLURM_JOB_NAME": "job",
        "SLURM_JOB_ID": "1",
        "SLURM_NODELIST": "a",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hpc_ckpt_1.ckpt").write_bytes(b"of another run")
    _, trainer = run(tmp_path / "run", *TINY, "method=3dgs", "max_steps=2", "data.downscale=4", "test=false")
    assert trainer.global_step == 2
