"""On which device a run trains."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch

from heatsplat.contracts import SceneError, check_option
from heatsplat.renderers import gsplat

ACCELERATORS = ("auto", "cpu", "gpu", "cuda")

log = logging.getLogger("heatsplat")


def device_of(accelerator: str, renderer: Mapping[str, Any]) -> str:
    """Where a run trains, or a checkpoint is evaluated: "cpu" or "cuda".

    "auto" is CUDA where PyTorch sees a device that the renderer can use, which gsplat's needs to be installed for; else the CPU,
    and where there is a device, a warning says why it is left alone.

    Args:
        accelerator: what was asked for, one of ACCELERATORS; "gpu" and "cuda" are the same.
        renderer: settings of the renderer; one without a backend is plain torch, on any device.

    Raises:
        SceneError: the accelerator is unknown; or CUDA was asked for, and PyTorch sees no device, or the renderer cannot use it.
        ImportError: CUDA was asked for, and the renderer lacks gsplat or its compiled kernels.
    """
    check_option("accelerator", accelerator, ACCELERATORS, SceneError)
    backend = renderer.get("backend")
    if accelerator in ("gpu", "cuda"):
        if not torch.cuda.is_available():
            raise SceneError(
                f"trainer.accelerator={accelerator}: PyTorch sees no CUDA device here; leave it out for the CPU"
            )
        if backend == "cpu":
            raise SceneError(
                f"renderer=cpu renders on the CPU only; leave out renderer or trainer.accelerator={accelerator}"
            )
        if backend in ("auto", "gsplat"):
            gsplat.load()
        return "cuda"
    on_cuda = accelerator == "auto" and torch.cuda.is_available() and backend != "cpu"
    if backend == "gsplat":
        if not on_cuda:
            raise SceneError("renderer=gsplat renders on CUDA only; leave it out for the CPU")
        gsplat.load()
    if on_cuda and backend == "auto" and (reason := gsplat.why_not()) is not None:
        _warn(reason)
        return "cpu"
    return "cuda" if on_cuda else "cpu"


@lru_cache(maxsize=1)
def _warn(reason: str) -> None:
    log.warning("PyTorch sees a CUDA device, but this runs on the CPU: %s", reason)
