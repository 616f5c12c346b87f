"""Runs beside each other: how the study times them. (The ratio itself is measured on an idle machine.)"""

import subprocess
import sys

import pytest

from benchmarks import company
from heatsplat.contracts import SceneError

WAIT = "import time; time.sleep(1)"


def test_runs_side_by_side_start_at_once(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    together = company.seconds_of([sys.executable, "-S", "-c", WAIT], folders)
    assert 1.0 < together < 2.9


def test_a_run_that_fails_is_quoted(tmp_path):
    with pytest.raises(SceneError, match="no such thing"):
        company.seconds_of([sys.executable, "-S", "-c", "raise SystemExit('no such thing')"], [tmp_path])


@pytest.mark.parametrize("key", ["rounds", "together"])
@pytest.mark.parametrize("value", [0, "abc"])
def test_what_counts_nothing_is_refused_before_the_first_run(tmp_path, monkeypatch, key, value):
    monkeypatch.setattr(company, "seconds_of", lambda *_: pytest.fail("it ran"))
    with pytest.raises(SceneError, match=f"study.{key} must be a whole number, 1 or more, got {value}"):
        company.run(tmp_path, "train.py", [], **{key: value})


def test_a_folder_with_runs_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(company, "seconds_of", lambda *_: pytest.fail("it ran"))
    (tmp_path / "first").mkdir()
    with pytest.raises(SceneError, match="holds runs, and a finished one is not run again: give a new folder"):
        company.run(tmp_path, "train.py", [])


def test_no_run_outlives_one_that_failed(tmp_path, monkeypatch):
    start, started = subprocess.Popen, []
    monkeypatch.setattr(company.subprocess, "Popen", lambda *a, **b: started.append(start(*a, **b)) or started[-1])
    program = "import sys, time; 'slow' in sys.argv[1] or sys.exit('no such thing'); time.sleep(60)"
    with pytest.raises(SceneError, match="no such thing"):
        company.seconds_of([sys.executable, "-S", "-c", program], [tmp_path / "quick", tmp_path / "slow"])
    assert started[1].wait(30) != 0


@pytest.mark.parametrize("side_by_side", [2.0, 3.0])
def test_the_ratio_is_written_and_one_above_the_limit_fails(tmp_path, monkeypatch, side_by_side):
    monkeypatch.setattr(company, "seconds_of", lambda _, folders: 1.0 if len(folders) == 1 else side_by_side)
    if side_by_side > 2.2:
        with pytest.raises(SceneError, match=r"3\.00 times as long"):
            company.run(tmp_path, "train.py", [])
    else:
        company.run(tmp_path, "train.py", [])
    assert f"{side_by_side:.2f} times" in (tmp_path / company.TABLE_FILE).read_text()
