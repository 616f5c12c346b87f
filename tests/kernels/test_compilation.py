"""The cache of compiled kernels: damaged, full or unwritable, it costs time and not the run."""

import errno
from pathlib import Path

import numba
import numpy as np
import pytest
from commands import forking
from numba.core import caching

from heatsplat.kernels import compilation
from heatsplat.kernels.compilation import kernel


def double(numbers):
    for k in range(numbers.shape[0]):
        numbers[k] *= 2.0


def doubled_anew():
    """``double`` as a process that starts now would compile or load it, after its first call."""
    compiled = kernel(double)
    numbers = np.arange(5.0)
    compiled(numbers)
    np.testing.assert_array_equal(numbers, 2 * np.arange(5.0))
    return compiled.compiled


def was_loaded(compiled) -> bool:
    return sum(compiled.stats.cache_hits.values()) > 0


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The cache's folder, empty."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    compilation._warn_once.cache_clear()
    return Path(kernel(double).compiled._cache.cache_path)


def test_a_kernel_is_loaded_the_second_time(folder):
    assert not was_loaded(doubled_anew())
    assert was_loaded(doubled_anew())


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


@pytest.mark.parametrize(("kind", "damage"), [("nbi", cut), ("nbc", cut), ("nbc", flip)])
def test_damaged_files_are_written_anew_and_said_once(folder, caplog, kind, damage):
    doubled_anew()
    (path,) = folder.glob(f"*.{kind}")
    for _ in range(2):
        damage(path)
        assert not was_loaded(doubled_anew())
        assert was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert str(folder) in line and "damaged" in line


def test_a_full_disk_is_said_once(folder, caplog, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "_save_data", full)
    for _ in range(2):
        assert not was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert str(folder) in line and "No space left" in line


def test_a_cache_cut_off_from_its_data_is_filled_again(folder):
    doubled_anew()
    for path in folder.glob("*.nbc"):
        path.unlink()
    assert not was_loaded(doubled_anew())
    assert was_loaded(doubled_anew())


def refuse(*_):
    raise PermissionError("read-only")


def test_a_read_only_installation_uses_the_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(caching.InTreeCacheLocator, "ensure_cache_path", refuse)
    assert not was_loaded(doubled_anew())
    assert was_loaded(doubled_anew())
    assert list(tmp_path.glob("**/*.nbc"))


def test_without_any_folder_kernels_run_all_the_same(folder, caplog, monkeypatch):
    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuse)
    for _ in range(2):
        assert not was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert "NUMBA_CACHE_DIR" in line


def _double_at_once(folder: str, barrier) -> None:
    numba.config.CACHE_DIR = folder
    barrier.wait(60)
    doubled_anew()


def test_processes_may_fill_the_cache_at_once(folder):
    context = forking()
    barrier = context.Barrier(2)
    processes = [context.Process(target=_double_at_once, args=(numba.config.CACHE_DIR, barrier)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    assert was_loaded(doubled_anew())
    assert not list(folder.glob("*.tmp.*"))
