"""Which cores a process takes, and how it loads libraries."""

import gc
import os
import subprocess
import sys
import weakref
from pathlib import Path

import pytest
import torch

from heatsplat import composition
from heatsplat.kernels import scheduling
from heatsplat.training import machine

SRC = Path(__file__).resolve().parents[2] / "src"


@pytest.mark.parametrize(
    ("asked", "told", "expected"),
    [(None, None, 3), (2, None, 2), (None, "2", 2), (1, "2", 1), (None, "1,4", 1), (None, "", 3), (None, "0", 3)],
)
def test_a_run_takes_the_cores_of_its_job_and_not_those_of_the_node(monkeypatch, asked, told, expected):
    """Fewer where it is told a number, or OpenMP is."""
    taken = []
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if told is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", told)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {4, 5, 6}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(scheduling, "use_threads", taken.append)
    monkeypatch.setattr(torch, "set_num_threads", taken.append)
    machine.prepare_machine(asked)
    assert taken == [expected, expected]


def test_where_no_process_can_be_bound_to_cores_all_count(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # macOS, Windows
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert machine.cores() == 8


def test_the_command_line_counts_by_the_same_rule_and_loads_nothing_heavy_for_it():
    assert composition.cores is machine.cores
    heavy = "{'torch', 'numba', 'pytorch_lightning'} & set(sys.modules)"
    told = f"import sys, heatsplat.cli; heatsplat.compose; sys.exit(bool({heavy}))"
    assert subprocess.run([sys.executable, "-c", told], env={**os.environ, "PYTHONPATH": str(SRC)}).returncode == 0


def test_what_an_earlier_job_left_behind_is_cleared_away(monkeypatch):
    job = torch.nn.Module()
    job.itself, seen = [job], weakref.ref(job)
    gc.disable()  # so that nothing else finds it
    try:
        del job
        assert seen() is not None
        machine.clear_away()
        assert seen() is None
    finally:
        gc.enable()
    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name: object())  # a system without malloc_trim
    machine.clear_away()


def test_libraries_are_left_out_of_the_search_for_garbage_once(monkeypatch):
    """What a second job of a process leaves behind is found."""
    calls = []
    for name in ("disable", "freeze", "enable"):
        monkeypatch.setattr(gc, name, lambda name=name: calls.append(name))
    monkeypatch.setattr(gc, "get_freeze_count", lambda: 0)
    with pytest.raises(ImportError), machine.loading():
        assert calls == ["disable"]
        raise ImportError("half of it")
    assert calls == ["disable", "freeze", "enable"]
    monkeypatch.setattr(gc, "get_freeze_count", lambda: 5)
    with machine.loading():
        pass
    assert calls == ["disable", "freeze", "enable"]
