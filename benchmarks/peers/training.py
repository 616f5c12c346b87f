"""Whole training by either program, timed alike, and what its PLY file is worth on the views that were held out."""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from benchmarks.peers.scenes import HELD_OUT, IMAGES, SharedScene
from heatsplat.contracts import SceneError
from heatsplat.geometry import spherical_harmonics
from heatsplat.io.command_lines import setting
from heatsplat.io.ply import read_splats, write_splats
from heatsplat.metrics.psnr import psnr
from heatsplat.renderers import rasterization
from heatsplat.runs.run import load
from heatsplat.splats import GEOMETRY
from heatsplat.training.checkpoints import load_checkpoint

# Of every run of heatsplat: what it trains on, and nothing beside training, as the other program does nothing else either.
ALONE = (
    "test=false", "trainer.limit_val_batches=0", "callbacks.checkpoint=null", "callbacks.progress.enabled=false",
    "callbacks.report.show=false", "data=colmap", "data.split=list",
)  # fmt: skip
SEES = {"thermal": (f"data.images={IMAGES}",), "rgb": ("data.images=null", f"data.rgb={IMAGES}")}
STEP = re.compile(r"Step (\d+):")  # what OpenSplat prints after each one


@dataclass(frozen=True)
class Trained:
    """A finished training.

    Args:
        ply: what it exported.
        training_s: seconds from its first step to its last.
        process_s: seconds of the whole process, which starts, reads the scene, trains and writes.
        blur: settings of ``rasterization`` by which its Gaussians cover pixels; none for those of 3DGS.
    """

    ply: Path
    training_s: float
    process_s: float
    blur: Mapping[str, Any] = field(default_factory=dict)


def train_heatsplat(
    train: str, scene: SharedScene, overrides: Sequence[str], steps: int, threads: int, folder: Path
) -> Trained:
    """A run of ``train`` (path of train.py) on a scene, in ``folder``.

    Raises:
        SceneError: it failed.
    """
    sees = SEES["rgb" if "thermal.modality=rgb" in overrides else scene.modality]
    places = {"data.root": scene.folder, "data.split_file": scene.folder / HELD_OUT, "hydra.run.dir": folder}
    place = [setting(key, value) for key, value in places.items()]
    command = [sys.executable, train, *ALONE, *sees, *place, f"max_steps={steps}", f"threads={threads}", *overrides]
    process_s = _run(command, threads, {}, lambda line: None)
    checkpoint = folder / "checkpoints" / "last.ckpt"
    clock = load_checkpoint(checkpoint)["callbacks"]["CostMeter"]["seconds"]
    module = load(checkpoint, output_dir=folder).module
    splats = {name: raw.detach() for name, raw in module.splats.raw.items()}
    write_splats(
        folder / "splats.ply",
        *(splats[name] for name in GEOMETRY),
        values=0.5 + spherical_harmonics.C0 * splats["sh0"][:, 0],
        sh_rest=splats.get("sh_rest"),
    )
    blur = {"eps2d": module.renderer.eps2d, "antialiased": module.renderer.antialiased}
    return Trained(folder / "splats.ply", sum(clock.values()), process_s, blur)


def train_opensplat(
    opensplat: str, scene: SharedScene, options: Sequence[str], steps: int, threads: int, folder: Path
) -> Trained:
    """A run of the executable ``opensplat`` on a scene, which writes into ``folder``.

    Raises:
        SceneError: it failed, or wrote no splats.
    """
    folder.mkdir(parents=True, exist_ok=True)
    ply = folder / "splats.ply"
    times: list[float] = []

    def look(line: str) -> None:
        if STEP.match(line):
            times.append(time.perf_counter())

    command = [opensplat, str(scene.peer_folder), "-o", str(ply), "-n", str(steps), "--cpu"]
    command += [option.replace("{steps}", str(steps)) for option in options]
    process_s = _run(command, threads, {"OMP_NUM_THREADS": str(threads)}, look)
    if not ply.is_file() or len(times) < 2:
        raise SceneError(
            f"{opensplat} trained {len(times)} steps and wrote {'a' if ply.is_file() else 'no'} file {ply}"
        )
    per_step = (times[-1] - times[0]) / (len(times) - 1)  # the first line comes after the first step
    return Trained(ply, times[-1] - times[0] + per_step, process_s)


def _run(command: Sequence[str], threads: int, environment: Mapping[str, str], look) -> float:
    """Seconds of a command on as many cores as threads; ``look`` sees each line that it prints, as it is printed.

    How threads of OpenMP wait is left to the program: what heatsplat sets for itself is taken out of its environment.

    Raises:
        SceneError: it cannot be started or fails, with its last lines.
    """
    own = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}
    env = {key: value for key, value in os.environ.items() if key not in own} | dict(environment)
    last: deque[str] = deque(maxlen=20)
    start = time.perf_counter()
    try:
        with _on_cores(threads):
            process = subprocess.Popen(
                command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
            )
    except OSError as error:
        raise SceneError(f"{command[0]} cannot be started: {error.strerror}") from error
    with process:
        for line in process.stdout:
            look(line)
            last.append(line)
    seconds = time.perf_counter() - start
    if process.returncode:
        raise SceneError(f"a run of the study failed:\n{' '.join(command)}\n{''.join(last)}")
    return seconds


@contextmanager
def _on_cores(count: int) -> Iterator[None]:
    """Processes that are started meanwhile have the first ``count`` cores; all, where the system cannot say which."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@torch.no_grad()
def score(done: Trained, scene: SharedScene) -> tuple[float, int]:
    """Mean PSNR in dB of what a training exported over the held-out views, and its number of Gaussians.

    heatsplat's renderer draws it, with the blur that it was trained with. Of a grey scene the mean of the three channels is
    scored.
    """
    found = {name: torch.from_numpy(array) for name, array in read_splats(done.ply).items()}
    shape = found["means"], found["quats"], found["log_scales"].exp(), found["opacity_logits"][:, 0].sigmoid()
    constant = (found["values"] - 0.5)[:, None] / spherical_harmonics.C0
    coefficients = torch.cat([constant, found["sh_rest"]], 1) if "sh_rest" in found else constant
    degree = round(coefficients.shape[1] ** 0.5) - 1
    scores = []
    for camera, image in zip(scene.cameras, scene.images, strict=True):
        directions = found["means"] - camera.center.float()
        colors = (0.5 + spherical_harmonics.evaluate(coefficients, directions, degree)).clamp(min=0)
        size = camera.width, camera.height
        seen = rasterization(*shape, colors, camera.viewmat, camera.K, *size, backend="cpu", depth=False, **done.blur)
        picture = seen.features.clamp(0, 1)
        if image.shape[-1] == 1:
            picture = picture.mean(-1, keepdim=True)
        scores.append(psnr(picture, image))
    return statistics.mean(scores), len(found["means"])
