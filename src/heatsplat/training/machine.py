"""What a process has of its machine. Imports nothing heavy: the command line asks before it composes a configuration."""

from __future__ import annotations

import os


def cores() -> int:
    """CPU cores that this process may use: on a cluster those of the job, not those of the node."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
