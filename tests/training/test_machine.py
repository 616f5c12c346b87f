"""Which cores a process takes, and how it loads libraries."""

import gc
import os
import subprocess
import sys
import weakref
from pathlib import Path
from types import ModuleType

import pytest
import torch
from pytorch_lightning.utilities.compile import OptimizedModule
from torch.optim import Optimizer

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
    monkeypatch.setattr(gc, "get_freeze_count", lambda: calls.append("count"))  # which takes as long as a search
    monkeypatch.setattr(machine, "_loaded", False)
    with pytest.raises(ImportError), machine.loading():
        assert calls == ["disable"]
        raise ImportError("half of it")
    assert calls == ["disable", "freeze", "enable"]
    with machine.loading():
        pass
    assert calls == ["disable", "freeze", "enable"]


def test_lightning_is_loaded_without_what_no_command_uses_and_who_asks_for_it_later_gets_it(monkeypatch):
    """The tests load libraries as commands do (conftest.py)."""
    assert OptimizedModule.__module__ == machine.__name__
    assert Optimizer.add_param_group.__wrapped__.__dynamo_disable is Optimizer.add_param_group.__wrapped__
    given = ModuleType("scipy.signal")
    monkeypatch.setitem(sys.modules, "scipy.signal", given)  # it is there, and stays
    monkeypatch.delitem(sys.modules, "torch._dynamo", raising=False)
    with machine._stand_ins():
        assert sys.modules["scipy.signal"] is given
        from torch._dynamo import OptimizedModule as none

        assert not isinstance(torch.nn.Linear(1, 1), none)

        @torch.compiler.disable
        def as_it_is() -> int:
            return 3

        assert as_it_is() == 3
    assert sys.modules["scipy.signal"] is given and "torch._dynamo" not in sys.modules
    monkeypatch.undo()
    import scipy.signal

    assert len(scipy.signal.windows.hann(5)) == 5
    assert torch.compile(lambda x: x + 1, backend="eager")(torch.ones(2)).tolist() == [2.0, 2.0]


@pytest.mark.parametrize("user", [None, "COMPATIBLE"])
def test_sums_of_matrix_products_do_not_depend_on_threads_where_the_processor_would_let_them(user):
    """What the user sets stands, and other processors than Intel's are left as they are."""
    environment = {name: value for name, value in os.environ.items() if name != "MKL_CBWR"}
    environment |= {"PYTHONPATH": str(SRC)} | ({} if user is None else {"MKL_CBWR": user})
    told = subprocess.run(
        [sys.executable, "-c", "import heatsplat, os; print(heatsplat._made_by_intel(), os.environ.get('MKL_CBWR'))"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    intel, mode = told.stdout.split()
    cpuinfo = Path("/proc/cpuinfo")
    assert not cpuinfo.exists() or intel == str("GenuineIntel" in cpuinfo.read_text())
    assert mode == (user or {"True": "AUTO,STRICT", "False": "None"}[intel])
