"""pycolmap, the one place that loads it: OpenCV has to come first, and signals have to stay with who listens to them."""

from __future__ import annotations

import signal
from contextlib import suppress
from types import ModuleType

import cv2  # noqa: F401  first: pycolmap brings its own libpng symbols, and cv2 aborts on its first PNG if it comes after them


def _load() -> ModuleType:
    """pycolmap. Its log (glog) takes SIGTERM, as of ``kill``, and would end the process with a native trace: who listened before
    goes on doing so."""
    listener = signal.getsignal(signal.SIGTERM)
    import pycolmap

    with suppress(ValueError, TypeError):  # not in the main thread; a listener that is not of Python
        signal.signal(signal.SIGTERM, listener)
    return pycolmap


pycolmap = _load()
