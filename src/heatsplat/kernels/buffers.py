"""Arrays that outlive a call, so that a training step allocates nothing that it could keep."""

from __future__ import annotations

import math

import numpy as np

LINE = 64  # bytes of a cache line, and of the widest vector: one that straddles two lines is loaded twice


def aligned(dtype: type, *shape: int) -> np.ndarray:
    """An uninitialised array that begins at a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.empty(size + LINE, np.uint8)
    skip = -raw.ctypes.data % LINE
    return raw[skip : skip + size].view(dtype).reshape(shape)


class Buffers:
    """Arrays by name that grow when they must and are used again otherwise."""

    _idle: list[Buffers] = []

    def __init__(self) -> None:
        self._flat: dict[str, np.ndarray] = {}

    @classmethod
    def lend(cls) -> Buffers:
        """Buffers that nobody else uses, until ``give_back``."""
        return cls._idle.pop() if cls._idle else cls()

    def give_back(self) -> None:
        self._idle.append(self)

    def array(self, name: str, dtype: type, *shape: int) -> np.ndarray:
        """An array with arbitrary content; what was written under this name before is lost."""
        size = math.prod(shape)
        flat = self._flat.get(name)
        if flat is None or flat.size < size:
            # A quarter to grow, and sixteen for loads of whole vectors at the end.
            flat = self._flat[name] = aligned(dtype, size + size // 4 + 16)
        return flat[:size].reshape(shape)
