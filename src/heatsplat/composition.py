"""The door to Hydra: configurations as plain containers, and the objects that they describe.

Only Hydra is imported here, so that --help, --cfg and typing errors answer at once.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from heatsplat import CHECKOUT
from heatsplat.training.machine import cores

ROOT = CHECKOUT or Path.cwd()  # outputs/ goes there
CONF = str((CHECKOUT or Path(__file__).resolve().parent) / "conf")

build = functools.partial(hydra.utils.instantiate, _convert_="all")


def compose(overrides: Sequence[str] = (), name: str = "train") -> dict[str, Any]:
    """The configuration of a command with these overrides, such as ["method=etgs", "data.scene=heated"].

    Plain containers, every interpolation resolved, and ``overrides`` among them. Within a job of the command line ``hydra:``
    means that job.

    Args:
        overrides: as the command line has them.
        name: of the command: train | evaluate | render | simplify | view | export | study | prepare.
    """
    return plain(composed(overrides, name), overrides)


def composed(overrides: Sequence[str] = (), name: str = "train") -> DictConfig:
    """As ``compose``, before its interpolations are resolved."""
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(name, list(overrides))
    with hydra.initialize_config_dir(CONF, version_base="1.3"):
        config = hydra.compose(name, list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    return OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])


def choices_of(overrides: Sequence[str] = ()) -> dict[str, str]:
    """Which option of each group a training run with these overrides has, such as {"density": "adaptive"}."""
    open_already = GlobalHydra.instance().is_initialized()
    with contextlib.nullcontext() if open_already else hydra.initialize_config_dir(CONF, version_base="1.3"):
        config = hydra.compose("train", list(overrides), return_hydra_config=True)
    return dict(config.hydra.runtime.choices)


def plain(config: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """A composed configuration as plain containers, with files as they are called from anywhere."""
    found = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    for group, key in ((found.get("data") or {}, "root"), (found, "budget_curves")):
        if group.get(key) is not None:
            group[key] = str(Path(group[key]).expanduser().resolve())
    return found | {"overrides": list(overrides)}


def keys_of(overrides: Sequence[str]) -> set[str]:
    """What overrides are given for, such as {"max_steps", "data.scene"}."""
    return {text.lstrip("+~").partition("=")[0] for text in overrides}


def run_of(ckpt: str | None) -> str:
    """Folder of the run that wrote a checkpoint; what is made of the checkpoint goes there."""
    if ckpt is None:
        return str(ROOT / "outputs")
    folder = Path(ckpt).expanduser().resolve().parent
    return str(folder.parent if folder.name == "checkpoints" else folder)


def prepared_folder(target: str | None) -> str:
    """Folder of a preparation: its target, or a place for the log of one that has none."""
    return str(ROOT / "outputs" / "unprepared" if target is None else Path(target).expanduser())


def scene_name(data: str, root: str | None, scene: str | None) -> str:
    """Name of the scene in the run's folder: data.scene, else the last folder of data.root, else the data set."""
    name = scene or (Path(root).name if root else None) or data
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in str(name))


def _steps(fraction: float, minimum: int = 1, *, _root_: DictConfig) -> int:
    """A fraction of max_steps as a whole number of steps, at least ``minimum``."""
    return max(int(minimum), round(float(fraction) * int(_root_.max_steps)))


def _rate(travel: float, least: float, most: float, *, _root_: DictConfig) -> float:
    """A learning rate that covers ``travel`` within the run, within bounds: Adam moves a number by up to one rate a step."""
    return min(max(float(least), float(travel) / int(_root_.max_steps)), float(most))


def _by_length(per_step: float, least: float, most: float, *, _root_: DictConfig) -> float:
    """What grows with the length of the run, within bounds."""
    return min(max(float(least), float(per_step) * int(_root_.max_steps)), float(most))


def _cores_of(asked: int | None) -> int | None:
    """Threads of a job that asked for so many cores; a run outside a sweep, or with nothing asked, takes all."""
    return asked if HydraConfig.get().mode == RunMode.MULTIRUN else None


def _cores_by(jobs: int) -> int | None:
    """Threads of one of ``jobs`` side by side (-1: one per core), so that no core is asked for twice."""
    return _cores_of(max(1, cores() // (cores() if jobs == -1 else jobs)))


OmegaConf.register_new_resolver("by_length", _by_length, replace=True)
OmegaConf.register_new_resolver("checkout", lambda path: CHECKOUT and str(CHECKOUT / path), replace=True)
OmegaConf.register_new_resolver("cores_of", _cores_of, replace=True)
OmegaConf.register_new_resolver("cores_by", _cores_by, replace=True)
OmegaConf.register_new_resolver("prepared", prepared_folder, replace=True)
OmegaConf.register_new_resolver("rate", _rate, replace=True)
OmegaConf.register_new_resolver("root", lambda path: str(ROOT / path), replace=True)
OmegaConf.register_new_resolver("run_of", run_of, replace=True)
OmegaConf.register_new_resolver("scene_name", scene_name, replace=True)
OmegaConf.register_new_resolver("steps", _steps, replace=True)
