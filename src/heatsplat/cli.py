"""The command line: Hydra composes a configuration, one job runs, and what fails is told in a sentence.

What brings torch is imported within a job, so that --help, --cfg and typing errors answer at once.
"""

from __future__ import annotations

import functools
import io
import logging
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from heatsplat.composition import CONF, build, options_of, plain, run_of
from heatsplat.errors import SceneError, as_written, check_count, check_numbers, check_option, counted
from heatsplat.explanations import expected, explain, sentence
from heatsplat.io.command_lines import with_names
from heatsplat.io.files import size_told, utf8, write_atomically
from heatsplat.io.results import FAILED, METRICS_FILE
from heatsplat.runs.lock import LOCK_FILE, OccupiedError, locked
from heatsplat.runs.signals import stoppable
from heatsplat.training.machine import clear_away, loading, prepare_machine
from heatsplat.usage import usage

if TYPE_CHECKING:
    from heatsplat.runs.run import Trained

log = logging.getLogger("heatsplat")

ALL_OF_IT = "HYDRA_FULL_ERROR"  # the environment variable with which errors come with all that Hydra knows of them

# Flags of Hydra; all else is a setting.
ALONE = (
    "--help", "-h", "--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m", "--shell-completion", "-sc",
)  # fmt: skip
WITH_VALUE = (
    "--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd",
    "--experimental-rerun", "--info", "-i",
)  # fmt: skip
OPTIONAL = ("--info", "-i")  # whose value may be missing

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
        _print_what_can_be()
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
        sys.argv[1:] = _settings_first(sys.argv[1:])
        all_of_it = ALL_OF_IT in os.environ
        os.environ[ALL_OF_IT] = "1"  # Hydra raises what it would print otherwise
        try:
            try:
                if not {"--help", "-h"}.isdisjoint(sys.argv[1:]):
                    print(usage(name, job.__doc__ or "", sys.argv[1:]))
                    return None
                return main()
            finally:
                sys.stdout.flush()  # here, where a reader that has gone is no error, not when Python ends
        except BrokenPipeError:  # as of --help | head
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has no reader
            sys.exit(128 + 13)  # SIGPIPE, which Windows does not have
        except KeyboardInterrupt:  # where no checkpoint can be written yet, or any more
            if all_of_it:
                raise
            print("Interrupted.", file=sys.stderr)
            sys.exit(128 + signal.SIGINT)
        except Exception as error:  # of Hydra, or of a job of a sweep, when all others have run
            told = None if all_of_it else explain(error, name, sys.argv[1:])
            if told is None:
                raise
            sys.exit(told)
        finally:
            if not all_of_it:
                del os.environ[ALL_OF_IT]

    return command


def _settings_first(arguments: Sequence[str]) -> list[str]:
    """The arguments as Hydra takes them: settings have to stand together, flags with their values follow, and names that look
    like numbers are quoted.

    Raises:
        SystemExit: there is no such flag, as of --seed=1; with a sentence.
    """
    settings, flags, left = [], [], list(arguments)
    while left:
        word = left.pop(0)
        if not word.startswith("-"):
            settings.append(word)
            continue
        name, given, _ = word.partition("=")
        full = name[:2] == "--"  # may be cut short
        known = next((flag for flag in (*ALONE, *WITH_VALUE) if flag == name or (full and flag.startswith(name))), None)
        if known is None:
            meant = word.lstrip("-") if given else f"{name.lstrip('-')}=..."
            sys.exit(f"{name} is no flag of this command: settings have no dashes, as in {meant} (--help lists them)")
        flags.append(word)
        if known in WITH_VALUE and not given and left and not (known in OPTIONAL and "=" in left[0]):
            flags.append(left.pop(0))
    return [*with_names(settings), *flags]


def _print_what_can_be() -> None:
    """Has standard output spell out what its encoding lacks, as standard error does: on Windows a pipe or a file may know no τ or
    dash, and a run would end at its table."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _job(
    work: Callable[[dict[str, Any], Path], Any], check: Callable[[DictConfig, Path], None] | None = None
) -> Callable[[DictConfig], Any]:
    """Runs ``work(config, output_dir)`` so that a failure leaves a FAILED file and a readable message.

    The configuration comes as plain containers (``composition.plain``). ``check`` may raise OccupiedError: it comes before
    anything in the folder is changed.

    In a sweep the exception goes on to Hydra, which runs the other jobs; a single run ends with exit code 1. Where it was refused
    before it wrote anything, it leaves no folder, unless that was given a name.
    """

    @functools.wraps(work)
    def job(config: DictConfig) -> Any:
        _print_what_can_be()  # here, too, as a launcher's processes begin here
        hydra_config = HydraConfig.get()
        output_dir = Path(hydra_config.runtime.output_dir)
        try:
            with locked(output_dir), stoppable():
                if check is not None:
                    check(config, output_dir)
                (output_dir / FAILED).unlink(missing_ok=True)
                _warn_of_folders(hydra_config)
                if not (output_dir / METRICS_FILE).exists():
                    _write_down(config, hydra_config, output_dir / ".hydra")
                return work(plain(config, hydra_config.overrides.task), output_dir)
        except Exception as error:
            cause = expected(error)
            if not isinstance(cause, OccupiedError):
                with suppress(OSError):  # the disk may be full
                    (output_dir / FAILED).write_bytes(utf8(traceback.format_exc()))
            if hydra_config.mode == RunMode.MULTIRUN or cause is None:
                raise
            log.error("%s", sentence(cause))
            if "${now:" in OmegaConf.to_container(hydra_config.run, resolve=False)["dir"]:  # it was not there before
                _remove_unused(output_dir, f"{hydra_config.job.name}.log")
            sys.exit(1)

    return job


def _warn_of_folders(hydra_config: DictConfig) -> None:
    """Warns of a folder that was given and is not used: that of a sweep for a single run, or the other way round."""
    given = {text.lstrip("+").partition("=")[0] for text in hydra_config.overrides.hydra}
    sweep = hydra_config.mode == RunMode.MULTIRUN
    idle, used = ("hydra.run.dir", "hydra.sweep.dir") if sweep else ("hydra.sweep.dir", "hydra.run.dir")
    if idle in given and used not in given:
        what = "the jobs of a sweep write" if sweep else "a single run (without -m) writes"
        log.warning("%s is not used: %s to %s=", idle, what, used)


def _remove_unused(folder: Path, log_file: str) -> None:
    """Removes the folder of a job, and the one around it where it was the first in there, if nothing lies in it but what every
    job leaves."""
    if not {path.name for path in folder.iterdir()} <= {".hydra", LOCK_FILE, log_file, FAILED}:
        return
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if isinstance(handler, logging.FileHandler) and Path(handler.baseFilename).parent == folder.resolve():
            root.removeHandler(handler)
            handler.close()
    with suppress(OSError):  # others lie beside it, or a file is in use
        shutil.rmtree(folder)
        folder.parent.rmdir()


def _prepare_machine(threads: int | None) -> None:
    """``prepare_machine``; raises SceneError for a number of threads that a machine like this one is not given."""
    from heatsplat.runs.checks import check_threads

    check_threads(threads)
    prepare_machine(threads)


def _load(config: dict[str, Any], output_dir: Path) -> Trained:
    """The trained scene of the checkpoint that a command was given, with the data and the weather that it was given."""
    with loading():
        from heatsplat.runs.run import load

    _prepare_machine(config["threads"])
    weather = {key: config[key] for key in ("weather", "weather_zone") if key in config}
    return load(config["ckpt"], config["data"], **weather, output_dir=output_dir, trust=config["trust"])


def _write_down(config: DictConfig, hydra_config: DictConfig, folder: Path) -> None:
    """Writes what was composed, as Hydra would before it is known whether the folder holds another run."""
    written = {"config": config, "hydra": {"hydra": hydra_config}, "overrides": hydra_config.overrides.task}
    for name, content in written.items():
        write_atomically(folder / f"{name}.yaml", OmegaConf.to_yaml(content))


def check_unfinished(config: DictConfig, output_dir: Path) -> None:
    """Raises OccupiedError where a folder holds checkpoints of an unfinished run with other settings (``resume.check_own``)."""
    if (output_dir / METRICS_FILE).exists() or not any((output_dir / "checkpoints").glob("*.ckpt")):
        return  # ``train_in`` compares results
    with loading():
        from heatsplat.runs.checks import checked
        from heatsplat.runs.resume import check_own

    check_own(checked(plain(config, HydraConfig.get().overrides.task)), output_dir)


@_command
@functools.partial(_job, check=check_unfinished)
def train(config: dict[str, Any], output_dir: Path) -> float | None:
    """Trains a method on a scene, tests it and writes the report. Returns the test PSNR, for sweepers."""
    with loading():
        from heatsplat.runs.run import train_in

    started = HydraConfig.get()
    if (chosen := started.runtime.choices.study) is not None:
        raise SceneError(f"a study has a command of its own: python src/study.py study={chosen}")
    sweep, launcher = started.mode == RunMode.MULTIRUN, started.runtime.choices.launcher
    if launcher not in (None, "basic") and not sweep:
        log.warning("launcher=%s starts the jobs of a sweep; this single run trains right here: add -m", launcher)
    if started.sweeper.get("rows") and not sweep:
        raise SceneError(
            "the rows of an ablation (hydra.sweeper.rows) are jobs of a sweep, and this is a single run: add -m, or write mode: "
            "MULTIRUN below hydra: in the file of the ablation"
        )
    if sweep:
        clear_away()
    if (first := config.get("table", {}).get("after")) is not None:
        check_first(first)
    return train_in(config, output_dir).test.get("psnr")


def check_first(ckpt: str) -> None:
    """Raises SceneError where the run that wrote a checkpoint, and after which another comes, has no results."""
    from heatsplat.studies.finished import reason_of

    folder = Path(run_of(ckpt))
    if not (folder / METRICS_FILE).exists():
        raise SceneError(f"the run that comes before this one has no results: {reason_of(folder)} (in {folder})")


def check_vacant(config: DictConfig, output_dir: Path) -> None:
    """Raises OccupiedError where results are in a folder, or it is that of the run that wrote the checkpoint."""
    if (output_dir / METRICS_FILE).exists() or output_dir.resolve() == Path(run_of(config["ckpt"])):
        raise OccupiedError(
            f"{output_dir} holds a run or results, which would be lost: give another folder with hydra.run.dir, or leave that out"
        )


@_command
@functools.partial(_job, check=check_vacant)
def evaluate(config: dict[str, Any], output_dir: Path) -> float | None:
    """Measures the test views of a checkpoint. Returns the test PSNR."""
    with loading():
        from heatsplat.runs.device import device_of
        from heatsplat.runs.run import build_trainer

    trained = _load(config, output_dir)
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

    from heatsplat.export.formats.base import checked_range
    from heatsplat.export.place import placed, unit_in_metres
    from heatsplat.io.pictures import checked_colormap, checked_contours, checked_isotherm
    from heatsplat.io.video import CODECS, encoder
    from heatsplat.shots import (
        ShotFiles,
        check_shot,
        checked_unseen,
        depth_beside,
        shot_frames,
        uncertainty_beside,
        warn_beyond_record,
        write_shot,
    )
    from heatsplat.uncertainty import Uncertainty

    shot = {key: config[key] for key in ("trajectory", "time", "view")} | {"count": config["frames"]}
    check_shot(**shot)
    given = config["camera_file"] is not None
    if given != (config["trajectory"] == "cameras") and not (given and config["trajectory"] == "path"):
        raise SceneError(
            f"trajectory={config['trajectory']} with camera_file={config['camera_file'] or 'null'}: cameras of a file are "
            "rendered by trajectory=cameras camera_file=FILE, or a smooth path through them by trajectory=path camera_file=FILE"
        )
    listed = build(config["listed"])
    checked_range(config["range_c"], "range_c")
    look = {
        "range_c": config["range_c"],
        "colormap": checked_colormap("colormap", config["colormap"]),
        "isotherm": checked_isotherm("isotherm", config["isotherm"]),
        "contours": checked_contours("contours", config["contours"]),
    }
    check_numbers("fps", config["fps"], error=SceneError, above=0)
    names = [config["images"]] if isinstance(config["images"], str) else config["images"]
    if not isinstance(names, list) or not names:
        raise SceneError(
            f"images must be all, or one or a list of recorded, clean and rgb, got {as_written(config['images'])}"
        )
    keep = checked_unseen("unseen", config["unseen"]) == "keep"
    check_option("codec", config["codec"], CODECS, SceneError)
    check_option("figures", config["figures"], (None, "pdf", "svg"), SceneError)
    if config["video"]:
        encoder(config["codec"])  # what is missing is told before anything is rendered
    trained = _load(config, output_dir)
    cameras = listed.in_scene(trained.scene)
    frames = shot_frames(trained.scene, **shot, finer=trained.module.supersample, cameras=cameras)
    warn_beyond_record(trained.scene, frames, trained.module.thermal.beyond_record)
    if "clean" in names and "clean" not in trained.image_names:
        log.info("images=clean: no sensor changes what is rendered, so that recorded images are clean")
        names = list(dict.fromkeys("recorded" if name == "clean" else name for name in names))
    for name in names:
        check_option("images", name, ("all", *trained.image_names), SceneError)
    names = trained.image_names if "all" in names else names
    images = (
        (trained.images(frame, names), None if keep else trained.seen(frame)) for frame in track(frames, "rendering")
    )
    kinds = {key: config[key] for key in ("tiff", "png", "video", "fps", "codec", "figures")}
    beside = []
    if config["uncertainty"]:
        uncertainty = Uncertainty(trained.module)
        beside.append(uncertainty_beside(trained.scene, uncertainty.deviation, uncertainty.widest))
    if config["depth"]:
        metres = unit_in_metres(trained.scene, placed(trained.scene))
        beside.append(depth_beside(trained.scene, trained.depth, frames, metres))
    files = ShotFiles(output_dir, **kinds)
    written = write_shot(images, frames, trained.scene, files, titles=trained.image_titles, beside=beside, **look)
    log.info("%s, %s in %s", counted(len(frames), "frame"), counted(len(written), "file"), output_dir)


@_command
@_job
def simplify(config: dict[str, Any], output_dir: Path) -> None:
    """Merges the Gaussians of a checkpoint into fewer: a checkpoint and a PLY for each level of detail."""
    from heatsplat.export.files import write_file
    from heatsplat.export.formats.ply import Ply
    from heatsplat.export.moment import moments_in
    from heatsplat.export.snapshot import span_of
    from heatsplat.runs.levels import write_levels
    from heatsplat.shots import checked_times

    if HydraConfig.get().runtime.choices.merge == "none":
        raise SceneError("merge=none merges nothing: leave it out, or give merge=flat")
    if config["time"] is not None and len(checked_times(config["time"])) > 1:
        raise SceneError(f"time must be one moment, got {list(config['time'])}")
    trained = _load(config, output_dir)
    merging, write_ply = build(config["merge"]), None
    if config["ply"]:
        moments_in(trained.scene, span_of(trained.scene), config["time"])  # refused before a long search
        write_ply = functools.partial(write_file, trained.module, Ply(), time=config["time"])
    written = write_levels(trained, merging, config["levels_c"], output_dir, write_ply)
    log.info("%s in %s", counted(len(written), "file"), output_dir)


@_command
@_job
def view(config: dict[str, Any], output_dir: Path) -> None:
    """Writes viewer.html of a checkpoint's scene, which a browser opens offline."""
    from heatsplat.viewer.page import FILE, write_viewer

    check_count("training_cameras", config["training_cameras"])
    trained = _load(config, output_dir)
    path = write_viewer(trained.module, output_dir / FILE, config["training_cameras"])
    log.info("%s (%s): open it in a browser", path, size_told(path.stat().st_size))


@_command
@_job
def export(config: dict[str, Any], output_dir: Path) -> None:
    """Writes a checkpoint's scene at a moment as a file of another program: splats, points, map, mesh.

    Raises:
        SceneError: no format is chosen.
    """
    from heatsplat.export.files import write_files
    from heatsplat.export.moment import LAYERS, checked_box
    from heatsplat.shots import checked_times

    if config.get("what") is None:
        raise SceneError(f"which format? Give what=..., one of {', '.join(options_of('what'))}")
    check_option("layer", config["layer"], LAYERS, SceneError)
    if config["time"] is not None:
        checked_times(config["time"])
    box, form = checked_box("box", config["box"]), build(config["what"])
    if box is not None and not form.of_gaussians:
        raise SceneError(
            "box cuts out of what=gltf, las, npz, ply and spz, and of a mesh that is made: a map has what.bounds, and a mesh of "
            "your own (what.mesh) is yours to cut"
        )
    trained = _load(config, output_dir)
    for path in write_files(trained.module, form, output_dir, config["time"], config["layer"], box):
        log.info("%s (%s)", path, size_told(path.stat().st_size))


@_command
@_job
def study(config: dict[str, Any], output_dir: Path) -> None:
    """Runs a study; its tables and pictures lie in the run's folder.

    Raises:
        SceneError: none is chosen, or it is one of the benchmarks, which are not installed.
    """
    if config["study"] is None:
        raise SceneError(f"which study? Give study=..., one of {', '.join(options_of('study'))}")
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
