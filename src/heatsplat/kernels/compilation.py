"""How the kernels are compiled: one decorator, one cache rule, and one line for whoever waits for it."""

from __future__ import annotations

import functools
import gc
import hashlib
import logging
import os
import pickle
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import CodeType
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite.binding import llvm_version_info
from numba.core import event
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, CompileResult, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.serialize import dumps
from numba.core.typed_passes import NativeLowering, NopythonRewrites
from numba.core.untyped_passes import DeadBranchPrune, InlineClosureLikes
from numba.misc.appdirs import AppDirs
from numba.np.ufunc.parallel import _launch_threads

from heatsplat.kernels.compile_time import FoldConstants

log = logging.getLogger(__name__)

# Contraction gives fused multiply-adds. Reassociation is left out because it folds the rounding trick of simd.exp2 to
# nothing (measured: the image is wrong by 0.21), 'nnan' because comparisons with NaN must stay false: they cull.
FASTMATH = {"contract", "nsz", "arcp"}

# All that kernels are made of; gpu/ is Triton's.
_SOURCES = sorted(Path(__file__).parent.glob("*.py"))


def _when_written() -> list[int]:
    return [path.stat().st_mtime_ns for path in _SOURCES]


# A process that imports other files later may have a mixture of these and of newer ones: it notices by the times.
_WRITTEN = _when_written()
_FINGERPRINT = [hashlib.sha256(path.read_bytes()).hexdigest() for path in _SOURCES]

# Of Numba's, what changes the code.
_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "USING_SVML")

_UNUSED_SECONDS, _ROOM_BYTES = 30 * 86400, 2**30


@functools.cache  # of many kernels in one folder, the first says it for all
def _warn_once(message: str) -> None:
    log.warning(message)


class _Cache(NullCache):
    """A file for each function and the types that it is compiled for, named after all that its code depends on.

    These are contents and versions and no path or time, so that checkouts, environments and wheels share the files. Nor is there
    an index as Numba keeps it, in which processes that write at once give two kernels one file.
    """

    def __init__(self, function: Callable, fastmath: set[str], folder: Path) -> None:
        self._function, self._fastmath, self._folder = function, sorted(fastmath), folder

    @property
    def cache_path(self) -> str:
        return str(self._folder)

    def _path(self, signature: Any, codegen: Any) -> Path:
        function = self._function
        name = (function.__module__, function.__qualname__, function.__code__.co_firstlineno)
        versions = (sys.version, numba.__version__, llvmlite.__version__, llvm_version_info, np.__version__)
        settings = [getattr(numba.config, setting) for setting in _SETTINGS]
        # Machines that share a home share no instructions: the tuple holds the name of the processor and what it can do.
        of = (_FINGERPRINT, name, self._fastmath, signature, versions, settings, codegen.magic_tuple())
        key = hashlib.sha256(repr(of).encode()).hexdigest()[:32]
        return self._folder / f"{function.__module__.rpartition('.')[2]}.{function.__name__}-{key}.nbc"

    def load_overload(self, signature: Any, context: Any) -> Any:
        context.refresh()
        path = self._path(signature, context.codegen())
        try:
            data = path.read_bytes()
        except OSError:
            return None
        try:
            if hashlib.sha256(data[32:]).digest() != data[:32]:  # damaged instructions would crash the process
                raise ValueError("damaged")
            result = CompileResult._rebuild(context, *pickle.loads(data[32:]))
        except Exception:
            _warn_once(f"the kernels' cache in {self._folder} is damaged: what cannot be read is compiled anew")
            with suppress(OSError):
                path.unlink()
            return None
        with suppress(OSError):
            os.utime(path)  # it is in use
        return result

    def save_overload(self, signature: Any, result: Any) -> None:
        if result.library.has_dynamic_globals:  # addresses in this process
            return
        path = self._path(signature, result.codegen)
        unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex[:16]}")
        try:
            _tidy(self._folder)
            code = dumps(result._replace(type_annotation="")._reduce())  # a listing of the source, with its path
            self._folder.mkdir(parents=True, exist_ok=True)
            unfinished.write_bytes(hashlib.sha256(code).digest() + code)
            unfinished.replace(path)
        except Exception as error:
            with suppress(OSError):
                unfinished.unlink()
            if not path.exists():  # Windows lets nobody replace what another process reads
                _warn_once(
                    f"the kernels' cache in {self._folder} cannot be written ({getattr(error, 'strerror', None) or error}): "
                    "until it can, each run compiles them; make room, or set NUMBA_CACHE_DIR to another folder"
                )


@functools.cache  # once in a process, which has compiled something
def _tidy(folder: Path) -> None:
    """Removes what nobody has used for a month, and beyond a gigabyte what has not been used for longest."""
    found = []
    for path in folder.glob("*.nbc*"):
        with suppress(OSError):  # another process removes, too
            found.append((path.stat(), path))
    taken = 0
    for status, path in sorted(found, key=lambda each: each[0].st_mtime, reverse=True):
        taken += status.st_size
        if taken > _ROOM_BYTES or status.st_mtime < time.time() - _UNUSED_SECONDS:
            with suppress(OSError):
                path.unlink()


@functools.cache
def _folder(given: str) -> Path | None:
    """In ``given`` (NUMBA_CACHE_DIR), or of the user, or beside the sources: the first that can be written."""
    user = Path(AppDirs("heatsplat", appauthor=False).user_cache_dir, "kernels")
    beside = _SOURCES[0].parent / "__pycache__"
    for folder in (Path(given, "heatsplat").absolute() if given else user, user, beside):
        with suppress(OSError):
            if folder.is_absolute():  # without a home, the user's is not
                folder.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    _warn_once(
        f"no folder for compiled kernels can be written, neither {user} nor {beside}: each run compiles them; set "
        "NUMBA_CACHE_DIR to a folder that can be written"
    )
    return None


def _cache_on_disk(compiled: Any, function: Callable, fastmath: set[str]) -> None:
    """Only of what the fingerprint is of: nobody knows which files a kernel of another folder is made of."""
    if Path(function.__code__.co_filename) not in _SOURCES or function.__closure__:
        return
    with suppress(OSError):  # it is being edited
        if _when_written() == _WRITTEN:
            folder = _folder(os.environ.get("NUMBA_CACHE_DIR") or numba.config.CACHE_DIR)
            compiled._cache = _Cache(function, fastmath, folder) if folder else NullCache()


# Numba's 'workqueue' threads, the fallback where there is no OpenMP, abort the process if two Python threads use them
# at once; and two kernels at once would only share the same cores.
_ONE_AT_A_TIME = threading.Lock()

_start_pool = functools.cache(_launch_threads)  # once, before code that calls it is loaded


class _PassManager(PassManager):
    """Numba's, which finds out after each pass which values are alive where; the passes that have to know find out themselves
    (measured: 6 % of the time of compilation)."""

    _ENFORCING = False


def _passes(state: Any) -> list[tuple[type, str]]:
    """Numba's, with branches pruned by values that are known when a kernel is compiled.

    Left out is what looks for expressions of whole arrays, which kernels have none of, and for functions in functions that
    have none.
    """
    needless = {NopythonRewrites}
    if not any(isinstance(constant, CodeType) for constant in state.func_id.code.co_consts):
        needless.add(InlineClosureLikes)
    found = [step for step in DefaultPassBuilder.define_nopython_pipeline(state).passes if step[0] not in needless]
    at = next(k for k, (step, _) in enumerate(found) if step is DeadBranchPrune)
    return [*found[:at], (FoldConstants, "fold constants"), *found[at:]]


class _Compiler(CompilerBase):
    def define_pipelines(self) -> list:
        return [_manager("nopython", _passes(self.state))]


def _manager(name: str, passes: list[tuple[type, str]]) -> PassManager:
    manager = _PassManager(name)
    for step, description in passes:
        manager.add_pass(step, description)
    manager.finalize()
    return manager


def kernel(function: Callable, fastmath: set[str] = FASTMATH) -> Callable:
    """``function`` compiled for Python callers: without the GIL, cached on disk; it may use ``parallel_for``."""
    compiled = numba.njit(fastmath=fastmath, error_model="numpy", nogil=True, pipeline_class=_Compiler)(function)
    _cache_on_disk(compiled, function, fastmath)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        with _ONE_AT_A_TIME:
            _start_pool()
            return compiled(*arguments)

    call.compiled = compiled
    return call


def exact_kernel(function: Callable) -> Callable:
    """A ``kernel`` that rounds after every operation, as sums and products that must cancel exactly want it."""
    return kernel(function, fastmath=set())


class _CodeToLink(JITCodeLibrary):
    """Code that is linked into kernels, where it is optimised and turned into instructions, and not before."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerToLink(NativeLowering):
    """Numba's lowering of a function that nobody calls from Python: no wrappers, no instructions."""

    _name = "lowering_to_link"

    def run_pass(self, state: Any) -> bool:
        state.library = _CodeToLink(state.targetctx.codegen(), state.func_id.func_qualname)
        for flag in ("no_compile", "no_cpython_wrapper", "no_cfunc_wrapper"):
            setattr(state.flags, flag, True)
        super().run_pass(state)
        handle = [].copy  # callers know a function by something of its own that is built in, and never call that
        state.targetctx.insert_user_function(handle, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=handle)
        return True


class _CompilerToLink(CompilerBase):
    def define_pipelines(self) -> list:
        passes = [
            (_LowerToLink if step is NativeLowering else step, description) for step, description in _passes(self.state)
        ]
        return [_manager("to link", passes)]


def inline(function: Callable) -> Callable:
    """``function`` compiled into the kernels that call it."""
    options = {"fastmath": FASTMATH, "error_model": "numpy", "forceinline": True}
    return numba.njit(pipeline_class=_CompilerToLink, **options)(function)


class _Compiling(event.Listener):
    """Says once what the first step waits for, and keeps Python from looking for garbage meanwhile.

    All that a compiler builds is alive until it is done: searching it again and again takes a tenth of the time.
    """

    def __init__(self) -> None:
        self._nested, self._collects = 0, False

    def on_start(self, compiling: event.Event) -> None:
        if compiling.data["dispatcher"].py_func.__module__.startswith(__package__):
            _warn_once("compiling kernels for this processor: up to a minute, once")
        if self._nested == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._nested += 1

    def on_end(self, compiling: event.Event) -> None:
        self._nested -= 1
        if self._nested == 0 and self._collects:
            gc.enable()


event.register("numba:compile", _Compiling())
