"""How the kernels are compiled: one decorator, one cache rule, and a line of progress while somebody waits for it."""

from __future__ import annotations

import functools
import hashlib
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import NativeLowering
from numba.np.ufunc.parallel import _launch_threads

log = logging.getLogger(__name__)

# Contraction gives fused multiply-adds. Reassociation is left out because it folds the rounding trick of simd.exp2 to
# nothing (measured: the image is wrong by 0.21), 'nnan' because comparisons with NaN must stay false: they cull.
FASTMATH = {"contract", "nsz", "arcp"}

# Numba's cache looks only at the file of the function itself; with this in the names of its files it also notices
# changed helpers in other files, and never unpickles types of another version of this package.
_FINGERPRINT = hashlib.sha256(
    b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
).hexdigest()[:12]


class _CacheFiles(CompileResultCacheImpl):
    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        return f"{super().get_filename_base(fullname, abiflags)}-{_FINGERPRINT}"


class _Cache(FunctionCache):
    _impl_class = _CacheFiles


# Numba's 'workqueue' threads, the fallback where there is no OpenMP, abort the process if two Python threads use them
# at once; and two kernels at once would only share the same cores.
_ONE_AT_A_TIME = threading.Lock()


def kernel(function: Callable) -> Callable:
    """``function`` compiled for Python callers: without the GIL, cached on disk; it may use ``parallel_for``."""
    compiled = numba.njit(fastmath=FASTMATH, error_model="numpy", nogil=True)(function)
    compiled._cache = _Cache(function)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        with _ONE_AT_A_TIME:
            _launch_threads()  # before code that calls them is loaded; does nothing the second time
            return compiled(*arguments)

    call.compiled = compiled
    return call


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
        manager = PassManager("to link")
        for step, description in DefaultPassBuilder.define_nopython_pipeline(self.state).passes:
            manager.add_pass(_LowerToLink if step is NativeLowering else step, description)
        manager.finalize()
        return [manager]


def inline(function: Callable) -> Callable:
    """``function`` compiled into the kernels that call it."""
    options = {"fastmath": FASTMATH, "error_model": "numpy", "forceinline": True}
    return numba.njit(pipeline_class=_CompilerToLink, **options)(function)


def part(function: Callable) -> Callable:
    """``function`` as a piece of the one kernel that calls it, which compiles faster than a function of its own."""
    return numba.njit(fastmath=FASTMATH, error_model="numpy", inline="always")(function)


class _Announcer(event.Listener):
    def __init__(self, message: str) -> None:
        self.message, self.said = message, False

    def on_start(self, _: event.Event) -> None:
        if not self.said:
            log.warning(self.message)
            self.said = True

    def on_end(self, _: event.Event) -> None:
        pass


@contextmanager
def announced(message: str) -> Iterator[None]:
    """A context that logs ``message`` once if anything has to be compiled inside it (not when the cache has it)."""
    with event.install_listener("numba:compile", _Announcer(message)):
        yield
