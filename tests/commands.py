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
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "src"
OURS = ("heatsplat", "hydra_plugins")
FILMS = "HEATSPLAT_TESTS_FILMS"  # a folder of recordings that commands share with the tests
LIBRARIES = (
    "loaded_libraries",
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
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder, "printed")
        variables = {**os.environ, **(environment or {})}
        code = _forked(timeout, _run, [*map(str, arguments)], str(cwd), variables, str(printed))
        return Done(code, printed.read_text(errors="replace"))


def in_turn(commands: Sequence[Sequence[str]], cwd: Path = ROOT, timeout: float = 600) -> list[Done]:
    """Scripts of one folder, one after the other in one process: heatsplat is loaded once, and a scene filmed once.

    Of commands that are not reached, ``returncode`` is None.
    """
    with tempfile.TemporaryDirectory() as folder:
        _forked(
            timeout, _run_in_turn, [[*map(str, arguments)] for arguments in commands], str(cwd), {**os.environ}, folder
        )
        return [_ended(Path(folder, f"{number}")) for number in range(len(commands))]


def succeeds(arguments: Sequence[str], cwd: Path = ROOT, code: int = 0, **environment: str) -> str:
    """What ``python SCRIPT ARGUMENTS`` prints; checks its exit code."""
    done = python(arguments, cwd, environment)
    assert done.returncode == code, done.output
    return done.output


def forking() -> multiprocessing.context.ForkServerContext:
    """Starts processes as forks of the server, which runs from here on."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(LIBRARIES))
    places = os.pathsep.join([str(SOURCES), str(ROOT / "tests")])  # of this checkout, wherever another is installed
    with mock.patch.dict(os.environ, PYTHONPATH=places):
        forkserver.ensure_running()
    return context


def _forked(timeout: float, target: Callable, *arguments: Any) -> int | None:
    """The exit code of a fork that runs ``target``; None where it is killed after ``timeout`` seconds."""
    process = forking().Process(target=target, args=arguments)
    process.start()
    process.join(timeout)
    if process.is_alive():
        process.kill()
        process.join()
        return None
    return process.exitcode


def _ended(printed: Path) -> Done:
    code = printed.with_suffix(".code")
    shown = printed.read_text(errors="replace") if printed.exists() else ""
    return Done(int(code.read_text()) if code.exists() else None, shown)


def _run(arguments: list[str], cwd: str, variables: dict[str, str], printed: str) -> None:
    """The command, in the fork."""
    _print_to(printed)
    _as_a_shell_does(arguments[0], cwd, variables)
    sys.argv = arguments
    runpy.run_path(arguments[0], run_name="__main__")


def _run_in_turn(commands: list[list[str]], cwd: str, variables: dict[str, str], folder: str) -> None:
    """The commands, in the fork; each leaves a file of what it printed and one of its exit code."""
    _as_a_shell_does(commands[0][0], cwd, variables)
    sys.path.insert(0, str(Path(commands[0][0]).resolve().parent))
    from running import filming_once

    from heatsplat.datamodules.synthetic import Synthetic

    Synthetic.load = filming_once(Synthetic.load, Path(folder))
    for number, arguments in enumerate(commands):
        _print_to(f"{folder}/{number}")
        sys.argv, code = arguments, 0
        try:
            runpy.run_path(arguments[0], run_name="__main__")
        except SystemExit as ended:
            code = ended.code or 0
        except Exception:
            code = traceback.format_exc()
        if isinstance(code, str):
            print(code, file=sys.stderr)
            code = 1
        sys.stdout.flush()
        Path(folder, f"{number}.code").write_text(str(code))


def _as_a_shell_does(script: str, cwd: str, variables: dict[str, str]) -> None:
    """Folder and variables of the fork are set, and a script of another folder finds its own heatsplat."""
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(variables)
    gc.freeze()  # what the server loaded is not looked through again
    if Path(script).resolve().parent != SOURCES:
        sys.modules["loaded_libraries"].COMPOSING.close()
        for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
            del sys.modules[name]
    elif FILMS in variables:
        from running import recording_once

        from heatsplat.datamodules import synthetic

        synthetic.film = recording_once(synthetic.film, Path(variables[FILMS]))


def _print_to(path: str) -> None:
    """Both streams of this process go into a file from here on."""
    sys.stdout.flush()
    stream = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for number in (1, 2):
        os.dup2(stream, number)
    os.close(stream)
