"""What a run's configuration is refused for before anything is read, measured or built."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from heatsplat.composition import copied_settings, module_settings, overlap
from heatsplat.contracts import SceneError, as_written, check_count, check_option
from heatsplat.effects import assembly
from heatsplat.io.command_lines import keys_of
from heatsplat.io.settings import at, walk
from heatsplat.runs.budget import seconds_of
from heatsplat.runs.declared import check_declared
from heatsplat.runs.device import device_of
from heatsplat.training.clocks import CLOCKS
from heatsplat.training.init import Pretrained, check_start

log = logging.getLogger(__name__)

# Learning rates in the group "optim"; elsewhere they are lr, lr_*.
RATES = ("means", "log_scales", "quats", "opacity_logits")
WEIGHTS = ("weight", "_l2", "_penalty")  # endings of the names of weights; "weights" holds more of them
PRETRAINED = f"{Pretrained.__module__}.{Pretrained.__qualname__}"
MAX_THREADS_PER_CORE = 4  # more only wait for each other


def check_threads(threads: int | None) -> None:
    """Raises SceneError for a number of threads that a machine like this one is not given; None is all cores."""
    most = MAX_THREADS_PER_CORE * (os.cpu_count() or 1)
    if threads is not None and not (isinstance(threads, int) and 1 <= threads <= most):
        raise SceneError(
            f"threads must be 1 to {most} on this machine, or null for all cores, got {as_written(threads)}"
        )


def checked(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration with ``budget`` in seconds.

    Raises:
        SceneError: settings contradict each other, are of another kind than is asked for or asked for by nothing, lie out of
            range, were changed where nothing reads them any more, or need what this machine lacks; or there is no file to start
            from.
        ImportError: the renderer is not installed.
    """
    _check_ranges(config)
    check_declared(config)
    _check_as_composed(config)
    _check_first_stage(config)
    check_last_stage(config)
    _check_machine(config)
    if config["init"]["_target_"] == PRETRAINED and config["init"]["path"] is not None:
        check_start(config["init"]["path"])
    if config["test"] and config["callbacks"].get("report") is None:
        log.warning(
            "callbacks.report=null leaves no metrics.json: tables of runs have no row of this one. callbacks.report.html=false "
            "and callbacks.report.show=false leave out the page and the table on the screen"
        )
    check_option("budget_clock", config["budget_clock"], CLOCKS, SceneError)
    if config["budget"] is None and "budget_clock" in keys_of(config["overrides"]):
        raise SceneError(
            "budget_clock says what the seconds of a budget are, and there is none: give budget=, or leave it out"
        )
    if config["budget"] is not None:
        config = config | {"budget": seconds_of(config["budget"])}
        if "max_steps" in keys_of(config["overrides"]):
            raise SceneError("budget chooses the number of steps, and max_steps gives it: leave out one of them")
        if both := {"preset", "recipe"} & keys_of(config["overrides"]):
            raise SceneError(f"budget and {min(both)} both choose the number of steps: leave out one of them")
    if assembly.chooses_effects(config):
        replaced = ("thermal.", "thermal=", "sensor.", "sensor=")
        idle = [text for text in config["overrides"] if text.lstrip("+~").startswith(replaced)]
        if idle:
            raise SceneError(
                f"{idle[0]} has no effect here: effects={config['effects']['select']} puts thermal model and sensor together. "
                "Set its parts by effects.states.*, effects.parts.* and effects.sensor.*, or choose a method that has its own."
            )
    return config


def _check_as_composed(config: Mapping[str, Any]) -> None:
    """Raises SceneError for a setting that was changed after composition: the module is built from what was composed."""
    given = keys_of(config["overrides"])
    for place, key in module_settings().items():
        if any(overlap(f"module.{place}", other) for other in given):
            continue
        _refuse_change(key, at(config, key), at(config["module"], place))


def check_copied(config: Mapping[str, Any]) -> None:
    """Raises SceneError for a setting that was changed after composition, which had made others of it. It composes again: only
    for a configuration that was in the hands of a program."""
    for key, composed in copied_settings(config["overrides"]).items():
        _refuse_change(key, at(config, key), composed)


def _refuse_change(key: str, given: Any, composed: Any) -> None:
    changed = _difference(key, given, composed)
    if changed is not None:
        name, value, before = changed
        raise SceneError(
            f"{name} was changed after compose, from {before} to {value}, and would not take effect: give it to "
            f"compose, as in compose([..., '{name}={value}'])"
        )


def _difference(key: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """Dotted key and both values of the first setting in which two differ; None where they are equal."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        found = (_difference(f"{key}.{name}", one.get(name), other.get(name)) for name in {**other, **one})
        return next((difference for difference in found if difference is not None), None)
    same = one == other or (one != one and other != other)  # NaN, which the check of its kind refuses
    return None if same else (key, one, other)


def _check_first_stage(config: Mapping[str, Any]) -> None:
    shared, own = config.get("first_steps"), config["thermal"].get("first_steps")
    if None not in (shared, own) and own != shared:
        raise SceneError(
            f"thermal.first_steps={own}, but stages, density control and losses follow first_steps={shared}: set "
            f"first_steps={own} instead"
        )


def check_last_stage(config: Mapping[str, Any]) -> None:
    """Raises SceneError where the first stage of a run takes all of its steps, which a budget may have chosen."""
    first, steps = config.get("first_steps"), config["max_steps"]
    if isinstance(first, int | float) and first >= steps:
        raise SceneError(
            f"first_steps={first} leaves no step of max_steps={steps} for what is to be trained after the first stage: give "
            "fewer first_steps, or more max_steps (a longer budget)"
        )


def _check_ranges(config: Mapping[str, Any]) -> None:
    check_threads(config["threads"])
    for key, least in (("max_steps", 1), ("seed", 0)):
        check_count(key, config[key], least)
    for key, rate in _rates(config):
        if isinstance(rate, int | float) and not rate >= 0:
            raise SceneError(f"{key} is a learning rate and must be 0 or more, got {rate}")
    for key, weight in _weights(config):
        if isinstance(weight, int | float) and not 0 <= weight < math.inf:
            raise SceneError(
                f"{key} is a weight in the loss and must be 0 or more, or training makes worse what it weighs, got {weight}"
            )


def _rates(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Learning rates with their dotted keys."""
    yield from ((f"optim.{name}", config["optim"].get(name)) for name in RATES)
    for key, value in walk({group: config[group] for group in ("thermal", "sensor")}):
        name = key.rpartition(".")[2]
        if not isinstance(value, Mapping) and (name == "lr" or name.startswith("lr_")):
            yield key, value


def _weights(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Weights of loss terms, penalties and priors with their dotted keys: those that are called so."""
    for key, value in walk({group: config[group] for group in ("thermal", "sensor", "loss")}):
        *above, name = key.split(".")
        if not isinstance(value, Mapping) and (above[-1:] == ["weights"] or name.endswith(WEIGHTS)):
            yield key, value


def _check_machine(config: Mapping[str, Any]) -> None:
    device = device_of(config["trainer"]["accelerator"], config["renderer"])
    devices = _devices(config["trainer"].get("devices", 1), device) * (config["trainer"].get("num_nodes") or 1)
    if device == "cuda" and config["budget_clock"] == "cpu_seconds":
        raise SceneError(
            "budget_clock=cpu_seconds counts processor time, and this run trains on a GPU, whose time is not: leave it out"
        )
    if devices > 1:
        raise SceneError(
            f"one scene trains on one device, but trainer.devices and trainer.num_nodes ask for {devices}: leave them out. "
            "Several devices take jobs side by side: add -m and launcher=joblib or launcher=slurm"
        )


def _devices(asked: Any, device: str) -> int:
    """How many devices Lightning would take: of a number, a list of them, or all there are ("auto", -1)."""
    if isinstance(asked, str) and "," in asked:
        asked = [one for one in asked.split(",") if one.strip()]
    if isinstance(asked, list | tuple):
        return len(asked)
    if str(asked) in ("auto", "-1"):
        return torch.cuda.device_count() if device == "cuda" else 1
    return int(asked) if str(asked).isdecimal() else 1
