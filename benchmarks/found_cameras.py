"""Cameras that prepare.py finds in a camera's files against the true ones, and what training makes of either.

Rules: the files are all that prepare.py gets, and its settings are the default ones unless a case says otherwise. Training gets
the same temperatures and points with either cameras; those of test views are found ones, too.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from statistics import fmean
from typing import Any

import numpy as np
import torch

from benchmarks.camera_folder import Field, flight, write_camera
from heatsplat.contracts import SceneError, check_option
from heatsplat.datamodules.formats.colmap import SparseModel, read_model, write_model
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.geometry.alignment import PoseErrors, pose_errors
from heatsplat.io.command_lines import setting
from heatsplat.io.files import write_atomically
from heatsplat.io.results import RunResults
from heatsplat.io.tables import markdown_table, number, over_seeds
from heatsplat.studies.child_runs import refuse_others, train_or_read
from heatsplat.studies.options import listed, non_empty, whole_numbers

TABLE_FILE, SPENT_FILE, CASE_FILE = "found_cameras.md", "spent.json", "case.json"
FLIGHT = "flight"  # a case's scene: the synthetic yard from a drone; others are presets

log = logging.getLogger("heatsplat")


@dataclass(frozen=True)
class Truth:
    """True cameras: stem of a frame's file -> world to camera [4, 4], and the lens of all."""

    viewmats: dict[str, np.ndarray]
    lens: Lens


def run(
    output_dir: Path | str,
    prepare: str,
    train: str,
    cases: Mapping[str, Mapping[str, Any]],
    overrides: Sequence[str] | None,
    threads: int | None = None,
    seeds: Sequence[int] = (0,),
) -> None:
    """Prepares every case, compares its cameras, trains it with both; writes found_cameras.md. What is done is not done again.

    Of several seeds the table has means and, of the scores, standard deviations.

    Args:
        output_dir: of the study; files, prepared scenes and runs lie in it.
        prepare, train: paths of prepare.py and train.py.
        cases: name -> a recording that is written as a camera would (scene, frames, width, height, and the rest of
            ``write_camera``'s Field), or files and the folder whose sparse/0 has their cameras (files, model); settings, search
            and train: further overrides of prepare.py, of its search for cameras alone, and of train.py.
        overrides: of train.py; None: nothing is trained.
        threads: CPU threads of training; None is all cores.
        seeds: of training; cameras are found once.

    Raises:
        SceneError: there is no case or seed or no such scene, prepare.py found no cameras, a run failed, or what is done was done
            with other settings.
    """
    output_dir, seeds = Path(output_dir), whole_numbers("study.seeds", seeds, least=0)
    overrides = None if overrides is None else listed(overrides)
    non_empty("study.cases", list(cases or {}))
    for name, case in cases.items():
        if "files" not in case:
            check_option(f"study.cases.{name}.scene", case.get("scene"), (FLIGHT, *PRESETS), SceneError)
    cameras, training = [], []
    for name, case in cases.items():
        place = output_dir / name
        files, truth = _given(case, place)
        settings = case.get("settings", ())
        spent = prepared(prepare, [f"source={files}", *settings, *case.get("search", ())], place / "found")
        found = read_model(place / "found")
        errors = compared(found, truth)
        cameras.append(_row(name, len(list((place / "found" / "images").glob("*.tiff"))), errors, spent))
        if overrides is None:
            continue
        write_truth(place / "model" / "sparse" / "0", truth, found, errors)
        prepared(
            prepare, [f"source={files}", "poses=given", f"poses.model={place / 'model'}", *settings], place / "true"
        )
        lines = [*overrides, *case.get("train", ()), "data=colmap", f"threads={'null' if threads is None else threads}"]
        for kind in ("found", "true"):
            runs = [
                train_or_read(
                    place / f"trained_{kind}_{seed}",
                    train,
                    [*lines, f"seed={seed}", setting("data.root", place / kind)],
                    output_dir,
                )
                for seed in seeds
            ]
            training.append([name, kind, *_scores(runs)])
    text = markdown_table(["scene", "found", "angle", "place", "s", "MiB"], cameras)
    if training:
        head = ["scene", "cameras", "PSNR, dB", "MAE, °C", "Gaussians", "processor s"]
        text += ["", *markdown_table(head, training)]
    write_atomically(output_dir / TABLE_FILE, "\n".join(text) + "\n")
    log.info("\n%s", "\n".join(text))


def compared(found: SparseModel, truth: Truth) -> PoseErrors:
    """Errors of the cameras that were found, by the similarity that fits best. Raises SceneError where frames are unknown."""
    stems = [PurePath(name).stem for name in found.names]
    if unknown := sorted(set(stems) - set(truth.viewmats)):
        raise SceneError(f"the true cameras lack {len(unknown)} of the frames that were found, such as {unknown[0]}")
    true = np.stack([truth.viewmats[stem] for stem in stems])
    return pose_errors(torch.from_numpy(np.stack(found.viewmats)), torch.from_numpy(true))


def write_truth(folder: Path, truth: Truth, found: SparseModel, errors: PoseErrors) -> None:
    """A COLMAP model of the true cameras of the frames that were found, with the points that were found in their world."""
    stems = [PurePath(name).stem for name in found.names]
    lens = truth.lens
    if lens.is_distorted:
        raise SceneError("the true cameras of a case have to be pinholes")
    kind = ("PINHOLE", (lens.fx, lens.fy, lens.cx, lens.cy), lens.width, lens.height)
    points = errors.similarity(torch.from_numpy(found.points)).numpy()
    colors = (255.0 * found.colors).round().astype(np.uint8)
    write_model(folder, {f"{stem}.tiff": truth.viewmats[stem] for stem in stems}, [kind], points, colors)


def prepared(prepare: str, settings: Sequence[str], target: Path) -> dict[str, float]:
    """Makes a scene, and returns the seconds of processor cores and the MiB at most that the command took.

    Raises:
        OtherSettingsError: the scene is there, of other settings.
        SceneError: it failed.
    """
    note = target / SPENT_FILE
    if note.is_file():
        spent = json.loads(note.read_text())
        refuse_others(target, spent.pop("settings", ()), settings)
        return spent
    log.info("preparing %s", target)
    command = [sys.executable, prepare, *settings, f"target={target}"]
    target.mkdir(parents=True, exist_ok=True)
    with (target.parent / f"{target.name}.log").open("w+") as said:
        process, most = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT), 0.0
        try:
            while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
                most = max(most, _peak_mib(process.pid))
                time.sleep(0.05)
        except BaseException:  # the study is stopped, and what it started with it
            process.terminate()
            process.wait()
            raise
        _, status, usage = ended  # whose largest size would be at least that of this process
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            said.seek(0)
            raise SceneError(f"{' '.join(command)}\nfailed:\n{said.read()[-2000:]}")
    spent = {"cpu_s": usage.ru_utime + usage.ru_stime, "mib": most}
    write_atomically(note, json.dumps({"settings": list(settings), **spent}))
    return spent


def _peak_mib(process: int) -> float:
    """The most memory that a process has had so far (Linux); 0 where it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def _given(case: Mapping[str, Any], place: Path) -> tuple[Path, Truth]:
    """Folder of a case's files, and their true cameras."""
    case = {key: value for key, value in case.items() if key not in ("settings", "search", "train")}
    if "files" in case:
        model = read_model(Path(case["model"]))
        stems = [PurePath(name).stem for name in model.names]
        return Path(case["files"]), Truth(dict(zip(stems, model.viewmats, strict=True)), model.lenses[0])
    field = dict(case)
    scene = field.pop("scene")
    size = Size(field.pop("width"), field.pop("height"), field.pop("frames"), points=16)
    recording = flight(size) if scene == FLIGHT else film(Scene(PRESETS[scene]), size)
    files, made_from = place / "files", [f"{key}={value}" for key, value in case.items()]
    if files.is_dir():
        note = files / CASE_FILE
        refuse_others(files, json.loads(note.read_text()) if note.exists() else (), made_from)
    else:
        fresh = place / "files.part"
        write_camera(recording, fresh, Field(**field))
        write_atomically(fresh / CASE_FILE, json.dumps(made_from))
        fresh.rename(files)
    names = [f"frame_{frame:04d}_T" for frame in range(size.frames)]
    return files / "thermal", Truth(dict(zip(names, recording.viewmats, strict=True)), recording.lens)


def _row(name: str, frames: int, errors: PoseErrors, spent: Mapping[str, float]) -> list[str]:
    def told(values: torch.Tensor, unit: str) -> str:
        return f"{float(values.median()):.2f}{unit} ({float(values.max()):.2f}{unit})"

    found = f"{len(errors.degrees)} of {frames}"
    return [
        name,
        found,
        told(errors.degrees, "°"),
        told(errors.percent, " %"),
        f"{spent['cpu_s']:.0f}",
        f"{spent['mib']:.0f}",
    ]


def _scores(runs: Sequence[RunResults]) -> list[str]:
    return [
        over_seeds([run.test["psnr"] for run in runs], 1),
        over_seeds([run.test["mae_c"] for run in runs], 3),
        number(fmean(run.cost["gaussians"] for run in runs), 0),
        number(fmean(run.cost["cpu_seconds"] for run in runs), 0),
    ]
