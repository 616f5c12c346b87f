"""Test processes side by side (pytest -n) share the cores: each, and what it starts, takes its part of them."""

import os

from heatsplat.training.machine import cores

WORKERS = os.environ.get("PYTEST_XDIST_WORKER_COUNT")
if WORKERS:  # before torch is imported, which reads it once
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores() // int(WORKERS))))
