"""The command line: Hydra composes a configuration, one job runs, and what fails is told in a sentence.

Only Hydra is imported before the configuration is composed, so that --help, --cfg and typing errors answer at once.
"""

from __future__ import annotations

import difflib
import errno
import functools
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from heatsplat.composition import CONF, build, composed, plain, run_of
from heatsplat.io.command_lines import setting, typed
from heatsplat.training.machine import prepare_machine

log = logging.getLogger("heatsplat")


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


# What a disk says that is full, may not be written to, or has a file where a folder is to be: no traceback helps.
NO_PLACE = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room, or give a folder on another disk")
NO_PLACE |= dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), "nothing may be written there: give another folder")
NO_PLACE |= dict.fromkeys(
    (errno.EEXIST, errno.ENOTDIR), "a file is where a folder is to be: remove it, or give another folder"
)

ALL_OF_IT = "HYDRA_FULL_ERROR"  # the environment variable with which errors come with all that Hydra knows of them

EXAMPLES = {
    "train": (
        "method=etgs",
        "method=auto data.scene=heated budget=2min",
        "method=3dgs data=colmap data.root=/data/my_scene",
    ),
    "evaluate": ("ckpt=outputs/.../checkpoints/last.ckpt",),
    "render": ("ckpt=outputs/.../checkpoints/last.ckpt trajectory=orbit time=600",),
    "simplify": ("ckpt=outputs/.../checkpoints/last.ckpt levels_c=[0.02,0.1]",),
    "view": ("ckpt=outputs/.../checkpoints/last.ckpt",),
    "export": ("ckpt=outputs/.../checkpoints/last.ckpt what=ply time=600",),
    "study": ("study=frontier study.runs=outputs",),
    "prepare": ("source=/data/flight target=/data/my_scene",),
}


def _command(job: Callable[[DictConfig], Any]) -> Callable[[], Any]:
    """The command of a job: without arguments it says how it is used, and what cannot be composed is told in a sentence."""
    name, all_of_it = job.__name__, False

    @functools.wraps(job)
    def undisturbed(config: DictConfig) -> Any:
        """The job, in the environment that the user gave it: commands that it starts say what fails in a sentence, too."""
        if all_of_it:
            return job(config)
        ours = os.environ.pop(ALL_OF_IT, None)  # none in a process of a launcher that does not hand it on
        try:
            return job(config)
        finally:
            if ours is not None:
                os.environ[ALL_OF_IT] = ours

    main = hydra.main(version_base="1.3", config_path=CONF, config_name=name)(undisturbed)

    @functools.wraps(main)
    def command() -> Any:
        nonlocal all_of_it
        if len(sys.argv) == 1:
            script = sys.argv[0] if sys.argv[0].endswith(".py") else f"heatsplat-{name}"
            script = f"python {script}" if script.endswith(".py") else script
            lines = [
                (job.__doc__ or "").partition("\n")[0],
                "",
                *(f"  {script} {example}" for example in EXAMPLES[name]),
            ]
            print("\n".join([*lines, "", f"{script} --help lists what can be set."]))
            sys.exit(2)
        all_of_it = ALL_OF_IT in os.environ
        os.environ[ALL_OF_IT] = "1"  # Hydra raises what it would print otherwise
        try:
            return main()
        except (CompactHydraException, OmegaConfBaseException) as error:
            if all_of_it:
                raise
            place = re.search(r"full_key: (\S+)", str(error)) if isinstance(error, InstantiationException) else None
            cause = error.__cause__
            if place and isinstance(cause, ValueError):
                sys.exit(f"{place[1]}: {cause}")
            if place and isinstance(cause, TypeError) and _of_settings(cause):
                sys.exit(f"{place[1]}: {cause} (HYDRA_FULL_ERROR=1 shows where)")
            if place and cause is not None and _raised_here(cause) and _expected(cause) is None:
                raise  # a mistake of ours, and no setting
            sys.exit("\n".join(filter(None, [str(error), str(cause or ""), _meant(error, name)])))
        except Exception as error:  # of a job of a sweep, when all others have run
            if "group override must be a string" in str(error) and (nulled := _nulled()) and not all_of_it:
                sys.exit(f"{nulled}=null: a group takes the name of one of its options: {', '.join(_options(nulled))}")
            cause = _expected(error)
            if all_of_it or cause is None:
                raise
            sys.exit(_sentence(cause))
        finally:
            if not all_of_it:
                del os.environ[ALL_OF_IT]

    return command


def _meant(error: Exception, name: str) -> str:
    """ "Did you mean ...?" for a group's option or a key that there is not, or how a value is written that Hydra cannot read;
    empty where nothing is like it."""
    if isinstance(error, OverrideParseException):
        return _quoted(error.override)
    if ambiguous := re.match(r"Ambiguous value for argument '(.+)'\n", str(error)):
        return _quoted(ambiguous[1])
    if (wrong := getattr(error, "missing_cfg_file", None)) and error.options:
        group, _, wrong = wrong.rpartition("/")
        near, form = difflib.get_close_matches(wrong, error.options, 3, 0.5), f"{group}={{}}"
    elif unknown := re.search(r"Could not override '([^']+)'", str(error)):
        wrong, form = unknown[1], "{}"
        given = [text for text in sys.argv[1:] if not text.startswith(("-", wrong))]
        try:
            settings = OmegaConf.to_container(composed(given, name))
        except (CompactHydraException, OmegaConfBaseException):  # it was not the only mistake
            return ""
        if inner := _of_dotted_name(settings, wrong):
            return inner
        keys = [*_keys(settings), *(path.name for path in Path(CONF).iterdir() if path.is_dir())]
        parent, _, leaf = wrong.rpartition(".")
        beside = {
            name: key for key in keys for above, _, name in [key.rpartition(".")] if above == parent and name[0] != "_"
        }
        near = [beside[name] for name in difflib.get_close_matches(leaf, beside, 3)]
        if not near and parent in keys:
            return f"{parent} has {', '.join(sorted(beside)) or 'nothing to set'}"
        near = near or difflib.get_close_matches(wrong, keys, 3)
    else:
        return ""
    return f"Did you mean {' or '.join(form.format(one) for one in near)}?" if near else ""


def _of_dotted_name(settings: dict[str, Any], wrong: str) -> str:
    """How a key is set whose name has dots in it, which a path cannot reach; empty where ``wrong`` looks like none."""
    above, inside, rest = "", settings, wrong
    while isinstance(inside.get(rest.partition(".")[0]), dict):
        first, _, rest = rest.partition(".")
        above, inside = f"{above}.{first}".lstrip("."), inside[first]
    near = difflib.get_close_matches(rest, [name for name in inside if "." in name], 1)
    value = next((text.partition("=")[2] for text in sys.argv[1:] if text.partition("=")[0] == wrong), "...")
    return f"{near[0]} is one name, dots and all: {typed(f'{above}={{{near[0]}:{value}}}')}" if near else ""


def _quoted(override: str) -> str:
    """How a setting is written whose value Hydra's grammar does not take as it stands, such as a path with a space."""
    key, _, value = override.partition("=")
    if re.fullmatch(r"[+-]?\d+,\d+", value):
        return f"A number has a decimal point: {key}={value.replace(',', '.')}"
    if re.fullmatch(r"\[[^][{}'\"]*\]?", value):  # without its end where a shell took it apart at a space
        words = [setting("", word.strip())[1:] for word in value.strip("[]").split(",") if word.strip()]
        whole = ",".join([*words, *([] if value.endswith("]") else ["..."])])
        return f"A list is one argument, and text with = or umlauts in it takes quotes: {typed(f'{key}=[{whole}]')}"
    if not value or value[0] in "[{'\"":
        return ""
    return f"Text with spaces, commas, umlauts or brackets takes two pairs of quotes: {typed(setting(key, value))}"


def _nulled() -> str | None:
    """The configuration group that the command line sets to null, if there is one."""
    given = (text.removesuffix("=null") for text in sys.argv[1:] if text.endswith("=null"))
    return next((group for group in given if _options(group)), None)


def _options(group: str) -> list[str]:
    return sorted(file.stem for file in (Path(CONF) / group).glob("*.yaml"))


def _keys(settings: dict[str, Any], path: str = "") -> Iterator[str]:
    for key, value in settings.items():
        yield f"{path}{key}"
        if isinstance(value, dict):
            yield from _keys(value, f"{path}{key}.")


def _job(
    work: Callable[[dict[str, Any], Path], Any], check: Callable[[DictConfig, Path], None] | None = None
) -> Callable[[DictConfig], Any]:
    """Runs ``work(config, output_dir)`` so that a failure leaves a FAILED file and a readable message.

    The configuration comes as plain containers (``composition.plain``). ``check`` may raise OccupiedError: it comes before
    anything in the folder is changed.

    In a sweep the exception goes on to Hydra, which runs the other jobs; a single run ends with exit code 1.
    """

    @functools.wraps(work)
    def job(config: DictConfig) -> Any:
        from heatsplat.io.results import FAILED, METRICS_FILE  # here, for they bring torch
        from heatsplat.runs.lock import OccupiedError, locked

        hydra_config = HydraConfig.get()
        output_dir = Path(hydra_config.runtime.output_dir)
        try:
            with locked(output_dir), stoppable():
                if check is not None:
                    check(config, output_dir)
                (output_dir / FAILED).unlink(missing_ok=True)
                if not (output_dir / METRICS_FILE).exists():
                    _write_down(config, hydra_config, output_dir / ".hydra")
                return work(plain(config, hydra_config.overrides.task), output_dir)
        except Exception as error:
            cause = _expected(error)
            if not isinstance(cause, OccupiedError):
                with suppress(OSError):  # the disk may be full
                    (output_dir / FAILED).write_text(traceback.format_exc())
            if hydra_config.mode == RunMode.MULTIRUN or cause is None:
                raise
            log.error("%s", _sentence(cause))
            sys.exit(1)

    return job


def _prepare_machine(threads: int | None) -> None:
    """``prepare_machine``; raises SceneError for a number of threads that a machine like this one is not given."""
    from heatsplat.runs.checks import check_threads

    check_threads(threads)
    prepare_machine(threads)


def _write_down(config: DictConfig, hydra_config: DictConfig, folder: Path) -> None:
    """Writes what was composed, as Hydra would before it is known whether the folder holds another run."""
    from heatsplat.io.results import write_atomically

    written = {"config": config, "hydra": {"hydra": hydra_config}, "overrides": hydra_config.overrides.task}
    for name, content in written.items():
        write_atomically(folder / f"{name}.yaml", OmegaConf.to_yaml(content))


def _sentence(error: BaseException) -> str:
    """What is printed of an error that is the user's to mend."""
    remedy = NO_PLACE.get(error.errno) if isinstance(error, OSError) else None
    if remedy is None:
        return f"{type(error).__name__}: {error}"
    return f"{error.filename}: {error.strerror}; {remedy}" if error.filename else f"{error.strerror}; {remedy}"


def _expected(error: BaseException) -> BaseException | None:
    """The error behind ``error`` that is the user's to mend and needs no traceback, or None."""
    from heatsplat.contracts import SceneError

    while error is not None:
        if isinstance(error, SceneError | FileNotFoundError | ImportError | FloatingPointError):
            return error
        if isinstance(error, OSError) and error.errno in NO_PLACE:
            return error
        if isinstance(error, ValueError) and _raised_here(error):  # of a setting, once the scene is known
            return error
        error = error.__cause__
    return None


def _raised_here(error: BaseException) -> bool:
    """Whether code of this package raised an error, and not a library that it called."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return bool(frames) and frames[-1].f_globals.get("__name__", "").startswith(("heatsplat.", "datamodules."))


def _of_settings(error: TypeError) -> bool:
    """Whether a class or function did not take settings, or a constructor of ours itself stumbled over one."""
    *_, last = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    called = last.f_globals.get("__name__", "").startswith("hydra.")  # and never entered
    return called or (_raised_here(error) and last.f_code.co_name == "__init__")


@_command
@_job
def train(config: dict[str, Any], output_dir: Path) -> float | None:
    """Trains a method on a scene, tests it and writes the report. Returns the test PSNR, for sweepers."""
    from heatsplat.contracts import SceneError
    from heatsplat.runs.run import complete

    if (chosen := HydraConfig.get().runtime.choices.study) is not None:
        raise SceneError(f"a study has a command of its own: python src/study.py study={chosen}")
    launcher = HydraConfig.get().runtime.choices.launcher
    if launcher not in (None, "basic") and HydraConfig.get().mode != RunMode.MULTIRUN:
        log.warning("launcher=%s starts the jobs of a sweep; this single run trains right here: add -m", launcher)
    if (first := config.get("table", {}).get("after")) is not None:
        check_first(first)
    return complete(config, output_dir).test.get("psnr")


def check_first(ckpt: str) -> None:
    """Raises SceneError where the run that wrote a checkpoint, and after which another comes, has no results."""
    from heatsplat.contracts import SceneError
    from heatsplat.io.results import METRICS_FILE
    from heatsplat.studies.finished import reason_of

    folder = Path(run_of(ckpt))
    if not (folder / METRICS_FILE).exists():
        raise SceneError(f"the run that comes before this one has no results: {reason_of(folder)} (in {folder})")


def check_vacant(config: DictConfig, output_dir: Path) -> None:
    """Raises OccupiedError where results are in a folder, or it is that of the run that wrote the checkpoint."""
    from heatsplat.io.results import METRICS_FILE
    from heatsplat.runs.lock import OccupiedError

    if (output_dir / METRICS_FILE).exists() or output_dir.resolve() == Path(run_of(config["ckpt"])):
        raise OccupiedError(
            f"{output_dir} holds a run or results, which would be lost: give another folder with hydra.run.dir, or leave that out"
        )


@_command
@functools.partial(_job, check=check_vacant)
def evaluate(config: dict[str, Any], output_dir: Path) -> float | None:
    """Measures the test views of a checkpoint. Returns the test PSNR."""
    from heatsplat.runs.device import device_of
    from heatsplat.runs.run import build_trainer, load

    _prepare_machine(config["threads"])
    trained = load(config["ckpt"], config["data"], output_dir=output_dir, trust=config["trust"])
    own = "auto" if "backend" in trained.config["renderer"] else None  # not the backend of the machine that trained it
    device = device_of(config["accelerator"], {"backend": own})
    trainer = build_trainer(trained.config["trainer"] | {"accelerator": device}, config, output_dir)
    trainer.test(trained.module, datamodule=trained.data, verbose=False)
    return trained.module.results.test.get("psnr")


@_command
@_job
def render(config: dict[str, Any], output_dir: Path) -> None:
    """Renders a shot of a checkpoint's scene to TIFF, PNG and video."""
    from rich.progress import track

    from heatsplat.contracts import SceneError, check_numbers, check_option
    from heatsplat.export.formats.base import checked_range
    from heatsplat.io.video import CODECS, encoder
    from heatsplat.runs.run import load
    from heatsplat.shots import check_shot, checked_unseen, shot_frames, warn_beyond_record, write_shot
    from heatsplat.uncertainty import Uncertainty

    shot = {key: config[key] for key in ("trajectory", "time", "view")} | {"count": config["frames"]}
    check_shot(**shot)
    checked_range(config["range_c"], "range_c")
    check_numbers("fps", config["fps"], error=SceneError)
    if config["fps"] <= 0:
        raise SceneError(f"fps must be above 0, got {config['fps']}")
    names = [config["images"]] if isinstance(config["images"], str) else config["images"]
    if not isinstance(names, list) or not names:
        raise SceneError(f"images must be all, or one or a list of recorded, clean and rgb, got {config['images']}")
    keep = checked_unseen("unseen", config["unseen"]) == "keep"
    check_option("codec", config["codec"], CODECS, SceneError)
    check_option("figures", config["figures"], (None, "pdf", "svg"), SceneError)
    if config["video"]:
        encoder(config["codec"])  # what is missing is told before anything is rendered
    _prepare_machine(config["threads"])
    trained = load(
        config["ckpt"], config["data"], config["weather"], config["weather_zone"], output_dir, config["trust"]
    )
    frames = shot_frames(trained.scene, **shot)
    warn_beyond_record(trained.scene, frames, trained.module.thermal.beyond_record)
    for name in names:
        check_option("images", name, ("all", *trained.image_names), SceneError)
    names = trained.image_names if "all" in names else names
    images = (
        (trained.images(frame, names), None if keep else trained.seen(frame)) for frame in track(frames, "rendering")
    )
    options = {key: config[key] for key in ("tiff", "png", "video", "fps", "range_c", "codec", "figures")}
    if config["uncertainty"]:
        told = Uncertainty(trained.module)
        options |= {"deviation": told.deviation, "widest": told.widest}
    written = write_shot(images, frames, trained.scene, output_dir, **options)
    log.info("%d frames, %d files in %s", len(frames), len(written), output_dir)


@_command
@_job
def simplify(config: dict[str, Any], output_dir: Path) -> None:
    """Merges the Gaussians of a checkpoint into fewer: a checkpoint and a PLY for each level of detail."""
    from heatsplat.contracts import SceneError, check_numbers
    from heatsplat.export.files import write_file
    from heatsplat.export.formats.ply import Ply
    from heatsplat.export.moment import moments_in
    from heatsplat.export.snapshot import span_of
    from heatsplat.runs.levels import write_levels
    from heatsplat.runs.run import load

    if HydraConfig.get().runtime.choices.merge == "none":
        raise SceneError("merge=none merges nothing: leave it out, or give merge=flat")
    if config["time"] is not None:
        check_numbers("time", config["time"], error=SceneError)
    _prepare_machine(config["threads"])
    trained = load(config["ckpt"], config["data"], output_dir=output_dir, trust=config["trust"])
    merging, write_ply = build(config["merge"]), None
    if config["ply"]:
        moments_in(trained.scene, span_of(trained.scene), config["time"])  # refused before a long search
        write_ply = functools.partial(write_file, trained.module, Ply(), time_s=config["time"])
    written = write_levels(trained, merging, config["levels_c"], output_dir, write_ply)
    log.info("%d files in %s", len(written), output_dir)


@_command
@_job
def view(config: dict[str, Any], output_dir: Path) -> None:
    """Writes viewer.html of a checkpoint's scene, which a browser opens offline."""
    from heatsplat.runs.run import load
    from heatsplat.viewer.page import FILE, checked_cameras, write_viewer

    _prepare_machine(config["threads"])
    cameras = checked_cameras(config["cameras"])
    trained = load(
        config["ckpt"], config["data"], config["weather"], config["weather_zone"], output_dir, config["trust"]
    )
    path = write_viewer(trained.module, output_dir / FILE, cameras)
    log.info("%s (%.1f MB): open it in a browser", path, path.stat().st_size / 1e6)


@_command
@_job
def export(config: dict[str, Any], output_dir: Path) -> None:
    """Writes a checkpoint's scene at a moment as a file of another program: splats, points, map, mesh.

    Raises:
        SceneError: no format is chosen.
    """
    from heatsplat.contracts import SceneError, check_option
    from heatsplat.export.files import write_files
    from heatsplat.export.moment import LAYERS
    from heatsplat.runs.run import load
    from heatsplat.shots import checked_times

    if config.get("what") is None:
        raise SceneError(f"which format? Give what=..., one of {', '.join(_options('what'))}")
    check_option("layer", config["layer"], LAYERS, SceneError)
    if config["time"] is not None:
        checked_times(config["time"])
    _prepare_machine(config["threads"])
    form = build(config["what"])
    trained = load(
        config["ckpt"], config["data"], config["weather"], config["weather_zone"], output_dir, config["trust"]
    )
    for path in write_files(trained.module, form, output_dir, config["time"], config["layer"]):
        log.info("%s (%.1f MB)", path, path.stat().st_size / 1e6)


@_command
@_job
def study(config: dict[str, Any], output_dir: Path) -> None:
    """Runs a study; its tables and pictures lie in the run's folder.

    Raises:
        SceneError: none is chosen, or it is one of the benchmarks, which are not installed.
    """
    from heatsplat.contracts import SceneError

    if config["study"] is None:
        there = sorted(path.stem for path in Path(CONF, "study").glob("*.yaml"))
        raise SceneError(f"which study? Give study=..., one of {', '.join(there)}")
    if config["study"]["_target_"].startswith("benchmarks.") and find_spec("benchmarks") is None:
        name = HydraConfig.get().runtime.choices.study
        raise SceneError(
            f"study={name} is a benchmark of the source checkout: run python src/study.py study={name} in a clone of it"
        )
    _prepare_machine(config["threads"])
    build(config["study"], output_dir=output_dir)
    log.info("%s", output_dir)


@_command
@_job
def prepare(config: dict[str, Any], output_dir: Path) -> None:
    """Makes a scene that trains of a camera's files, or corrects a trained scene pixel by pixel (correct=scene)."""
    from heatsplat.contracts import SceneError

    if config["check"] is not None:
        _prepare_machine(config["threads"])
        build(config["examination"], target=None if config["target"] is None else output_dir)
        return
    if config["target"] is None or (config["source"] is None and config.get("correct") is None):
        raise SceneError("give the folder of the camera's files and that of the scene: source=FOLDER target=FOLDER")
    _prepare_machine(config["threads"])
    try:
        build(config.get("correct") or config["preparation"], target=output_dir)
    except KeyboardInterrupt:
        log.warning("stopped; what is done lies in %s, and the same command goes on", output_dir)
        sys.exit(128 + signal.SIGINT)
