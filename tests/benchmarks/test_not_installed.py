"""Where only the package is installed, a benchmark says where it is."""

import subprocess
import sys
from pathlib import Path

SOURCES = Path(__file__).resolve().parents[2] / "src"
STUDY = f"import sys; sys.path.insert(0, {str(SOURCES)!r}); from heatsplat.cli import study; study()"


def test_a_benchmark_names_the_command_that_runs_it(tmp_path):
    command = [sys.executable, "-c", STUDY, "study=renderer", f"hydra.run.dir={tmp_path}/run"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    wanted = (
        "study=renderer is a benchmark of the source checkout: run python src/study.py study=renderer in a clone of it"
    )
    assert wanted in done.stdout + done.stderr and "Traceback" not in done.stdout + done.stderr
