"""A folder that one process writes into. Light to import: every command begins here."""

from __future__ import annotations

import errno
import logging
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

log = logging.getLogger("heatsplat")

LOCK_FILE = ".lock"
# What systems say of a disk that knows no locks, such as one of a cluster or of another machine.
WITHOUT_LOCKS = {errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL}


class OccupiedError(SceneError):
    """The folder belongs to another run, and nothing was changed in it."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes out of a run's folder. The system lets go of it when the process ends, however it does.

    Where the folder's disk knows no locks, a warning says that nobody is kept out.

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
        except OSError as error:
            if error.errno not in WITHOUT_LOCKS:
                file.seek(0)
                raise OccupiedError(
                    f"{folder} is the folder of a run that is under way ({file.read().strip() or 'of another process'}): wait "
                    "for it, stop it, or give another folder with hydra.run.dir"
                ) from None
            log.warning("the disk of %s has no locks (%s): no second process is kept out of it", folder, error.strerror)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield
