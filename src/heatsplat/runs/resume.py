"""Where a run goes on: from a checkpoint that it was given, or from where one with the same settings stopped in its folder."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from heatsplat.composition import compose, followed, overlap, run_of
from heatsplat.contracts import SceneData, SceneError
from heatsplat.effects import assembly
from heatsplat.io.command_lines import as_dict, keys_of, setting, typed
from heatsplat.io.results import checkpoint_of
from heatsplat.io.settings import at
from heatsplat.runs.lock import OccupiedError
from heatsplat.runs.trust import trusted
from heatsplat.training.checkpoints import load_checkpoint, step_of
from heatsplat.training.module import CHECKPOINT_KEY

log = logging.getLogger("heatsplat")

# What may differ between a run and the one that wrote its checkpoint: where and how it runs, not what it learns.
NOT_LEARNED = {"threads", "ckpt", "row", "table", "leaderboard", "doctor", "test", "trainer", "callbacks", "logger"}
LEARNED = {  # and what in these says how it learns, or how long
    "trainer": ("gradient_clip_val", "gradient_clip_algorithm", "accumulate_grad_batches"),
    "callbacks": ("plateau",),
}
# What may differ beside the length from the run whose checkpoint is given: where it is, when it ends, what is decided already.
OPEN = ("data.root.", "renderer.backend.", "callbacks.plateau.", "effects.price.", "effects.least_db_per_ms.")
ABSENT = object()  # of what an older heatsplat did not have
SHOWN = 5  # names of settings in a message


def resumed(config: dict[str, Any], output_dir: Path) -> dict[str, Any]:
    """The configuration with what an earlier run measured for it, and with ``ckpt``, where there is one to go on from.

    "verdicts" are those on its scene, which took "choosing_seconds"; "budget" is its plan. A run that was given the checkpoint of
    another goes on from its own where it was stopped later than that. A checkpoint of the last step of a run is not gone on from,
    for there would be no step left in which the cost could be measured.

    Args:
        config: as composed and checked.
        output_dir: folder of the run.

    Raises:
        SceneError: the checkpoint that was given is none, of a run with another budget or other settings than its length, or of
            the last step of this run or a later one.
        OccupiedError: as ``check_own``.
    """
    if config["ckpt"] is not None:
        config = config | {"ckpt": str(checkpoint_of(config["ckpt"]))}
        check_own(config, output_dir)
        given = load_checkpoint(config["ckpt"])
        return _further(_continued(config, given), given["global_step"], output_dir)
    composed = config  # of which the plan of an earlier budget is no part
    for path, checkpoint in checkpoints_in(output_dir):
        stored = stored_config(checkpoint)
        _check_own(composed, output_dir, path, checkpoint)
        config = config | _measured(stored, path, "verdicts", "choosing_seconds", "budget")
        if checkpoint["global_step"] < planned_end(checkpoint):
            log.info("going on from step %d of %s", checkpoint["global_step"], path)
            return config | {"ckpt": str(path)}
    return config


def check_own(config: dict[str, Any], output_dir: Path) -> None:
    """Nothing where a run's folder has no checkpoints, or its newest has the same settings, or the run goes on from one of them.

    Args:
        config: as composed and checked.
        output_dir: folder of the run.

    Raises:
        OccupiedError: its checkpoints are of a run with other settings and would be overwritten.
    """
    if config["ckpt"] is not None and Path(run_of(config["ckpt"])) == output_dir.resolve():
        return  # ``_continued`` compares the settings, and allows more steps
    for path, checkpoint in islice(checkpoints_in(output_dir), 1):
        _check_own(config, output_dir, path, checkpoint)


def on_scene(config: dict[str, Any], scene: SceneData) -> dict[str, Any]:
    """The configuration with "scene", the name and the image size of what is trained on.

    Raises:
        SceneError: the run goes on from a checkpoint of another scene or image size, with both.
    """
    camera = scene.train.frames[0].camera
    here = {"name": scene.name, "width": camera.width, "height": camera.height}
    before = config.get("scene", here)
    if before != here:
        told = [f"{one['name']} in {one['width']} x {one['height']} pixels" for one in (before, here)]
        raise SceneError(
            f"{config['ckpt']} was trained on {told[0]}, and this is {told[1]}: give the data it was trained on"
        )
    return config | {"scene": here}


def checkpoints_in(output_dir: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Checkpoints in a run's folder with their paths, the one of the latest step first; those that cannot be read are passed
    over, with a word.

    By their steps, for times of files are those of their copies where a folder was moved.
    """
    paths = (output_dir / "checkpoints").glob("*.ckpt")
    for path in sorted(paths, key=lambda path: (step_of(path), path.stat().st_mtime), reverse=True):
        try:
            yield path, load_checkpoint(path)
        except SceneError as error:  # a disk that was full
            log.warning("%s", error)


def planned_end(checkpoint: Mapping[str, Any]) -> int:
    """The last step that the run of a checkpoint was heading for."""
    return round(checkpoint[CHECKPOINT_KEY]["schedule"]["end"])


def differences(config: Mapping[str, Any], stored: Mapping[str, Any]) -> list[str]:
    """Dotted keys of what is learned and how in which a composed configuration differs from that of a finished one.

    What came of it later (steps of a budget, parts that verdicts chose) does not count: ``completed`` says what was composed.
    """
    before = {**stored, **stored.get("composed", {})}
    learned = sorted(config.keys() - NOT_LEARNED - {"overrides"})
    keys = [key for name in learned for key in _differing(name, config[name], before.get(name))]
    for group, names in LEARNED.items():
        here, there = config.get(group) or {}, before.get(group) or {}
        keys += [key for name in names for key in _differing(f"{group}.{name}", here.get(name), there.get(name))]
    return [key for key in keys if key.removeprefix("module.") == key or key.removeprefix("module.") not in keys]


def completed(config: dict[str, Any], composed: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with what it was ``composed`` as, under that key, where it has become something else."""
    return config | {
        "composed": {key: value for key, value in composed.items() if config[key] != value and key != "ckpt"}
    }


def stored_config(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of the run that wrote a checkpoint; empty where none of ours did."""
    own = checkpoint.get(CHECKPOINT_KEY)
    config = own.get("config") if isinstance(own, dict) else None
    return config if isinstance(config, dict) else {}


def learned_by(overrides: Mapping[str, str]) -> dict[str, str]:
    """Those of the overrides that say what a run learns: not where and how it runs."""

    def says_it(key: str) -> bool:
        group, _, name = key.lstrip("+~").partition(".")
        if group in LEARNED:  # an option of the group, such as callbacks=plateau, may hold it
            return not name or name.partition(".")[0] in LEARNED[group]
        return group not in NOT_LEARNED | {"launcher"}

    return {key: value for key, value in overrides.items() if says_it(key)}


def given_first(changed: Sequence[str], config: Mapping[str, Any], stored: Mapping[str, Any]) -> list[str]:
    """Settings in which two configurations differ, those first that a command line gave to one of them otherwise: numbers that
    follow from those, such as steps of density control from max_steps, come after."""
    now, before = (learned_by(as_dict(one.get("overrides") or [])) for one in (config, stored))
    given = {key.lstrip("+~") for key in now.keys() | before.keys() if now.get(key) != before.get(key)}
    return sorted(changed, key=lambda key: not any(overlap(key, other) for other in given))


def shortened(names: Sequence[str]) -> str:
    """Names of settings for a message: the first, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{', '.join(names[:SHOWN])}{more}"


def _check_own(config: dict[str, Any], output_dir: Path, path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Raises OccupiedError where a checkpoint in a run's folder is of other settings."""
    stored = stored_config(checkpoint)
    if changed := given_first(differences(config, stored), config, stored):
        step, ckpt = checkpoint.get("global_step"), typed(setting("ckpt", path))
        if len(new_in(config, stored, changed)) == len(changed):
            raise OccupiedError(
                f"{output_dir} holds an unfinished run of an older heatsplat, which did not have "
                f"{shortened(changed)}: {ckpt} {typed(setting('hydra.run.dir', output_dir))} goes on from step {step}, and they "
                "count from there on; or delete that folder (of a sweep: that of the job), and the same command trains it anew"
            )
        raise OccupiedError(
            f"{output_dir} holds an unfinished run with other settings ({shortened(changed)}), of which "
            f"{path.name} is of step {step}: give another folder with hydra.run.dir (of a sweep: hydra.sweep.dir); or go on "
            f"with that run, with its settings and {ckpt}; or delete that folder"
        )


def _measured(stored: Mapping[str, Any], path: Path | str, *keys: str) -> dict[str, Any]:
    """What an earlier run found out, of which the parts of this one will be built."""
    return trusted({key: stored[key] for key in keys if key in stored}, path)


def _differing(key: str, one: Any, other: Any) -> Iterator[str]:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in sorted(one.keys() | other.keys()):
            yield from _differing(f"{key}.{name}", one.get(name), other.get(name))
    elif one != other:
        yield key


def _continued(config: dict[str, Any], checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with what was measured for the run of the checkpoint that it was given."""
    stored = stored_config(checkpoint)
    ckpt, asked, plan = config["ckpt"], config["budget"], stored.get("budget")
    if asked is not None and plan is None:
        raise SceneError(f"{ckpt} was trained without a budget and keeps its schedule: leave budget out")
    if plan is not None and plan["asked_s"] != asked:
        raise SceneError(f"{ckpt} was planned for budget={plan['asked_s']:g}s and keeps its plan: give that")
    if stored.get("name") == config["name"]:  # another method is refused with the tensors in which it differs
        _check_same_settings(config, stored)
    config = config | _measured(stored, ckpt, "budget", "scene")
    if assembly.chooses_effects(config):
        config = config | _measured(stored, ckpt, "verdicts", "choosing_seconds")
    if stored.get("name") == config["name"]:
        _check_steps_left(config, checkpoint)
    return config


def _further(config: dict[str, Any], step: int, output_dir: Path) -> dict[str, Any]:
    """The configuration of a run that was given another run's checkpoint, of that ``step``; where it was stopped later, with its
    own checkpoint in the folder in place of that."""
    folder = output_dir.resolve()
    if Path(run_of(config["ckpt"])) == folder:
        return config
    for path, checkpoint in checkpoints_in(output_dir):
        stored = stored_config(checkpoint)
        began = stored.get("ckpt")  # at the same one, or at one of its own when it went on before
        same = began is not None and (
            Path(began).resolve() == Path(config["ckpt"]).resolve() or Path(run_of(began)) == folder
        )
        if same and step < checkpoint["global_step"] < planned_end(checkpoint):
            log.info("going on from step %d of %s", checkpoint["global_step"], path)
            return config | _measured(stored, path, "verdicts", "choosing_seconds", "budget") | {"ckpt": str(path)}
    return config


def _check_same_settings(config: dict[str, Any], stored: Mapping[str, Any]) -> None:
    """Raises SceneError where a run would learn by other settings than that of its checkpoint; it may be longer.

    Rates of the optimiser are in the checkpoint, and others would have no effect. Settings that heatsplat did not have when it
    was written are warned of, unless they were asked for.
    """
    before = {**stored, **stored.get("composed", {})}
    overrides = config["overrides"]
    if config["max_steps"] != before["max_steps"]:  # and what follows from it
        shorter = compose([*overrides, f"max_steps={before['max_steps']}"])
        config = followed(config, compose(overrides), shorter)
    changed = [key for key in differences(config, stored) if not f"{key}.".startswith(OPEN)]
    new = new_in(config, stored, changed)
    if known := [key for key in changed if key not in new]:
        raise SceneError(
            f"{config['ckpt']} was trained with another {', '.join(known)}: give what it was trained with, or start anew without "
            "ckpt"
        )
    if new:
        log.warning("%s is of an older heatsplat without %s: they count from here on", config["ckpt"], ", ".join(new))


def new_in(config: Mapping[str, Any], stored: Mapping[str, Any], changed: Iterable[str]) -> list[str]:
    """Those of the settings that an older heatsplat did not have when it wrote ``stored``, and that were not asked for."""
    before, given = {**stored, **stored.get("composed", {})}, keys_of(config["overrides"])
    return [key for key in changed if at(before, key, ABSENT) is ABSENT and not any(overlap(key, one) for one in given)]


def _check_steps_left(config: Mapping[str, Any], checkpoint: Mapping[str, Any]) -> None:
    """Raises SceneError where a run would end at the step of its checkpoint or before, and would train nothing."""
    planned = config["budget"] is not None
    step, end = checkpoint["global_step"], planned_end(checkpoint) if planned else config["max_steps"]
    if step >= end:
        ends = f"the plan of its budget ends at step {end}" if planned else f"max_steps={end}"
        more = "" if planned else "give more max_steps, or "
        raise SceneError(
            f"{config['ckpt']} is of step {step} already, and {ends}: nothing is left to train; {more}evaluate it "
            f"(src/evaluate.py ckpt={config['ckpt']})"
        )
