"""The cache of compiled kernels: shared by whatever has the same content; damaged, full or unwritable, it costs time only."""

import ast
import errno
import gc
import os
import shutil
import sys
import time
from pathlib import Path

import llvmlite
import numba
import numpy as np
import pytest
from commands import SOURCES, forking, succeeds
from numba.core.postproc import PostProcessor
from numba.misc import appdirs

from heatsplat.kernels import compilation
from heatsplat.kernels.compilation import exact_kernel, kernel
from heatsplat.kernels.compile_time import ConstantType


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


def forget() -> None:
    for once in (compilation._warn_once, compilation._folder, compilation._tidy):
        once.cache_clear()


@pytest.fixture
def kept(monkeypatch):
    """This file counts as one of those that kernels are made of, and nothing is known of folders."""
    monkeypatch.setattr(compilation, "_SOURCES", [*compilation._SOURCES, Path(__file__)])
    monkeypatch.setattr(compilation, "_WRITTEN", compilation._when_written())
    forget()
    yield
    forget()


@pytest.fixture
def folder(kept, tmp_path, monkeypatch) -> Path:
    """The cache's folder, empty."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = Path(kernel(double).compiled._cache.cache_path)
    assert tmp_path in folder.parents
    return folder


def test_a_kernel_is_loaded_the_second_time(folder):
    assert not was_loaded(doubled_anew())
    assert was_loaded(doubled_anew())


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def exchange(path: Path) -> None:
    """What can be read and run all the same: only the hash tells."""
    data = path.read_bytes()
    assert b"numbers" in data
    path.write_bytes(data.replace(b"numbers", b"numberz"))


@pytest.mark.parametrize("damage", [cut, exchange])
def test_damaged_files_are_written_anew_and_said_once(folder, caplog, damage):
    doubled_anew()
    (path,) = folder.iterdir()
    for _ in range(2):
        damage(path)
        assert not was_loaded(doubled_anew())
        assert was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert str(folder) in line and "damaged" in line


def test_a_full_disk_is_said_once(folder, caplog, monkeypatch):
    aged(folder / "old.nbc", 31)  # makes room, at least

    def full(path, data):
        with path.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for _ in range(2):
        assert not was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert str(folder) in line and "No space left" in line
    assert list(folder.iterdir()) == []


def test_a_file_that_another_process_reads_stays_without_a_word(folder, caplog, monkeypatch):
    def refuse(*_):
        raise PermissionError("in use")  # as on Windows

    compiled = doubled_anew()
    ((signature, result),) = compiled.overloads.items()
    monkeypatch.setattr(Path, "replace", refuse)
    compiled._cache.save_overload(signature, result)
    assert caplog.messages == [] and len(list(folder.iterdir())) == 1
    assert was_loaded(doubled_anew())


def test_a_folder_that_vanishes_is_made_and_filled_again(folder):
    compiled = kernel(double)
    shutil.rmtree(folder)
    compiled(np.arange(5.0))
    assert not was_loaded(compiled.compiled)
    assert was_loaded(doubled_anew())


@pytest.fixture
def places(kept, tmp_path, monkeypatch) -> dict[str, Path]:
    """Where compiled kernels may lie, in the order of preference; the user's own as Linux and its like have it."""
    source = tmp_path / "package" / "source.py"
    source.parent.mkdir()
    source.touch()
    monkeypatch.setattr(compilation, "_SOURCES", [source, Path(__file__)])
    monkeypatch.setattr(compilation, "_WRITTEN", compilation._when_written())
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    monkeypatch.setattr(appdirs, "system", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.chdir(tmp_path)
    return {
        "NUMBA_CACHE_DIR": tmp_path / "given" / "heatsplat",
        "XDG_CACHE_HOME": tmp_path / "user" / "heatsplat" / "kernels",
        "": source.parent / "__pycache__",
    }


@pytest.mark.parametrize("blocked", [0, 1, 2])
def test_the_first_folder_that_can_be_written_is_taken(places, blocked):
    for variable in [*places][:blocked]:
        Path(os.environ[variable]).touch()  # no folder can be made there
    assert not was_loaded(doubled_anew())
    assert was_loaded(doubled_anew())
    assert [bool(list(place.glob("*.nbc"))) for place in places.values()] == [k == blocked for k in range(3)]


def test_a_home_that_is_not_known_is_not_the_working_directory(places, tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    doubled_anew()
    assert list(places[""].glob("*.nbc"))
    assert [path.name for path in tmp_path.iterdir()] == ["package"]


def test_without_any_folder_kernels_run_all_the_same(folder, caplog, monkeypatch):
    def refuse(**_):
        raise PermissionError("read-only")

    compilation._folder.cache_clear()
    monkeypatch.setattr(compilation.tempfile, "TemporaryFile", refuse)
    for _ in range(2):
        assert not was_loaded(doubled_anew())
    (line,) = caplog.messages
    assert "NUMBA_CACHE_DIR" in line


KERNEL = """
from heatsplat.kernels.compilation import kernel
from heatsplat.kernels.helper import change

@kernel
def scale(numbers):
    for k in range(numbers.shape[0]):
        numbers[k] = change(numbers[k])
"""
HELPER = """
from heatsplat.kernels.compilation import inline

@inline
def change(number):
    return 2.0 * number
"""
SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path(__file__).parent))
import numpy as np
from heatsplat.kernels import scaled
assert Path(scaled.__file__).parents[2] == Path(__file__).parent
numbers = np.ones(2)
scaled.scale(numbers)
print("loaded" if scaled.scale.compiled.stats.cache_hits else "compiled", numbers[0])
"""


def checkout(folder: Path, factor: float, written: int) -> Path:
    """A copy of the compiler beside a kernel of two files, all written at one time."""
    shutil.copytree(
        SOURCES / "heatsplat/kernels", folder / "heatsplat/kernels", ignore=shutil.ignore_patterns("gpu", "__*")
    )
    for name, text in (
        ("__init__", ""),
        ("kernels/scaled", KERNEL),
        ("kernels/helper", HELPER.replace("2.0", str(factor))),
    ):
        (folder / f"heatsplat/{name}.py").write_text(text)
    for path in folder.rglob("*.py"):
        os.utime(path, (written, written))
    (folder / "script.py").write_text(SCRIPT)
    return folder


def test_checkouts_share_what_was_compiled_until_any_of_their_files_differs(tmp_path):
    cache = tmp_path / "cache"

    def said(folder: Path) -> str:
        return succeeds([str(folder / "script.py")], NUMBA_CACHE_DIR=str(cache)).splitlines()[-1]

    one, other = checkout(tmp_path / "one", 2.0, written=10**9), checkout(tmp_path / "other", 2.0, written=10**9 + 9)
    assert said(one) == "compiled 2.0"
    (file,) = cache.rglob("*.nbc")
    assert str(tmp_path).encode() not in file.read_bytes()
    shutil.rmtree(one)
    assert said(other) == "loaded 2.0"

    edited = checkout(
        tmp_path / "edited", 3.0, written=10**9 + 9
    )  # a helper of the same size, written at the same time
    assert said(edited) == "compiled 3.0"
    assert said(edited) == "loaded 3.0"
    assert said(other) == "loaded 2.0"


def test_kernels_are_made_of_the_files_that_are_looked_at():
    files = {path.stem for path in compilation._SOURCES}
    for path in compilation._SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in getattr(node, "names", ())]
            for name in (name for name in names if name and name.startswith("heatsplat")):
                inside = name.removeprefix("heatsplat.kernels").removeprefix(".")
                of_package = {alias.name for alias in node.names} if not inside else {inside}
                assert name.startswith("heatsplat.kernels") and of_package <= files, (path, name)


def scaler(factor):
    def scale(numbers):
        numbers *= factor

    return scale


def test_a_kernel_of_another_folder_or_of_a_closure_is_not_kept(folder, monkeypatch):
    for factor in (2.0, 3.0):  # the code is the same
        numbers = np.ones(1)
        kernel(scaler(factor))(numbers)
        assert numbers[0] == factor
    monkeypatch.setattr(compilation, "_SOURCES", compilation._SOURCES[:-1])
    monkeypatch.setattr(compilation, "_WRITTEN", compilation._when_written())
    doubled_anew()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("edit", [Path.touch, Path.unlink])
def test_what_is_edited_while_a_process_runs_is_not_kept(folder, tmp_path, monkeypatch, edit):
    source = tmp_path / "source.py"
    source.write_text("")
    os.utime(source, (0, 0))
    monkeypatch.setattr(compilation, "_SOURCES", [*compilation._SOURCES, source])
    monkeypatch.setattr(compilation, "_WRITTEN", compilation._when_written())
    edit(source)
    doubled_anew()
    assert list(folder.iterdir()) == []


class Machine:
    """Stands for the code generator of a processor."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def magic_tuple(self):
        return self.names


def test_a_name_holds_all_that_the_code_depends_on(folder, monkeypatch):
    one, read_only = (numba.float64[:],), numba.types.Array(numba.float64, 1, "A", readonly=True)
    others = [(numba.float32[:],), (read_only,), (ConstantType(Path("a")),), (ConstantType(Path("b")),)]
    machine = Machine("x86_64", "skylake", "+avx,+avx2")

    def name(compiled=double, signature=one, machine=machine, decorate=kernel) -> Path:
        return decorate(compiled).compiled._cache._path(signature, machine)

    before = name()
    assert name() == before
    names = {
        before,
        *(name(signature=signature) for signature in others),
        name(machine=Machine("x86_64", "haswell", "+avx,+avx2")),
        name(machine=Machine("x86_64", "skylake", "+avx,-avx2")),
        name(decorate=exact_kernel),
        name(double_of_another_line()),
    }
    changes = [
        (compilation, "_FINGERPRINT"), (sys, "version"), (numba, "__version__"), (llvmlite, "__version__"),
        (np, "__version__"), (numba.config, "USING_SVML"), (numba.config, "BOUNDSCHECK"), (numba.config, "OPT"),
    ]  # fmt: skip
    for owner, attribute in changes:
        with monkeypatch.context() as patch:
            patch.setattr(owner, attribute, "another")
            names.add(name())
    assert len(names) == 5 + len(others) + len(changes)
    assert name() == before


def double_of_another_line():
    def double(numbers):
        pass

    double.__qualname__ = "double"
    return double


DAY = 86400


def aged(path: Path, days: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"1234")
    os.utime(path, (time.time() - days * DAY,) * 2)
    return path


def test_what_nobody_has_used_for_a_month_goes_when_something_is_compiled(folder):
    old, unfinished = aged(folder / "old.nbc", 31), aged(folder / "cut.nbc.0123", 31)
    young, foreign = aged(folder / "young.nbc", 29), aged(folder / "module.pyc", 99)
    (folder / "gone.nbc").symlink_to(folder / "nothing")  # as if removed between listing and reading
    doubled_anew()
    assert not old.exists() and not unfinished.exists()
    assert young.exists() and foreign.exists()


def test_what_is_loaded_counts_as_used_and_loading_removes_nothing(folder):
    doubled_anew()
    (own,) = folder.glob("*.nbc")
    os.utime(own, (0, 0))
    old = aged(folder / "old.nbc", 31)
    compilation._tidy.cache_clear()
    assert was_loaded(doubled_anew())
    assert own.stat().st_mtime > time.time() - DAY
    assert old.exists()


def test_of_more_than_there_is_room_for_the_longest_unused_goes(folder, monkeypatch):
    doubled_anew()
    (own,) = folder.glob("*.nbc")
    own.unlink()
    monkeypatch.setattr(compilation, "_ROOM_BYTES", 9)
    files = [aged(folder / f"{days}.nbc", days) for days in (3, 1, 2, 4)]
    compilation._tidy.cache_clear()
    doubled_anew()
    assert own.exists() and [path.exists() for path in files] == [False, True, True, False]


def _double_at_once(folder: str, barrier) -> None:
    os.environ["NUMBA_CACHE_DIR"] = folder
    compilation._SOURCES.append(Path(__file__))
    compilation._WRITTEN = compilation._when_written()
    barrier.wait(60)
    doubled_anew()


def test_processes_may_fill_the_cache_at_once(folder, tmp_path):
    context = forking()
    barrier = context.Barrier(2)
    processes = [context.Process(target=_double_at_once, args=(str(tmp_path), barrier)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
        assert process.exitcode == 0
    assert was_loaded(doubled_anew())
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("collects", [True, False])
def test_nobody_looks_for_garbage_while_the_compiler_works(monkeypatch, collects):
    """Also where it fails; afterwards it is as it was."""
    while_compiling, passes = [], compilation._passes
    monkeypatch.setattr(compilation, "_passes", lambda state: noting(while_compiling, passes(state)))
    before = gc.isenabled()
    (gc.enable if collects else gc.disable)()
    try:
        kernel(double)(np.arange(5.0))
        with pytest.raises(numba.TypingError):
            kernel(double)("no numbers")
        after = gc.isenabled()
    finally:
        (gc.enable if before else gc.disable)()
    assert (while_compiling, after) == ([False, False], collects)


def noting(notes: list[bool], passes: list) -> list:
    notes.append(gc.isenabled())
    return passes


def doubled_within(numbers):
    def twice(number):
        return 2.0 * number

    for k in range(numbers.shape[0]):
        numbers[k] = twice(numbers[k])


@pytest.mark.parametrize(("function", "looks_for_functions"), [(double, False), (doubled_within, True)])
def test_passes_run_where_they_have_something_to_do(monkeypatch, function, looks_for_functions):
    """What is alive where is found out for those that have to know it, and not after each."""
    steps, asked, passes, run = [], [], compilation._passes, PostProcessor.run
    monkeypatch.setattr(compilation, "_passes", lambda state: steps.append(passes(state)) or steps[-1])
    monkeypatch.setattr(
        PostProcessor, "run", lambda self, *options, **named: asked.append(1) or run(self, *options, **named)
    )
    numbers = np.arange(5.0)
    numba.njit(pipeline_class=compilation._Compiler)(function)(numbers)
    np.testing.assert_array_equal(numbers, 2 * np.arange(5.0))
    names = [step.__name__ for step, _ in steps[0]]
    assert ("InlineClosureLikes" in names) == looks_for_functions and "NopythonRewrites" not in names
    assert looks_for_functions or len(asked) < len(names) / 2
