"""What runs in the process of a mutant, whose server imports this first, with libraries that mutants need and none changes."""

from __future__ import annotations

import contextlib
import importlib.abc
import importlib.machinery
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from heatsplat.training.machine import loading

with loading():
    import hydra  # noqa: F401
    import hypothesis  # noqa: F401
    import kornia  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import mpmath  # noqa: F401
    import numba  # noqa: F401
    import pandas  # noqa: F401
    import pytest
    import scipy.spatial  # noqa: F401
    import scipy.stats  # noqa: F401
    import skimage.metrics  # noqa: F401
    import torch.distributed.tensor  # noqa: F401 - torch.testing asks for it

ROOT = Path(__file__).resolve().parents[1]


def first_failure(module: str, source: str, tests: Sequence[str]) -> str | None:
    """The first test that fails, or None, when ``module`` has another ``source``; this process is of no other use afterwards.

    Args:
        module: dotted name, from heatsplat on.
        source: its text.
        tests: files and options as pytest takes them, from the repository's root.

    Raises:
        ValueError: they cannot be run.
    """
    torch.set_num_threads(1)
    sys.meta_path.insert(0, _Finder(module, source))
    for name in [name for name in sys.modules if name.split(".")[0] == "heatsplat"]:
        del sys.modules[name]
    recorder = _Recorder()
    with contextlib.ExitStack() as stack:
        for stream in (contextlib.redirect_stdout, contextlib.redirect_stderr):
            stack.enter_context(stream(io.StringIO()))
        if module.startswith("heatsplat.kernels."):
            # Compiled code is kept by the content of files, which does not change: neither may take the other's.
            os.environ["NUMBA_CACHE_DIR"] = stack.enter_context(tempfile.TemporaryDirectory())
        options = ["-x", "-q", "-p", "no:cacheprovider", f"--rootdir={ROOT}", "-c", str(ROOT / "pyproject.toml")]
        code = pytest.main([*(str(ROOT / w) if w.startswith("tests/") else w for w in tests), *options], [recorder])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise ValueError(f"{code}: {' '.join(tests)}")
    return recorder.failed


class _Recorder:
    """Remembers the first test that failed."""

    failed: str | None = None

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed and self.failed is None:
            self.failed = report.nodeid


class _Finder(importlib.abc.MetaPathFinder):
    """Finds one module as usual and loads another source for it, past all caches of bytecode."""

    def __init__(self, name: str, source: str) -> None:
        self.name, self.source = name, source

    def find_spec(self, name: str, path=None, target=None):
        if name != self.name:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        spec.loader = _Loader(name, spec.origin, self.source)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    def __init__(self, name: str, path: str, source: str) -> None:
        super().__init__(name, path)
        self.mutated = source

    def get_code(self, fullname: str):
        return compile(self.mutated, self.path, "exec", dont_inherit=True)
