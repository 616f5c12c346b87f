"""Files that heatsplat writes and reads again, damaged by chance: they load with sane content or are refused by name.

``python tests/fuzz/files.py SECONDS [KIND NUMBER]``, with a number to repeat one; ``make fuzz`` runs it, too.
"""

from __future__ import annotations

import logging
import os
import random
import sys
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from mutate import VALUES, Outcome, campaign, damaged, damaged_copy, guarded, other_bytes
from running import TINY

from heatsplat import composition
from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.io.ply import read_splats, write_splats
from heatsplat.io.results import RunResults
from heatsplat.runs import run
from heatsplat.studies import finished
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.machine import prepare_machine

QUIET = ("test=false", "callbacks.progress.enabled=false", "threads=1")


def write_templates(root: Path) -> None:
    """One file of each kind: root/checkpoint/last.ckpt, splats.ply, and root/run, a finished run's folder."""
    config = composition.compose([*TINY, *QUIET, "method=etgs", "max_steps=2", "data.downscale=4"])
    run.train(config | {"logger": None}, root / "trained")
    os.rename(root / "trained" / "checkpoints", root / "checkpoint")
    raw = {name[11:]: tensor for name, tensor in last(root)["state_dict"].items() if name.startswith("splats.raw.")}
    shape = {name: raw[name] for name in ("means", "log_scales", "quats", "opacity_logits")}
    write_splats(root / "ply" / "splats.ply", **shape, values=torch.full((len(raw["means"]), 1), 0.5))
    results = RunResults(run={"scene": "s", "method": "m"})
    results.put("test", "psnr", 30.0)
    results.write(root / "run" / "metrics.json")
    (root / "run" / ".hydra").mkdir()
    (root / "run" / ".hydra" / "overrides.yaml").write_text("- method=etgs\n- data.scene=cooling\n- seed=0\n")
    (root / "run" / ".hydra" / "config.yaml").write_text("name: etgs\ndata:\n  scene: cooling\n  root: null\nseed: 0\n")


def last(root: Path) -> dict[str, Any]:
    return load_checkpoint(root / "checkpoint" / "last.ckpt")


def bytes_of_checkpoint(root: Path, place: Path, rng: random.Random) -> str:
    """Damage to the bytes: whatever loads is what was written."""
    path = place / "last.ckpt"
    path.write_bytes(other_bytes((root / "checkpoint" / "last.ckpt").read_bytes(), rng))
    found, whole = load_checkpoint(path), last(root)
    for name, tensor in whole["state_dict"].items():
        if not torch.equal(found["state_dict"][name], tensor):
            return f"{name} differs"
    return "" if found["heatsplat"]["config"] == whole["heatsplat"]["config"] else "the configuration differs"


def content_of_checkpoint(root: Path, place: Path, rng: random.Random) -> str:
    """Damage to values, with the right checksums: what loads renders finite images."""
    checkpoint = last(root)
    for _ in range(rng.choice([1, 1, 2])):
        part = rng.choice(["state_dict", "heatsplat", "heatsplat", "config", "config"])
        other_value(checkpoint["heatsplat"].get("config", {}) if part == "config" else checkpoint[part], rng)
    path = place / "last.ckpt"
    torch.save(checkpoint, path)
    trained = run.load(path)
    image = trained.render(trained.scene.test.frames[0], unseen="keep")
    return "" if image.isfinite().all() else "the image is not finite"


def other_value(values: Any, rng: random.Random) -> None:
    """Exchanges or drops one value of nested containers, at any depth; the data stay where they are."""
    keys = list(values) if isinstance(values, dict) else range(len(values) if isinstance(values, list) else 0)
    keys = [key for key in keys if key not in ("data", "callbacks", "trainer", "logger")]
    if not keys:
        return
    key = rng.choice(keys)
    inner, how = values[key], rng.random()
    if isinstance(inner, dict | list) and len(inner) and how < 0.9:
        other_value(inner, rng)
    elif how < 0.1:
        del values[key]
    elif isinstance(inner, torch.Tensor) and how < 0.9:
        values[key] = other_tensor(inner.clone(), rng)
    else:
        values[key] = rng.choice(
            [*VALUES, {"_target_": "os.system", "command": "true"}, "${oc.env:HOME}", torch.zeros(3)]
        )


def other_tensor(tensor: torch.Tensor, rng: random.Random) -> torch.Tensor:
    how = rng.randrange(6)
    if how == 0 and tensor.is_floating_point() and tensor.numel():
        tensor.view(-1)[rng.randrange(tensor.numel())] = rng.choice([float("nan"), float("inf"), 1e30, -1e30])
        return tensor
    if how == 1:
        return tensor[: len(tensor) // 2] if tensor.ndim else tensor[None]
    if how == 2:
        return tensor.to(rng.choice([torch.float64, torch.int64, torch.bool, torch.float16]))
    if how == 3:
        return tensor.unsqueeze(0)
    if how == 4 and tensor.ndim:
        return torch.zeros(1, *tensor.shape[1:]).expand(10**9, *tensor.shape[1:])
    return torch.zeros_like(tensor) * 1.0


def splats(root: Path, place: Path, rng: random.Random) -> str:
    path = place / "splats.ply"
    path.write_bytes(damaged((root / "ply" / "splats.ply").read_bytes(), rng.choice([".ply", ".bin"]), rng))
    found = read_splats(path)
    if len({len(array) for array in found.values()}) > 1:
        return "the numbers of splats differ"
    bad = [name for name, array in found.items() if not bool(torch.from_numpy(array.copy()).isfinite().all())]
    return f"{', '.join(bad)} are not finite" if bad else ""


def results(root: Path, place: Path, rng: random.Random) -> str:
    path = place / "metrics.json"
    path.write_bytes(damaged((root / "run" / "metrics.json").read_bytes(), ".json", rng))
    RunResults.read(path).as_json()
    return ""


def folder_of_run(root: Path, place: Path, rng: random.Random) -> str:
    """A table of runs takes any folder: what cannot be read is the reason in its row."""
    damaged_copy(root / "run", place / "job", rng.randrange(10**9))
    row = finished.read_runs([place / "job"]).iloc[0]
    return "" if row["results"] is not None or row["failed"] else "neither results nor a reason"


KINDS: dict[str, Callable[[Path, Path, random.Random], str]] = {
    "bytes_of_checkpoint": bytes_of_checkpoint,
    "content_of_checkpoint": content_of_checkpoint,
    "splats": splats,
    "results": results,
    "folder_of_run": folder_of_run,
}


def outcome_of(kind: str, root: Path, place: Path, number: int) -> Outcome:
    """Damages a file by the number and reads it, in a process of its own."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    prepare_machine(1)  # threads do not outlive a fork
    place.mkdir(exist_ok=True)
    try:
        wrong = KINDS[kind](root, place, random.Random(number))
        return Outcome(number, "nonsense", wrong) if wrong else Outcome(number, "loads")
    except (SceneError, ValueError) as error:
        named = str(place) in str(error) and (isinstance(error, SceneError) or kind in ("splats", "results"))
        return Outcome(number, "refused" if named else "unnamed", traceback.format_exc(limit=-3))
    except BaseException:
        return Outcome(number, "traceback", traceback.format_exc(limit=-4))


def fuzzed(kind: str, root: Path, place: Path, numbers: range) -> list[Outcome]:
    """Outcomes of the inputs of one kind with these numbers."""
    whole = Synthetic(scene="cooling", size="tiny", downscale=4).scene
    with mock.patch.object(Synthetic, "load", lambda self: whole):  # filmed once
        return list(guarded(numbers, partial(outcome_of, kind, root, place)))


if __name__ == "__main__":
    sys.exit(campaign(KINDS, write_templates, fuzzed, sys.argv[1:]))
