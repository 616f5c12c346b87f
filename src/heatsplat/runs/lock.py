"""A folder that one process writes into. Light to import: every command begins here."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from heatsplat.errors import SceneError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_FILE = ".lock"


class OccupiedError(SceneError):
    """The folder belongs to another run, and nothing was changed in it."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes out of a run's folder. The system lets go of it when the process ends, however it does.

    Raises:
        OccupiedError: another process is in it, with its number.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    with open(folder / LOCK_FILE, "a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise OccupiedError(
                f"{folder} is the folder of a run that is under way ({file.read().strip() or 'of another process'}): wait for "
                "it, stop it, or give another folder with hydra.run.dir"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield
