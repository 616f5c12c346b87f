"""What runs beside each other cost: the same training alone and side by side on the same cores."""

from __future__ import annotations

import logging
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from heatsplat.contracts import SceneError, check_count
from heatsplat.io.command_lines import setting
from heatsplat.io.files import write_atomically
from heatsplat.io.tables import markdown_table

TABLE_FILE = "company.md"

log = logging.getLogger("heatsplat")


def run(
    output_dir: Path | str,
    train: str,
    overrides: Sequence[str],
    together: int = 2,
    rounds: int = 3,
    limit: float = 2.2,
    threads: int | None = None,
) -> None:
    """Times runs alone and side by side in turns, writes company.md and logs the ratio.

    Args:
        output_dir: of the study; the runs lie in it.
        train: path of train.py.
        overrides: what the command line of a run says.
        together: how many run side by side.
        rounds: of each; the first run of all compiles kernels and is not counted.
        limit: how many times as long as alone runs may take side by side.
        threads: CPU threads of a run; None is all cores.

    Raises:
        SceneError: a number counts nothing, the folder holds runs, a run failed, or runs side by side take longer than the
            limit.
    """
    check_count("study.rounds", rounds)
    check_count("study.together", together)
    output_dir = Path(output_dir)
    if (output_dir / "first").exists():
        raise SceneError(
            f"{output_dir} holds runs, and a finished one is not run again: give a new folder with hydra.run.dir"
        )
    command = [sys.executable, train, *overrides, f"threads={'null' if threads is None else threads}"]
    seconds_of(command, [output_dir / "first"])
    alone, beside = [], []
    for k in range(rounds):
        alone.append(seconds_of(command, [output_dir / f"alone_{k}"]))
        beside.append(seconds_of(command, [output_dir / f"beside_{k}_{j}" for j in range(together)]))
    ratio = statistics.median(beside) / statistics.median(alone)
    rows = [("alone", alone), (f"{together} side by side", beside)]
    lines = markdown_table(
        ["runs", "seconds until the last one ends"],
        [(name, ", ".join(f"{seconds:.1f}" for seconds in found)) for name, found in rows],
    )
    write_atomically(
        output_dir / TABLE_FILE, "\n".join(lines) + f"\n\nSide by side they take {ratio:.2f} times as long.\n"
    )
    log.info("%d side by side take %.2f times as long as one alone (at most %.2f)", together, ratio, limit)
    if ratio > limit:
        raise SceneError(
            f"{together} runs side by side take {ratio:.2f} times as long as one alone, more than {limit:g} times. Does "
            "anything else run on this machine, or OMP_WAIT_POLICY=ACTIVE?"
        )


def seconds_of(command: Sequence[str], folders: Sequence[Path]) -> float:
    """Seconds from the start of runs, one in each folder, until the last one ends."""
    start = time.perf_counter()
    with_folders = [[*command, setting("hydra.run.dir", folder)] for folder in folders]
    processes = [
        subprocess.Popen(each, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) for each in with_folders
    ]
    try:
        for process in processes:
            _, errors = process.communicate()
            if process.returncode:
                raise SceneError(f"a run of the study failed:\n{' '.join(process.args)}\n{errors[-2000:]}")
    finally:
        for process in processes:  # those that go on where one failed or the study is stopped
            process.terminate()
    return time.perf_counter() - start
