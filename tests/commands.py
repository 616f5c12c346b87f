"""The scripts as a user types them, each in a process of its own.

Loading torch, Lightning, heatsplat and their like takes longer than what a test asks of a script. A server loads them once; a
command then starts as a fork of it and runs the script's file as ``__main__``. A script of another folder, such as a copy of the
repository, loads its own heatsplat.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import runpy
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src"
OURS = ("heatsplat", "hydra_plugins")
LIBRARIES = (
    "torch", "pytorch_lightning", "torchmetrics", "torch.utils.tensorboard", "kornia", "numba", "cv2", "skimage.metrics",
    "scipy.stats", "scipy.spatial", "matplotlib.figure", "hydra", "rich.progress", "pvlib",
    "heatsplat.cli", "heatsplat.runs.run", "heatsplat.datamodules.synthetic",
    *(f"heatsplat.callbacks.{file.stem}" for file in sorted((SOURCES / "heatsplat/callbacks").glob("[a-z]*.py"))),
)  # fmt: skip


@dataclass(frozen=True)
class Done:
    """A command that has ended: its exit code, and what it printed on either stream."""

    returncode: int | None
    output: str


def python(
    arguments: Sequence[str], cwd: Path = ROOT, environment: Mapping[str, str] | None = None, timeout: float = 600
) -> Done:
    """``python SCRIPT ARGUMENTS``, ended; ``returncode`` is None where it took longer than ``timeout`` seconds.

    Args:
        arguments: the script and what follows it.
        cwd: where it runs.
        environment: variables beside those of this process. OpenMP reads its own when the server starts.
        timeout: seconds after which it is killed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(LIBRARIES))
    with mock.patch.dict(os.environ, PYTHONPATH=str(SOURCES)):  # of this checkout, wherever another is installed
        forkserver.ensure_running()
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder, "printed")
        variables = {**os.environ, **(environment or {})}
        process = context.Process(target=_run, args=([*map(str, arguments)], str(cwd), variables, str(printed)))
        process.start()
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
            return Done(None, printed.read_text(errors="replace"))
        return Done(process.exitcode, printed.read_text(errors="replace"))


def succeeds(arguments: Sequence[str], cwd: Path = ROOT, code: int = 0, **environment: str) -> str:
    """What ``python SCRIPT ARGUMENTS`` prints; checks its exit code."""
    done = python(arguments, cwd, environment)
    assert done.returncode == code, done.output
    return done.output


def _run(arguments: list[str], cwd: str, variables: dict[str, str], printed: str) -> None:
    """The command, in the fork: streams, folder, variables and arguments are set as a shell does."""
    stream = os.open(printed, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(stream, number)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(variables)
    sys.argv = arguments
    gc.freeze()  # what the server loaded is not looked through again
    if Path(arguments[0]).resolve().parent != SOURCES:
        for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
            del sys.modules[name]
    runpy.run_path(arguments[0], run_name="__main__")
