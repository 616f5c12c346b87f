"""How the kernels are compiled: one decorator, one cache rule, and one line for whoever waits for it."""

from __future__ import annotations

import functools
import glob
import hashlib
import logging
import pickle
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.serialize import dumps
from numba.core.typed_passes import NativeLowering
from numba.core.untyped_passes import DeadBranchPrune
from numba.np.ufunc.parallel import _launch_threads

from heatsplat.kernels.compile_time import FoldConstants

log = logging.getLogger(__name__)

# Contraction gives fused multiply-adds. Reassociation is left out because it folds the rounding trick of simd.exp2 to
# nothing (measured: the image is wrong by 0.21), 'nnan' because comparisons with NaN must stay false: they cull.
FASTMATH = {"contract", "nsz", "arcp"}

# Numba's cache looks only at the file of the function itself; with this in the names of its files it also notices
# changed helpers in other files, and never unpickles types of another version of this package.
_FINGERPRINT = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
).hexdigest()[:12]


@functools.cache  # of many kernels in one folder, the first says it for all
def _warn_once(message: str) -> None:
    log.warning(message)


class _CacheFiles(CompileResultCacheImpl):
    """What lies in a file of the cache: a hash and what it is of, for damaged instructions would crash the process."""

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return f"{super().get_filename_base(fullname, abiflags)}-{_FINGERPRINT}"

    def reduce(self, result: Any) -> tuple[bytes, bytes]:
        code = dumps(super().reduce(result))
        return hashlib.sha256(code).digest(), code

    def rebuild(self, context: Any, payload: tuple[bytes, bytes]) -> Any:
        digest, code = payload
        if hashlib.sha256(code).digest() != digest:
            raise ValueError("damaged")
        return super().rebuild(context, pickle.loads(code))


class _Cache(FunctionCache):
    """Numba's cache of a function in a folder; whatever is wrong with the folder costs time, not the run."""

    _impl_class = _CacheFiles

    def load_overload(self, signature: Any, context: Any) -> Any:
        try:
            return super().load_overload(signature, context)
        except Exception:  # reading what was cut off raises anything
            _warn_once(f"the kernels' cache in {self.cache_path} is damaged: what cannot be read is compiled anew")
            with suppress(OSError):
                for path in Path(self.cache_path).glob(f"{glob.escape(self._impl.filename_base)}.*"):
                    path.unlink(missing_ok=True)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        try:
            super().save_overload(signature, result)
        except Exception as error:
            _warn_once(
                f"the kernels' cache in {self.cache_path} cannot be written ({getattr(error, 'strerror', None) or error}): "
                "until it can, each run compiles them; make room, or set NUMBA_CACHE_DIR to another folder"
            )


def _cache_on_disk(compiled: Any, function: Callable) -> None:
    """Beside the source, or in the user's folder of caches where that cannot be written; NUMBA_CACHE_DIR goes first."""
    try:
        compiled._cache = _Cache(function)
    except (RuntimeError, OSError):
        _warn_once(
            f"no folder for compiled kernels can be written, neither {Path(__file__).parent / '__pycache__'} nor the "
            "user's own: each run compiles them; set NUMBA_CACHE_DIR to a folder that can be written"
        )


# Numba's 'workqueue' threads, the fallback where there is no OpenMP, abort the process if two Python threads use them
# at once; and two kernels at once would only share the same cores.
_ONE_AT_A_TIME = threading.Lock()

_start_pool = functools.cache(_launch_threads)  # once, before code that calls it is loaded


def _passes(state: Any) -> list[tuple[type, str]]:
    """Numba's, with branches pruned by values that are known when a kernel is compiled."""
    found = DefaultPassBuilder.define_nopython_pipeline(state).passes
    at = next(k for k, (step, _) in enumerate(found) if step is DeadBranchPrune)
    return [*found[:at], (FoldConstants, "fold constants"), *found[at:]]


class _Compiler(CompilerBase):
    def define_pipelines(self) -> list:
        return [_manager("nopython", _passes(self.state))]


def _manager(name: str, passes: list[tuple[type, str]]) -> PassManager:
    manager = PassManager(name)
    for step, description in passes:
        manager.add_pass(step, description)
    manager.finalize()
    return manager


def kernel(function: Callable, fastmath: set[str] = FASTMATH) -> Callable:
    """``function`` compiled for Python callers: without the GIL, cached on disk; it may use ``parallel_for``."""
    compiled = numba.njit(fastmath=fastmath, error_model="numpy", nogil=True, pipeline_class=_Compiler)(function)
    _cache_on_disk(compiled, function)

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


class _Announcer(event.Listener):
    """Says once what the first step waits for; nothing where the cache has every kernel."""

    def on_start(self, compiling: event.Event) -> None:
        if compiling.data["dispatcher"].py_func.__module__.startswith(__package__):
            _warn_once("compiling kernels for this processor: up to a minute, once")

    def on_end(self, compiling: event.Event) -> None:
        pass


event.register("numba:compile", _Announcer())
