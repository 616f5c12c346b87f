"""A sweep whose launcher is killed: its workers end with it, and the same command goes on."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from heatsplat.io.results import RunResults

ROOT = Path(__file__).resolve().parents[2]
PATHS = os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests" / "launchers")])

PARENT = """
import multiprocessing, os, time
from hydra_plugins.heatsplat_launchers.joblib import end_with

def work(parent):
    end_with(parent)
    time.sleep(60)

if __name__ == "__main__":
    child = multiprocessing.get_context("fork").Process(target=work, args=(os.getpid(),))
    child.start()
    print(child.pid, flush=True)
    time.sleep(60)
"""


def gone(pid, within_s):
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.1)
    return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_worker_ends_soon_after_its_launcher(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS}
    )
    child = int(parent.stdout.readline())
    assert not gone(child, 0.5)
    parent.kill()
    parent.wait()
    assert gone(child, 10)


def sweep(folder):
    command = [
        sys.executable, str(ROOT / "src" / "train.py"), "-m", "method=3dgs", "data.size=tiny", "data.downscale=4", "max_steps=20",
        "callbacks.images=null", "callbacks.probes=null", "callbacks.costs.fps_repeats=1", "seed=0,1", "launcher=joblib",
        "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={folder}", "+callbacks.spy._target_=interrupting.Interrupt",
        "+callbacks.spy.pause_s=0.2",
    ]  # fmt: skip
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": PATHS}
    )


def scores(folder):
    return [RunResults.read(path).test["psnr"] for path in sorted(folder.glob("*/metrics.json"))]


@pytest.mark.slow
def test_a_killed_sweep_leaves_no_workers_and_goes_on(tmp_path):
    (done := sweep(tmp_path / "whole")).communicate(timeout=600)
    assert done.returncode == 0
    folder = tmp_path / "cut"
    cut = sweep(folder)
    end = time.monotonic() + 500
    while not list(folder.glob("*/checkpoints/*.ckpt")) and time.monotonic() < end:
        time.sleep(0.1)
    workers = [int(re.search(r"\d+", path.read_text())[0]) for path in folder.glob("*/.lock")]
    cut.send_signal(signal.SIGKILL)
    cut.wait()
    assert workers and all(gone(pid, 60) for pid in workers)
    (again := sweep(folder)).communicate(timeout=600)
    assert again.returncode == 0 and len(scores(folder)) == 2
    assert scores(folder) == scores(tmp_path / "whole")
    assert (folder / "table.md").exists()
