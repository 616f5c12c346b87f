"""Runs in the test process, composed and prepared as those of the command line."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
from omegaconf import DictConfig

from heatsplat.composition import compose, compose_unresolved
from heatsplat.io.files import write_atomically

NO_PICTURES = ("callbacks.surfaces=null", "callbacks.turntable=null", "callbacks.report.html=false")
LOOKS = "trainer.val_check_interval=${steps:0.5,1}"  # at validation views: twice instead of ten times
TINY = (
    "data.size=tiny", "callbacks.probes=null", "callbacks.images=null", "callbacks.viewer=null", *NO_PICTURES,
    "trainer.val_check_interval=${max_steps}", "threads=1",
)  # fmt: skip
# Training alone, for tests that look at the trained module: nothing is measured or logged; and nothing is stored.
QUIET = (
    *TINY, "callbacks.costs=null", "callbacks.statistics=null", "callbacks.dashboard=null", "callbacks.progress.enabled=false",
    "logger=none", "trainer.limit_val_batches=0", "test=false",
)  # fmt: skip
BARE = (*QUIET, "callbacks.checkpoint=null", "callbacks.checkpoint_end=null")


def compose_run(*overrides: str, config_name: str = "train") -> DictConfig:
    """The configuration of ``python src/train.py OVERRIDES``, its interpolations not resolved."""
    return compose_unresolved(overrides, config_name)


FILMED: dict[str, Any] = {}  # settings of a recording -> the scene, which nobody changes


def filming_once(film: Callable, films: Path) -> Callable:
    """``Synthetic.load``, which is ``film``, for recordings that nobody changes: each is filmed once by all processes that share
    the folder ``films``."""

    def load(self):
        own = {key: value for key, value in vars(self).items() if key not in ("trainer", "scene") and key[0] != "_"}
        settings = repr(sorted(own.items()))
        if settings not in FILMED:
            file = films / hashlib.sha256(settings.encode()).hexdigest()
            if not file.exists():
                write_atomically(file, cloudpickle.dumps(film(self)))
            FILMED[settings] = pickle.loads(file.read_bytes())
        return FILMED[settings]

    return load


def recording_once(film: Callable, films: Path) -> Callable:
    """``film`` for scenes that differ in how a recording is stored, shared out or read: it is filmed once by all processes that
    share the folder ``films``. Each who asks has arrays of its own."""

    def filmed(scene, size, seed=0, noise_k=0.05, distortion=(), pixel_aspect=1.0):
        from heatsplat.datamodules.synthetic_scene.film import Recording

        asked = (size, seed, noise_k, tuple(distortion), pixel_aspect)
        if "route" in vars(scene):  # of its own, which its preset does not tell
            return film(scene, *asked)
        settings = repr((type(scene).__qualname__, scene.preset, asked))
        file = films / f"film_{hashlib.sha256(settings.encode()).hexdigest()}"
        if not file.exists():
            write_atomically(file, pickle.dumps({**vars(film(scene, *asked)), "scene": None}))
        return Recording(**{**pickle.loads(file.read_bytes()), "scene": scene})

    return filmed


def run(output_dir: Path, *overrides: str):
    """(module, trainer) after a run with these overrides; tests its views too unless test=false is among them."""
    from heatsplat.runs.run import begin
    from heatsplat.training.session import fit

    begun = begin(compose(overrides), output_dir)
    fit(begun.module, begun.data, begun.trainer, ckpt=begun.config["ckpt"], test=begun.config["test"])
    return begun.module, begun.trainer
