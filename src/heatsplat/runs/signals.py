"""What a batch system says to a job whose time is over."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stoppable() -> Iterator[None]:
    """While it lasts, SIGTERM and SIGUSR2 stop a job as Ctrl-C does: after its step, with a checkpoint.

    So a batch system says that the time of a job is over. Whoever listened before hears of it once the job has stopped:
    submitit, which puts the job back into the queue.
    """
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        if asked:
            return
        asked.append(number)
        interrupt = signal.getsignal(signal.SIGINT)
        if not callable(interrupt):  # a shell's background jobs ignore Ctrl-C, but not this
            raise KeyboardInterrupt
        interrupt(signal.SIGINT, frame)

    try:
        before = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGUSR2)}
    except (ValueError, AttributeError):  # not in the main thread, or on Windows
        yield
        return
    try:
        yield
    except (SystemExit, KeyboardInterrupt):
        listener = before[asked[0]] if asked else None
        if callable(listener):
            listener(asked[0], None)
        raise
    finally:
        for number, listener in before.items():
            signal.signal(number, listener)
