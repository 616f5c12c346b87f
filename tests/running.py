"""Runs in the test process, composed and prepared as those of the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from heatsplat.composition import compose, compose_unresolved

NO_PICTURES = ("callbacks.surfaces=null", "callbacks.turntable=null", "callbacks.report.html=false")
TINY = (
    "data.size=tiny", "callbacks.probes=null", "callbacks.images=null", "callbacks.viewer=null", *NO_PICTURES, "threads=1",
)  # fmt: skip


def compose_run(*overrides: str, config_name: str = "train") -> DictConfig:
    """The configuration of ``python src/train.py OVERRIDES``, its interpolations not resolved."""
    return compose_unresolved(overrides, config_name)


def filming_once(film: Callable, filmed: dict[str, Any]) -> Callable:
    """``Synthetic.load``, which is ``film``, for recordings that nobody changes: each is filmed once."""

    def load(self):
        own = {key: value for key, value in vars(self).items() if key not in ("trainer", "scene") and key[0] != "_"}
        settings = repr(sorted(own.items()))
        if settings not in filmed:
            filmed[settings] = film(self)
        return filmed[settings]

    return load


def run(output_dir: Path, *overrides: str):
    """(module, trainer) after a run with these overrides; tests its views too unless test=false is among them."""
    from heatsplat.runs.run import begin
    from heatsplat.training.session import fit

    begun = begin(compose(overrides), output_dir)
    fit(begun.module, begun.data, begun.trainer, ckpt=begun.config["ckpt"], test=begun.config["test"])
    return begun.module, begun.trainer
