"""The command line: composes a configuration with Hydra, builds the parts, runs one job. Only this file imports Hydra.

Only Hydra is imported before the configuration is composed, so that --help, --cfg and typing errors answer at once.
"""

from __future__ import annotations

import functools
import logging
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from heatsplat import CHECKOUT
from heatsplat.training.machine import cores

ROOT = CHECKOUT or Path.cwd()  # outputs/ goes there
CONF = str((CHECKOUT or Path(__file__).resolve().parent) / "conf")

log = logging.getLogger("heatsplat")
build = functools.partial(hydra.utils.instantiate, _convert_="all")

Look = Callable[[], dict[str, Any]]  # returns verdicts on effects by name


def _steps(fraction: float, minimum: int = 1, *, _root_: DictConfig) -> int:
    """A fraction of max_steps as a whole number of steps, at least ``minimum``."""
    return max(int(minimum), round(float(fraction) * int(_root_.max_steps)))


def _scene_name(data: str, root: str | None, scene: str | None) -> str:
    """Name of the scene in the run's folder: data.scene, else the last folder of data.root, else the data set."""
    name = scene or (Path(root).name if root else None) or data
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in str(name))


def _run_of(ckpt: str | None) -> str:
    """Folder of the run that wrote a checkpoint; what is made of the checkpoint goes there."""
    if ckpt is None:
        return str(ROOT / "outputs")
    folder = Path(ckpt).expanduser().resolve().parent
    return str(folder.parent if folder.name == "checkpoints" else folder)


def _cores_of(asked: int | None) -> int | None:
    """Threads of a job that asked for so many cores; a run outside a sweep, or with nothing asked, takes all."""
    return asked if HydraConfig.get().mode == RunMode.MULTIRUN else None


def _cores_by(jobs: int) -> int | None:
    """Threads of one of ``jobs`` side by side (-1: one per core), so that no core is asked for twice."""
    return _cores_of(max(1, cores() // (cores() if jobs == -1 else jobs)))


OmegaConf.register_new_resolver("cores_of", _cores_of, replace=True)
OmegaConf.register_new_resolver("cores_by", _cores_by, replace=True)
OmegaConf.register_new_resolver("run_of", _run_of, replace=True)
OmegaConf.register_new_resolver("root", lambda path: str(ROOT / path), replace=True)
OmegaConf.register_new_resolver("steps", _steps, replace=True)
OmegaConf.register_new_resolver("scene_name", _scene_name, replace=True)


def build_callbacks(plain: dict[str, Any]) -> list[Any]:
    """The callbacks that are on; ``callbacks.<name>=null`` leaves one out."""
    return list(build({name: settings for name, settings in plain.items() if settings is not None}).values())


@contextmanager
def stoppable() -> Iterator[None]:
    """While it lasts, SIGTERM and SIGUSR2 stop a job as Ctrl-C does: after its step, with a checkpoint.

    So a batch system says that the time of a job is over. Whoever listened before hears of it once the job has stopped:
    submitit, which puts the job back into the queue.
    """
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        if asked:
            return
        asked.append(number)
        interrupt = signal.getsignal(signal.SIGINT)
        if not callable(interrupt):  # a shell's background jobs ignore Ctrl-C, but not this
            raise KeyboardInterrupt
        interrupt(signal.SIGINT, frame)

    try:
        before = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGUSR2)}
    except (ValueError, AttributeError):  # not in the main thread, or on Windows
        yield
        return
    try:
        yield
    except (SystemExit, KeyboardInterrupt):
        listener = before[asked[0]] if asked else None
        if callable(listener):
            listener(asked[0], None)
        raise
    finally:
        for number, listener in before.items():
            signal.signal(number, listener)


def _job(work: Callable[[DictConfig, Path], Any]) -> Callable[[DictConfig], Any]:
    """Runs ``work(config, output_dir)`` so that a failure leaves a FAILED file and a readable message.

    In a sweep the exception goes on to Hydra, which runs the other jobs; a single run ends with exit code 1.
    """

    @functools.wraps(work)
    def job(config: DictConfig) -> Any:
        from heatsplat.io.results import FAILED  # here, for it brings torch

        hydra_config = HydraConfig.get()
        output_dir = Path(hydra_config.runtime.output_dir)
        (output_dir / FAILED).unlink(missing_ok=True)
        try:
            with stoppable():
                return work(config, output_dir)
        except Exception as error:
            (output_dir / FAILED).write_text(traceback.format_exc())
            cause = _expected(error)
            if hydra_config.mode == RunMode.MULTIRUN or cause is None:
                raise
            log.error("%s: %s", type(cause).__name__, cause)
            sys.exit(1)

    return job


def _expected(error: BaseException) -> BaseException | None:
    """The error behind ``error`` that is the user's to mend and needs no traceback, or None."""
    from heatsplat.contracts import SceneError

    while error is not None:
        if isinstance(error, SceneError | FileNotFoundError | ImportError | FloatingPointError):
            return error
        error = error.__cause__
    return None


@hydra.main(version_base="1.3", config_path=CONF, config_name="train")
@_job
def train(config: DictConfig, output_dir: Path) -> float | None:
    """Trains a method on a scene, tests it and writes the report. Returns the test PSNR, for sweepers.

    A run that was stopped in this folder goes on from its last checkpoint.
    """
    from heatsplat.contracts import SceneError
    from heatsplat.io.results import METRICS_FILE, RunResults
    from heatsplat.training.session import fit, prepare_machine

    if (chosen := HydraConfig.get().runtime.choices.study) is not None:
        raise SceneError(f"a study has a command of its own: python src/study.py study={chosen}")
    if (output_dir / METRICS_FILE).exists():
        log.info("%s has results already; skipped. Delete the folder to run it again.", output_dir)
        return RunResults.read(output_dir / METRICS_FILE).test.get("psnr")

    if (first := OmegaConf.select(config, "table.after")) is not None:
        check_first(first)
    prepare_machine(config.threads)
    plain = resolved(config)
    data = build(plain["data"])
    look = functools.cache(lambda: judged(plain["effects"], data.scene))
    if plain["budget"] is not None:
        plain = budgeted(config, data, output_dir, look)
    plain = begun(plain, data, output_dir) or with_effects(plain, data, look)
    trainer = build(plain["trainer"], callbacks=build_callbacks(plain["callbacks"]), logger=build(plain["logger"]))
    module = build(plain["module"], output_dir=str(output_dir))
    module.recipe = plain  # set, not passed: Hydra would build every part in it once more
    results = fit(module, data, trainer, ckpt=plain["ckpt"], test=plain["test"])
    return results.test.get("psnr")


def task_overrides() -> list[str]:
    """What the command line says of this job, such as "max_steps=300"; nothing outside a job."""
    return list(HydraConfig.get().overrides.task or []) if HydraConfig.initialized() else []


def check_first(ckpt: str) -> None:
    """Raises SceneError where the run that wrote a checkpoint, and after which another comes, has no results."""
    from heatsplat.contracts import SceneError
    from heatsplat.io.results import METRICS_FILE
    from heatsplat.studies.sweeps import reason_of

    folder = Path(_run_of(ckpt))
    if not (folder / METRICS_FILE).exists():
        raise SceneError(f"the run that comes before this one has no results: {reason_of(folder)} (in {folder})")


def resolved(config: DictConfig) -> dict[str, Any]:
    """A run's configuration as plain containers, with the data's folder as it is called from anywhere."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    if plain["data"].get("root") is not None:
        plain["data"]["root"] = str(Path(plain["data"]["root"]).expanduser().resolve())
    return plain


def budgeted(config: DictConfig, data: Any, output_dir: Path, look: Look | None = None) -> dict[str, Any]:
    """The configuration of a run that makes the most of ``budget`` seconds; a run that goes on keeps its plan.

    "budget" then holds the plan, made from the curves in the file ``budget_curves`` (None: those of the package). The
    trainer has room for more steps than planned, which ``BudgetClock`` may use. ``look`` is that of ``with_effects``.
    """
    from heatsplat.contracts import SceneError
    from heatsplat.studies import budget

    seconds = budget.seconds_of(config.budget)
    given = {text.lstrip("+").partition("=")[0] for text in task_overrides()}
    if "max_steps" in given:
        raise SceneError("budget chooses the number of steps, and max_steps gives it: leave out one of them")
    config = config.copy()
    if config.budget_curves is not None:
        config.budget_curves = str(Path(config.budget_curves).expanduser().resolve())
    plain = resolved(config)
    stored = stored_recipe(plain["ckpt"], output_dir)
    if plain["ckpt"] is not None and not isinstance(stored.get("budget"), dict):
        raise SceneError(f"{plain['ckpt']} was trained without a budget and keeps its schedule: leave budget out")
    keys = [key for key in ("density.cap_max", "density.recipe.cap_max") if OmegaConf.select(config, key) is not None]
    alike = all(stored.get(key) == plain[key] for key in ("name", "data", "budget_curves"))
    if isinstance(stored.get("budget"), dict) and (plain["ckpt"] or (alike and stored["budget"]["asked_s"] == seconds)):
        plan = budget.Plan.from_dict(stored["budget"])
        if plan.asked_s != seconds:
            raise SceneError(f"{plain['ckpt']} was planned for budget={plan.asked_s:g}s and keeps its plan: give that")
    else:
        points = budget.read_points(Path(plain["budget_curves"] or budget.CURVES_FILE))
        log.info("measuring what a step costs here")
        choosing = with_effects(plain | {"effects": plain["effects"] | {"price": False}}, data, look)
        pace = budget.calibrate(
            lambda: build(choosing["module"]), data.scene, plain["max_steps"], seconds, device_of(plain)
        )
        cap_max = OmegaConf.select(config, keys[0]) if keys else None
        free_decay = "optim.decay" not in given
        plan = budget.plan(points, plain["name"], pace, seconds, cap_max, free_decay)
        for line in plan.lines():
            log.info("%s", line)
    config.max_steps = plan.steps
    for key in keys:
        OmegaConf.update(config, key, plan.cap)
    if plan.decay is not None:
        config.optim.decay = plan.decay
    for key in ("density.reset_every", "density.recipe.reset_every"):  # as in the runs behind the curves
        if key not in given and OmegaConf.select(config, key) is not None:
            OmegaConf.update(config, key, None)
    plain = resolved(config)
    plain["trainer"]["max_steps"] = budget.HEADROOM * plan.steps
    plain["budget"] = plan.as_dict()
    clock = {"_target_": "heatsplat.callbacks.budget.BudgetClock", "plan": plain["budget"], "twice": plan.twice()}
    plain["callbacks"]["budget"] = clock
    return plain


def device_of(plain: dict[str, Any]) -> str:
    """Where a run trains: "cpu" or "cuda"."""
    import torch

    return "cpu" if plain["trainer"]["accelerator"] == "cpu" or not torch.cuda.is_available() else "cuda"


def stored_recipe(ckpt: str | None, output_dir: Path) -> dict[str, Any]:
    """The recipe in a checkpoint, or in the newest one of the run's folder that can be read; empty without."""
    from heatsplat.training.module import CHECKPOINT_KEY
    from heatsplat.training.session import load_checkpoint

    if ckpt is not None:
        return load_checkpoint(ckpt).get(CHECKPOINT_KEY, {}).get("recipe", {})
    for _, checkpoint in left_behind(output_dir):
        return checkpoint.get(CHECKPOINT_KEY, {}).get("recipe", {})
    return {}


def left_behind(output_dir: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Checkpoints in a run's folder with their paths, newest first; those that cannot be read are passed over, with a word."""
    from heatsplat.contracts import SceneError
    from heatsplat.training.session import load_checkpoint

    paths = (output_dir / "checkpoints").glob("*.ckpt")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True):
        try:
            yield path, load_checkpoint(path)
        except SceneError as error:  # a disk that was full
            log.warning("%s", error)


# What may differ between a run and the one that wrote its checkpoint: where and how it runs, not what it learns.
NOT_LEARNED = {"threads", "ckpt", "row", "table", "test", "trainer", "callbacks", "logger"}


def begun(plain: dict[str, Any], data: Any, output_dir: Path) -> dict[str, Any] | None:
    """The configuration of a run that goes on where one with the same recipe was stopped in its folder, else None.

    A checkpoint of the last step is passed over: from it there is no step left in which the cost could be measured.
    """
    from heatsplat.effects import assembly
    from heatsplat.training.module import CHECKPOINT_KEY

    if plain["ckpt"] is not None:
        return None
    for path, checkpoint in left_behind(output_dir):
        clock = checkpoint.get("callbacks", {}).get("BudgetClock")  # it moves the end
        if checkpoint["global_step"] >= (round(clock["end"]) if clock else plain["trainer"]["max_steps"]):
            continue
        stored = checkpoint[CHECKPOINT_KEY]["recipe"]
        changed = assembly.changed(plain, stored) if "verdicts" in stored else []
        if not changed:
            found = with_effects(plain | {"ckpt": str(path)}, data)
            changed = sorted(key for key in found.keys() - NOT_LEARNED if found[key] != stored.get(key))
        if not changed:
            log.info("going on from step %d of %s", checkpoint["global_step"], path)
            return found
        log.warning("%s has other settings (%s); starting from the beginning", path, ", ".join(changed))
        return None
    return None


def judged(effects: dict[str, Any], scene: Any) -> dict[str, Any]:
    """Verdicts on all effects in a scene that can be simulated together, as the group "effects" of a configuration wishes."""
    from heatsplat.effects import assembly
    from heatsplat.effects.catalogue import decide

    log.info("looking at scene %s for the effects that it calls for", scene.name)
    seen = decide(scene, assembly.wishes(effects))
    return assembly.reconciled(assembly.possible(seen, scene), assembly.explicit(effects))


def with_effects(plain: dict[str, Any], data: Any, look: Look | None = None) -> dict[str, Any]:
    """The configuration of a run with the effects that its scene calls for, where it leaves them to be chosen.

    Thermal model, sensor and loss then stand in it as they are built, and "verdicts" says why. A run that goes on from a
    checkpoint takes all that from there.

    Args:
        plain: as composed.
        data: the data module.
        look: returns the verdicts (``judged``); who needs them more than once keeps them. None looks at the scene.
    """
    from heatsplat.contracts import SceneError
    from heatsplat.effects import assembly

    if not assembly.chooses(plain):
        return plain
    idle = [
        text
        for text in task_overrides()
        if text.lstrip("+~").startswith(("thermal.", "thermal=", "sensor.", "sensor="))
    ]
    if idle:
        raise SceneError(
            f"{idle[0]} would be replaced: effects={plain['effects']['select']} puts thermal model and sensor together. Set its "
            "parts by effects.states.*, effects.parts.* and effects.sensor.*, or choose a method that has its own."
        )
    if plain["ckpt"] is not None:
        from heatsplat.training.module import CHECKPOINT_KEY
        from heatsplat.training.session import load_checkpoint

        stored = load_checkpoint(plain["ckpt"]).get(CHECKPOINT_KEY, {}).get("recipe", {})
        if "verdicts" in stored:
            changed = assembly.changed(plain, stored)
            if changed:
                raise SceneError(
                    f"{plain['ckpt']} was trained with another {', '.join(changed)}: give what it was trained with, or start "
                    "anew without ckpt"
                )
            return assembly.filled(plain, stored, stored["verdicts"])

    verdicts = look() if look else judged(plain["effects"], data.scene)

    def configured(chosen: dict[str, Any]) -> dict[str, Any]:
        return assembly.filled(plain, assembly.recipe(chosen, plain["effects"]), assembly.told(verdicts, found))

    found: dict[str, Any] = {}
    if plain["effects"]["price"]:
        from heatsplat.studies.prices import prices

        def maker(chosen: dict[str, Any]) -> Callable[[], Any]:
            return lambda: build(configured(chosen)["module"])

        on = [name for name, verdict in verdicts.items() if verdict.on]
        leaving = {name: maker(assembly.without(verdicts, name)) for name in on}
        log.info("measuring what each of %d effects costs", len(on))
        found |= prices(maker(verdicts), leaving, data.scene, plain["max_steps"], device_of(plain))
    for line in assembly.lines(assembly.told(verdicts, found)):
        log.info("%s", line)
    return configured(verdicts)


@hydra.main(version_base="1.3", config_path=CONF, config_name="evaluate")
@_job
def evaluate(config: DictConfig, output_dir: Path) -> float | None:
    """Measures the test views of a checkpoint. Returns the test PSNR."""
    from heatsplat.training.session import prepare_machine, restore

    prepare_machine(config.threads)
    module, data, stored = _restored(config, output_dir)
    plain = OmegaConf.to_container(config, resolve=True)
    trainer = build(
        stored["trainer"] | {"accelerator": plain["accelerator"]},
        callbacks=build_callbacks(plain["callbacks"]),
        logger=build(plain["logger"]),
    )
    restore(module, data, stored["checkpoint"])
    trainer.test(module, datamodule=data, verbose=False)
    return module.results.test.get("psnr")


@hydra.main(version_base="1.3", config_path=CONF, config_name="render")
@_job
def render(config: DictConfig, output_dir: Path) -> None:
    """Renders a shot of a checkpoint's scene to TIFF, PNG and video."""
    from rich.progress import track

    from heatsplat.contracts import SceneError
    from heatsplat.shots import develop, plan
    from heatsplat.training.session import prepare_machine, restore

    prepare_machine(config.threads)
    module, data, stored = _restored(config, output_dir)
    plain = OmegaConf.to_container(config, resolve=True)
    if plain["weather"] is not None:
        if "weather" not in module.thermal.needs:
            raise SceneError(
                f"weather={plain['weather']} changes nothing: {type(module.thermal).__name__} does not use weather. Train "
                "a method that does, or leave weather out."
            )
        data.change_weather(Path(plain["weather"]).expanduser().resolve(), plain["weather_zone"])
    restore(module, data, stored["checkpoint"])
    frames = plan(module.scene, plain["trajectory"], plain["time"], plain["view"], plain["frames"])
    images = (module.predict(frame).cpu() for frame in track(frames, "rendering"))
    options = {key: plain[key] for key in ("tiff", "png", "video", "fps", "range_c")}
    written = develop(images, frames, module.scene, output_dir, **options)
    log.info("%d frames, %d files in %s", len(frames), len(written), output_dir)


def _restored(config: DictConfig, output_dir: Path) -> tuple[Any, Any, dict[str, Any]]:
    """Module and data module as the checkpoint's configuration describes them, and that configuration.

    The configuration comes with the checkpoint itself under "checkpoint"; what ``config.data`` says wins unless null.
    """
    from heatsplat.contracts import SceneError
    from heatsplat.training.module import CHECKPOINT_KEY
    from heatsplat.training.session import load_checkpoint

    if config.ckpt is None:
        raise SceneError("which checkpoint? Give ckpt=outputs/<run>/checkpoints/last.ckpt")
    checkpoint = load_checkpoint(config.ckpt)
    if CHECKPOINT_KEY not in checkpoint:
        raise SceneError(f"{config.ckpt} was not written by heatsplat")
    stored = checkpoint[CHECKPOINT_KEY]["recipe"]
    changed = {key: value for key, value in OmegaConf.to_container(config.data).items() if value is not None}
    if "root" in changed:
        changed["root"] = str(Path(changed["root"]).expanduser().resolve())
    if "weather" in changed and "weather" not in stored["data"]:
        raise SceneError(f"data.weather={changed['weather']}: the data set of this checkpoint has no weather to choose")
    module = build(stored["module"], output_dir=str(output_dir))
    module.recipe = stored
    return module, build(stored["data"] | changed), {**stored, "checkpoint": checkpoint}


@hydra.main(version_base="1.3", config_path=CONF, config_name="study")
@_job
def study(config: DictConfig, output_dir: Path) -> None:
    """Runs a study; its tables and pictures lie in the run's folder."""
    from heatsplat.training.session import prepare_machine

    prepare_machine(config.threads)
    build(OmegaConf.to_container(config.study, resolve=True), output_dir=output_dir)
    log.info("%s", output_dir)
