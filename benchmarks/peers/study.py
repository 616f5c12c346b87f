"""heatsplat beside OpenSplat in one run: rasterisers in turns, and whole training in turns to equal PSNR.

Rules: both train on the same pictures, cameras and points, and both are scored by the same code from the PLY files that
they export. Runs of the two programs alternate, each with as many cores as threads. A run is whole: its schedules are as
long as it is.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from benchmarks.peers import rasterisers
from benchmarks.peers.report import TABLE_FILE, Row, equal_psnr, write
from benchmarks.peers.scenes import SharedScene, shared
from benchmarks.peers.training import score, train_heatsplat, train_opensplat
from benchmarks.renderer.peers import from_path
from heatsplat.contracts import SceneError, check_count
from heatsplat.studies.options import whole_numbers

log = logging.getLogger("heatsplat")


def run(
    output_dir: Path | str,
    train: str,
    scenes: Mapping[str, Any],
    opensplat: str | None,
    theirs: Mapping[str, Mapping[str, Any]],
    ours: Mapping[str, Mapping[str, Sequence[str]]],
    steps: Sequence[int],
    threads: Sequence[int],
    rasteriser: Mapping[str, str],
    cases: Sequence[Sequence[int]],
    agreement: Sequence[int],
    rounds: int,
) -> dict[str, list[Row]]:
    """Rows by table, which are also written as CSV and Markdown into ``output_dir``.

    Args:
        output_dir: of the study; scenes and runs lie in it.
        train: path of train.py.
        scenes: name -> data module, whose views both programs get as 8-bit pictures; None leaves one out.
        opensplat: path of its executable, or None to leave whole training out.
        theirs: name of a recipe -> ``steps``, the lengths of its runs, and ``options``, what its command line says beside
            scene, output and number of steps; "{steps}" in an option stands for that number.
        ours: modality of a scene -> name of a recipe -> what the command line of heatsplat says.
        steps: lengths of the runs of heatsplat.
        threads: numbers of threads; both programs have as many, and as many cores.
        rasteriser: name -> "module:function" of built renderers, with the arguments of ``rasterization`` up to the height,
            returning the image, and using as many threads as torch.
        cases: [N, width, height] of made-up scenes on which they are timed beside the scenes' points.
        agreement: [N, width, height] of the made-up scene on which their gradients are compared with float64.
        rounds: of the rasterisers, in turns.

    Raises:
        SceneError: there is nothing to compare with, an option cannot be used as it is, or a run failed.
    """
    if opensplat is None and not rasteriser:
        raise SceneError(
            "nothing to compare with: give study.opensplat=/path/to/its/executable, or a renderer with "
            "+study.rasteriser.NAME=module:function, or both"
        )
    if opensplat is not None and shutil.which(opensplat) is None:
        raise SceneError(f"study.opensplat={opensplat} is no program: give the path of its executable")
    check_count("study.rounds", rounds)
    steps, threads = whole_numbers("study.steps", steps), whole_numbers("study.threads", threads)
    renderers = {name: from_path(path) for name, path in rasteriser.items()}
    output_dir = Path(output_dir).resolve()
    begin, load = time.perf_counter(), os.getloadavg()[0]
    written = {
        name: shared(data.scene, output_dir / "scenes" / name) for name, data in scenes.items() if data is not None
    }
    tables: dict[str, list[Row]] = {}

    def write_all() -> None:
        seconds = time.perf_counter() - begin
        write(tables, output_dir, f"The machine's load was {load:.1f}; the study took {seconds:.0f} s.")

    if rasteriser:
        drawn = {name: partial(rasterisers.of_points, scene) for name, scene in written.items()}
        drawn |= {f"made up, {case[0]:,}": rasterisers.made_up(case) for case in cases}
        tables["agreement"] = rasterisers.agreement(rasterisers.made_up(agreement)(3), renderers)
        tables["rasterisers"] = rasterisers.timings(drawn, renderers, threads, rounds)
        write_all()
    if opensplat is not None:
        _compile_kernels(train, written, ours, output_dir / "runs" / "first")
        tables["runs"] = []
        for count in threads:
            for name, scene in written.items():
                folder = output_dir / "runs" / name / f"{count}_threads"
                tables["runs"] += [
                    {"scene": name} | row
                    for row in _trainings(train, opensplat, scene, theirs, ours[scene.modality], steps, count, folder)
                ]
                tables["equal"] = equal_psnr(tables["runs"])
                write_all()
    log.info("the study took %.0f s: %s", time.perf_counter() - begin, output_dir / TABLE_FILE)
    return tables


def _compile_kernels(
    train: str, scenes: Mapping[str, SharedScene], ours: Mapping[str, Mapping[str, Sequence[str]]], folder: Path
) -> None:
    """A short run of each recipe, so that no run that counts waits for the compiler."""
    recipes = {name: (scene, recipe) for scene in scenes.values() for name, recipe in ours[scene.modality].items()}
    for name, (scene, recipe) in recipes.items():
        train_heatsplat(train, scene, recipe, 2, 1, folder / name)


def _trainings(
    train: str,
    opensplat: str,
    scene: SharedScene,
    theirs: Mapping[str, Mapping[str, Any]],
    ours: Mapping[str, Sequence[str]],
    steps: Sequence[int],
    threads: int,
    folder: Path,
) -> list[Row]:
    """Runs of both programs on a scene in turns."""
    programs = {
        name: (recipe["steps"], partial(train_opensplat, opensplat, scene, recipe["options"]))
        for name, recipe in theirs.items()
    }
    programs |= {name: (steps, partial(train_heatsplat, train, scene, recipe)) for name, recipe in ours.items()}
    turns = zip_longest(*([(name, one, count) for count in counts] for name, (counts, one) in programs.items()))
    rows = []
    for name, train_one, count in filter(None, chain.from_iterable(turns)):
        load = os.getloadavg()[0]
        done = train_one(count, threads, folder / re.sub(r"\W+", "_", f"{name}_{count}"))
        found, gaussians = score(done, scene)
        log.info("%s, %d steps, %d thread(s): %.2f dB in %.1f s", name, count, threads, found, done.training_s)
        row = {"threads": threads, "program": name, "peer": name in theirs, "steps": count, "gaussians": gaussians}
        rows.append(row | {"psnr": found, "training_s": done.training_s, "process_s": done.process_s, "load": load})
    return rows
