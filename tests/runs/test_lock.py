"""One process in a run's folder at a time, on every system."""

import errno
import os
import subprocess
import sys

import pytest

from heatsplat.runs import lock
from heatsplat.runs.lock import LOCK_FILE, OccupiedError, locked


def test_a_folder_is_one_process_s_until_that_ends_however_it_does(tmp_path):
    hold = "import sys, time; from heatsplat.runs.lock import locked\nfrom pathlib import Path\n"
    hold += "with locked(Path(sys.argv[1])): print('in', flush=True); time.sleep(600)"
    other = subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "in\n"
        with pytest.raises(OccupiedError, match=f"under way .process {other.pid} on "), locked(tmp_path):
            pass
    finally:
        other.kill()
        other.wait()
    with locked(tmp_path):
        pass


def test_the_file_names_who_is_in_it_and_a_second_go_is_free(tmp_path):
    folder = tmp_path / "not" / "there"
    with locked(folder):
        assert (folder / LOCK_FILE).read_text().startswith(f"process {os.getpid()} on ")
    with locked(folder):
        assert (folder / LOCK_FILE).read_text().count("process") == 1


def test_a_system_without_file_locks_keeps_nobody_out(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "fcntl", None)
    with locked(tmp_path), locked(tmp_path):
        assert not (tmp_path / LOCK_FILE).exists()


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_disk_without_locks_is_told_and_keeps_nobody_out(tmp_path, monkeypatch, caplog, number):
    def flock(file, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(lock.fcntl, "flock", flock)
    with locked(tmp_path):
        assert f"{tmp_path} has no locks ({os.strerror(number)})" in caplog.text
