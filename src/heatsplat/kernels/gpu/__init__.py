"""Kernels for CUDA, in Triton, which comes with torch's CUDA builds; without it, or a C compiler, plain torch does their work.

A training step of plain torch is some seven hundred launches of a few microseconds each, which no faster device shortens.
"""

from __future__ import annotations

import os
import shutil
from functools import lru_cache
from importlib.util import find_spec


@lru_cache(maxsize=1)
def available() -> bool:
    """Whether the kernels can be compiled: Triton is installed, and the C compiler that it calls when it first runs."""
    compilers = (os.environ.get("CC", ""), "gcc", "clang", "cc")
    return find_spec("triton") is not None and any(map(shutil.which, filter(None, compilers)))
