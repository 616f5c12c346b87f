"""The door to Hydra: configurations as plain containers, and the objects that they describe.

Nothing heavy but Hydra is imported here, so that --help, --cfg and typing errors answer at once.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError

from heatsplat import CHECKOUT
from heatsplat.io.command_lines import with_names
from heatsplat.io.files import short_name
from heatsplat.io.results import checkpoint_of
from heatsplat.io.settings import at, walk
from heatsplat.training.machine import cores

ROOT = CHECKOUT or Path.cwd()  # outputs/ goes there
LONGEST_SCENE = 80  # bytes of its name in a folder's, of which file systems allow 255
CONF = str((CHECKOUT or Path(__file__).resolve().parent) / "conf")


def build(settings: Mapping[str, Any], **more: Any) -> Any:
    """What ``settings``, with ``more`` of them, describe: the object of a ``_target_``, or a dict of what its entries describe.

    In plain containers throughout; Hydra takes a quarter longer for arguments beside its settings, which it merges.

    Raises:
        InstantiationException: a class or function cannot be found, or not be called with its settings.
    """
    return hydra.utils.instantiate({**settings, **more, "_convert_": "all"})


def compose(overrides: Sequence[str] = (), name: str = "train") -> dict[str, Any]:
    """The configuration of a command with these overrides, such as ["method=etgs", "data.scene=heated"].

    Plain containers, every interpolation resolved, and ``overrides`` among them. Within a job of the command line ``hydra:``
    means that job.

    Args:
        overrides: as the command line has them.
        name: of the command: train | evaluate | render | simplify | view | export | study | prepare.

    Raises:
        TypeError: the overrides are no list of texts.
    """
    if isinstance(overrides, str | Mapping) or not all(isinstance(text, str) for text in overrides):
        raise TypeError(
            f"compose takes a list of overrides, such as ['method=etgs', 'max_steps=2000'], got {overrides!r}"
        )
    overrides = with_names(overrides)
    with _users_kept():
        return plain(compose_unresolved(overrides, name), overrides)


@contextlib.contextmanager
def _users_kept() -> Iterator[None]:
    """The program around has its own configuration of Hydra again after it."""
    users = HydraConfig.instance().cfg if GlobalHydra.instance().is_initialized() and not _is_open() else None
    try:
        yield
    finally:
        if users is not None:
            HydraConfig.instance().cfg = users


def copied_settings(overrides: Sequence[str]) -> dict[str, Any]:
    """Settings of a run with these overrides of which composition made others, such as "cap_max", which density control has as
    its own: dotted keys with their values. What changes them in the composed configuration does not reach those others."""
    with _users_kept():
        config = compose_unresolved(overrides)
        values = plain(config, overrides)
    told = (value for _, value in walk(OmegaConf.to_container(config, resolve=False)) if not isinstance(value, Mapping))
    keys = {key for value in told for key in re.findall(r"\$\{([\w.]+)\}", str(value))}
    return {key: at(values, key) for key in sorted(keys)}


def _is_open() -> bool:
    """Whether Hydra composes from heatsplat's configurations now, as in a job of the command line. Within another program it
    composes from those of that."""
    found = GlobalHydra.instance()
    places = found.config_loader().get_search_path().get_path() if found.is_initialized() else ()
    return any(str(place.path).removeprefix("file://") == CONF for place in places)


@contextlib.contextmanager
def _opened() -> Iterator[None]:
    """Hydra composes from heatsplat's configurations while it lasts, and then again from those of the program around it."""
    around = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(CONF, version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = around


def compose_unresolved(overrides: Sequence[str] = (), name: str = "train") -> DictConfig:
    """As ``compose``, before its interpolations are resolved."""
    if _is_open():
        return hydra.compose(name, list(overrides))
    with _opened():
        config = hydra.compose(name, list(overrides), return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    OmegaConf.set_struct(config, None)
    del config["hydra"]
    return config


@functools.cache
def module_settings() -> dict[str, str]:
    """What the training module is built from: dotted keys in "module", with those of the settings that are copied there."""
    module = OmegaConf.to_container(OmegaConf.load(Path(CONF) / "train.yaml"), resolve=False)["module"]
    return {place: value[2:-1] for place, value in walk(module) if re.fullmatch(r"\$\{[\w.]+\}", str(value))}


def options_of(group: str) -> list[str]:
    """The options of a configuration group, such as "method"; none where there is no such group."""
    return sorted(file.stem for file in (Path(CONF) / group).glob("*.yaml"))


def further_places() -> list[str]:
    """Where configurations are beside heatsplat's, by --config-dir and hydra.searchpath of this job; none outside of one."""
    sources = HydraConfig.get().runtime.config_sources if HydraConfig.initialized() else ()
    named = [source for source in sources if re.match(r"command-line|hydra\.searchpath", source.provider)]
    return [f"{source.schema}://{source.path}" for source in named]


def choices_of(overrides: Sequence[str] = ()) -> dict[str, str]:
    """Which option of each group a training run with these overrides has, such as {"density": "adaptive"}."""
    with contextlib.nullcontext() if _is_open() else _opened():
        config = hydra.compose("train", list(overrides), return_hydra_config=True)
    return dict(config.hydra.runtime.choices)


def plain(config: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """A composed configuration as plain containers, with files as they are called from anywhere.

    Raises:
        ValueError: an option follows a setting that the method does not have.
    """
    try:
        found = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except InterpolationKeyError as error:
        told = _unmet(error, HydraConfig.get().runtime.choices)
        if told is None:
            raise
        raise ValueError(told) from error
    for group, key in ((found.get("data") or {}, "root"), (found, "budget_curves")):
        if group.get(key) is not None:
            group[key] = str(Path(group[key]).expanduser().resolve())
    return found | {"overrides": list(overrides)}


def setters_of(key: str, choices: Mapping[str, str | None]) -> list[tuple[str, str]]:
    """Group and name of the options among ``choices`` whose own files set a dotted key, such as ("method", "thermogs")."""
    files = [(group, option, Path(CONF) / group / f"{option}.yaml") for group, option in choices.items() if option]
    return [(group, option) for group, option, path in files if path.is_file() and _at(path, group, key) is not None]


def _at(path: Path, group: str, key: str) -> Any:
    """What an option's own file has at a dotted key, not resolved; None where it sets nothing there."""
    told = re.match(r"# @package (\S+)", path.read_text(encoding="utf-8"))
    package = told[1].replace("_global_", "") if told else group.replace("/", ".")
    if package and not key.startswith(f"{package}."):
        return None
    return at(OmegaConf.to_container(OmegaConf.load(path)), key.removeprefix(f"{package}."))


def _unmet(error: InterpolationKeyError, choices: Mapping[str, str | None]) -> str | None:
    """Which option follows a setting that is nowhere, and which methods have that; None where the error is another."""
    missing = re.match(r"Interpolation key '([\w.]+)' not found", str(error))
    if missing is None or not error.full_key:
        return None
    key, group, method = missing[1], str(error.full_key).partition(".")[0], choices.get("method")
    option = f"{group}={choices[group]}" if choices.get(group) else str(error.full_key)
    methods = {path.stem: path for path in sorted((Path(CONF) / "method").glob("*.yaml"))}
    above, _, name = key.rpartition(".")
    beside = _at(methods[method], "method", above) if above and method in methods else None
    if isinstance(beside, Mapping):  # it has a value for each option of another group, but not for this one
        asks = next((f"{one}={name}" for one, chosen in choices.items() if chosen == name), option)
        return f"{asks} needs {key}, and {above} has {', '.join(beside)}: leave {asks} out, or add +{key}=..."
    having = [name for name, path in methods.items() if _at(path, "method", above or key) is not None]
    chosen = {f"override /{group}": choices.get(group)}
    of_it = [name for name in having if chosen in (_at(methods[name], "method", "defaults") or ())]
    other = f"choose method={' or '.join(of_it or having)}, or " if having else ""
    return f"{option} needs {key}, which method={method} does not have: {other}add +{key}=..."


def overlap(key: str, other: str) -> bool:
    """Whether one of two dotted keys is the other or lies below it."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


def followed(config: Any, before: Any, after: Any) -> Any:
    """A configuration with the changes that lead from ``before`` to ``after``, and all else as it is."""
    if not isinstance(config, Mapping) or not isinstance(after, Mapping):
        return after
    changed = {key for key in after if before.get(key) != after[key]}
    kept = {key: value for key, value in config.items() if key in after or key not in before}
    return kept | {key: followed(config.get(key), before.get(key), after[key]) for key in changed}


def run_of(ckpt: str | None) -> str:
    """Folder of the run that wrote a checkpoint, which may be that folder; what is made of the checkpoint goes there."""
    if ckpt is None:
        return str(ROOT / "outputs")
    folder = checkpoint_of(ckpt).resolve().parent
    return str(folder.parent if folder.name == "checkpoints" else folder)


def prepared_folder(target: str | None) -> str:
    """Folder of a preparation: its target, or a place for the log of one that has none."""
    return str(ROOT / "outputs" / "unprepared" if target is None else Path(target).expanduser())


def scene_name(data: str, root: str | None, scene: str | None) -> str:
    """Name of the scene in the run's folder: data.scene, else the last folder of data.root, else the data set; cut where it is
    long (``io.files.short_name``)."""
    name = scene or (Path(root).name if root else None) or data
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in str(name))
    return short_name(plain, LONGEST_SCENE)


def _length(config: DictConfig) -> int:
    """Steps of the run.

    Raises:
        ValueError: ``max_steps`` is no number.
    """
    try:
        return int(config.max_steps)
    except (TypeError, ValueError) as error:
        raise ValueError(f"max_steps must be a whole number, 1 or more, got {config.max_steps}") from error


def _steps(fraction: float, minimum: int = 1, *, _root_: DictConfig) -> int:
    """A fraction of max_steps as a whole number of steps, at least ``minimum``."""
    return max(int(minimum), round(float(fraction) * _length(_root_)))


def _rate(travel: float, least: float, most: float, *, _root_: DictConfig) -> float:
    """A learning rate that covers ``travel`` within the run, within bounds: Adam moves a number by up to one rate a step."""
    return min(max(float(least), float(travel) / _length(_root_)), float(most))


def _by_length(per_step: float, least: float, most: float, *, _root_: DictConfig) -> float:
    """What grows with the length of the run, within bounds."""
    return min(max(float(least), float(per_step) * _length(_root_)), float(most))


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
