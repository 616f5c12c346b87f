"""One run: its configuration made ready step by step, its parts built from it, training, and what is made of a checkpoint.

A configuration is a dict of plain containers, and every step of ``begin`` returns another one.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from heatsplat.composition import build, scene_name
from heatsplat.contracts import Camera, Frame, SceneData, SceneError, check_numbers, check_option
from heatsplat.doctor.examination import FINDINGS_FILE, warn_of, write_findings
from heatsplat.geometry.coverage import Sighting, covered
from heatsplat.io.results import RunResults, checkpoint_of
from heatsplat.runs.budget import budgeted
from heatsplat.runs.checks import check_copied, check_last_stage, check_threads, checked
from heatsplat.runs.declared import declared
from heatsplat.runs.device import device_of
from heatsplat.runs.folder import results_in
from heatsplat.runs.lock import locked
from heatsplat.runs.resume import completed, on_scene, resumed, stored_config
from heatsplat.runs.trust import trusted
from heatsplat.runs.verdicts import decided, with_verdicts
from heatsplat.shots import UNSEEN, at_time, first_free_id, sightings, warn_beyond_record
from heatsplat.training.checkpoints import CheckpointFiles, load_checkpoint
from heatsplat.training.loop import lean, without_idle_hooks
from heatsplat.training.machine import prepare_machine
from heatsplat.training.module import CHECKPOINT_KEY, SplatTraining
from heatsplat.training.scales import on_scales
from heatsplat.training.session import fit, restore

log = logging.getLogger("heatsplat")

SMALL = 16  # pixels


@dataclass(frozen=True)
class Run:
    """The parts of a run, built.

    Args:
        config: what they were built from; its ``ckpt`` is where training goes on.
        module, data, trainer: Lightning's.
    """

    config: dict[str, Any]
    module: SplatTraining
    data: Any
    trainer: Any


def train(config: dict[str, Any], output_dir: Path | str | None = None) -> RunResults:
    """Trains a method on a scene, tests it and writes the report; what was measured.

    A run that was stopped in this folder goes on from its last checkpoint; one that is finished is not trained again.

    Args:
        config: of ``heatsplat.compose``.
        output_dir: folder of the run; None for outputs/<method>_<scene>/<time> in the working directory.

    Raises:
        SceneError: the configuration or the scene cannot be trained, with the remedy.
        OccupiedError: the folder holds results of other settings, or another process trains in it.
        TypeError: the configuration is none.
    """
    if not isinstance(config, dict) or "module" not in config:
        raise TypeError(f"train takes a configuration, such as heatsplat.compose(['method=etgs']), got {config!r}")
    check_copied(config)
    if output_dir is None:
        data = config["data"]
        scene = scene_name("data", data.get("root"), data.get("scene"))
        output_dir = Path("outputs") / f"{config['name']}_{scene}" / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    with locked(Path(output_dir)):
        return train_in(config, Path(output_dir))


def train_in(config: dict[str, Any], output_dir: Path) -> RunResults:
    """As ``train``, in a folder that is kept from other processes."""
    results = results_in(output_dir, config)
    if results is not None:
        log.info("%s has results already; skipped. Delete the folder to run it again.", output_dir)
        return results
    composed, config, data = _opened(config, output_dir)
    # Before the search for effects, which may take minutes; written down once nothing refuses the run any more.
    found = warn_of(data.scene) if config["doctor"] and config["ckpt"] is None else []
    run = _planned(composed, config, data, output_dir)
    if found:
        write_findings(found, output_dir / FINDINGS_FILE)
    return fit(run.module, run.data, run.trainer, ckpt=run.config["ckpt"], test=run.config["test"])


def begin(config: dict[str, Any], output_dir: Path) -> Run:
    """A run that is ready to train."""
    return _planned(*_opened(config, output_dir), output_dir)


def _opened(config: dict[str, Any], output_dir: Path) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """A configuration as it was composed and as it goes on, and the data that it names."""
    check_threads(config["threads"])
    prepare_machine(config["threads"])
    composed = checked(config)
    config = resumed(composed, output_dir)
    data = build(config["data"])
    return composed, on_scene(config, data.scene), data


def _planned(composed: dict[str, Any], config: dict[str, Any], data: Any, output_dir: Path) -> Run:
    """The run that an opened configuration describes, with what its scene decides."""
    config = decided(config, data.scene)
    config = budgeted(config, data.scene)
    check_last_stage(config)
    config = with_verdicts(config)
    config = completed(config, composed)
    module = build_module(config, output_dir)
    device = device_of(config["trainer"]["accelerator"], config["renderer"])
    return Run(config, module, data, build_trainer(config["trainer"] | {"accelerator": device}, config, output_dir))


def build_module(config: dict[str, Any], output_dir: Path) -> SplatTraining:
    """The training module that a configuration describes, which takes it into its checkpoints."""
    module = without_idle_hooks(build(config["module"], output_dir=str(output_dir)))
    module.config = config  # set, not passed: Hydra would build every part in it once more
    return module


def build_trainer(trainer: Mapping[str, Any], watching: Mapping[str, Any], output_dir: Path) -> Any:
    """The trainer of a configuration, with the callbacks and loggers of ``watching``, which write into the run's folder."""
    callbacks = build_callbacks(watching["callbacks"], output_dir)
    plugins = [*(trainer.get("plugins") or ()), CheckpointFiles()]
    places = {"default_root_dir": str(output_dir), "plugins": plugins}
    built = build(
        dict(trainer), callbacks=callbacks, logger=build_loggers(watching.get("logger"), output_dir), **places
    )
    lean(built)
    return built


def build_loggers(logger: Mapping[str, Any] | Sequence[Any] | None, output_dir: Path) -> list[Any]:
    """The loggers of a configuration: of one, of a list or of a mapping of several by name. Those that take a ``save_dir`` write
    into the run's folder."""
    if not logger:
        return []
    several = [logger] if "_target_" in logger else logger.values() if isinstance(logger, Mapping) else logger

    def placed(settings: Mapping[str, Any]) -> dict[str, Any]:
        names = declared(str(settings["_target_"])).names
        return {**settings, "save_dir": str(output_dir)} if names is None or "save_dir" in names else dict(settings)

    return [build(placed(settings)) for settings in several if settings is not None]


def build_callbacks(callbacks: Mapping[str, Any], output_dir: Path) -> list[Any]:
    """The callbacks that are on; ``callbacks.<name>=null`` leaves one out. Where one writes lies in the run's folder."""
    on = {name: dict(settings) for name, settings in callbacks.items() if settings is not None}
    for settings in on.values():
        if "dirpath" in settings:
            settings["dirpath"] = str(output_dir / settings["dirpath"])
    return [without_idle_hooks(callback) for callback in build(on).values()]


@dataclass
class Trained:
    """A trained scene, to look at from anywhere and at any time.

    Args:
        config: of the run, with the data that were asked for in place of its own.
        module: with the weights of the checkpoint.
        data: its data module.
        checkpoint: all of it.
    """

    config: dict[str, Any] = field(repr=False)  # pages of text, as the checkpoint is
    module: SplatTraining
    data: Any
    checkpoint: dict[str, Any] = field(repr=False)
    _warned: bool = field(default=False, init=False, repr=False, compare=False)  # of moments beyond the record

    @property
    def scene(self) -> SceneData:
        """Its training, validation and test views, thermal range and metadata."""
        return self.data.scene

    def render(self, camera: Camera | Frame, time_s: float | None = None, unseen: str = "nan") -> Tensor:
        """Temperatures in °C [H, W], or image values in [0, 1] where there are none; of images with several channels [H, W, C].

        Without gradients; ``module.render`` has them. The first moment beyond the training record is warned of: it is a
        prediction.

        Args:
            camera: where from; a frame of the scene (``scene.test.frames[0]``) has a camera and a time of its own.
            time_s: seconds since the first training frame; None for the frame's own.
            unseen: "nan" for pixels that show what no training view has seen, "keep" for what the model makes of them.

        Raises:
            SceneError: the scene's weather is not known at that time.
            TypeError: ``camera`` is neither a camera nor a frame, such as a view.
            ValueError: ``unseen`` is neither, or ``time_s`` is no finite number.
        """
        check_option("unseen", unseen, UNSEEN)
        if not isinstance(camera, Camera | Frame):
            raise TypeError(
                f"camera must be a Camera or a Frame, such as scene.test.frames[0] or view.frame, got {type(camera).__name__}"
            )
        if isinstance(time_s, Tensor) and time_s.numel() == 1:
            time_s = time_s.item()
        if time_s is not None:
            check_numbers("time_s", time_s)
        frame = camera if isinstance(camera, Frame) else Frame("view", first_free_id(self.scene), camera)
        frame = frame if time_s is None else at_time(self.scene, frame, time_s)
        self._warned = self._warned or warn_beyond_record(self.scene, [frame], self.module.thermal.beyond_record)
        image = self.module.predict(self._at_its_moment(frame)).cpu()
        bounds = self.scene.range_of(self.module.modality)
        if bounds is not None and image.shape[2] == 1:
            image = bounds.to_celsius(image)
        image = image if unseen == "keep" else image.where(self.seen(frame)[..., None], torch.nan)
        return image[..., 0] if image.shape[2] == 1 else image

    @property
    def image_names(self) -> tuple[str, ...]:
        """What ``images`` has: "recorded", "clean" where the camera changes it, others of the model such as "rgb"."""
        clean = ("clean",) if self.module.sensor.parts else ()
        return ("recorded", *clean, *self.module.thermal.companions)

    @property
    def image_titles(self) -> dict[str, str]:
        """What those of ``image_names`` are in a picture: all are rendered, though "recorded" is what the camera would record."""
        if not self.module.sensor.parts:
            return {"recorded": "render"}
        return {"recorded": "render, with the sensor's flaws", "clean": "render, without the sensor's flaws"}

    def images(self, frame: Frame, names: Sequence[str]) -> dict[str, Tensor]:
        """Images [H, W, C] in [0, 1] of a frame by name, on the CPU."""
        found = self.module.predict_all(self._at_its_moment(frame))
        found["recorded"] = found[self.module.modality]
        return {name: found[name].cpu() for name in names}

    @torch.no_grad()
    def seen(self, frame: Frame) -> Tensor:
        """Which pixels of the image of a frame show what some training view has seen, [H, W] bool (``geometry.coverage``)."""
        frame = replace(frame, camera=self.module.cameras.of(frame))
        return covered(frame.camera, self.module.surface(frame), self._sightings)

    def depth(self, frame: Frame) -> Tensor:
        """Camera z [H, W] of the surface in a frame, in world units; infinite where there is none (``SceneModel.surface``)."""
        return self.module.surface(frame)

    @torch.no_grad()
    def _at_its_moment(self, frame: Frame) -> Frame:
        """The frame; of a training camera at another moment than its image one that is no training image. What the model knows of
        that image, such as how far the camera had drifted, is not true then; where the camera stood is."""
        if self._taken_s.get(frame.frame_id) in (None, frame.time_s):
            return frame
        return replace(frame, camera=self.module.cameras.of(frame), frame_id=first_free_id(self.scene))

    @cached_property
    def _taken_s(self) -> dict[int, float | None]:
        return {frame.frame_id: frame.time_s for frame in self.scene.train.frames}

    @cached_property
    def _sightings(self) -> list[Sighting]:
        return sightings(self.scene, self.module.surface)


def load(
    checkpoint: Path | str | None,
    data: Mapping[str, Any] | None = None,
    weather: Path | str | None = None,
    weather_zone: str | None = None,
    output_dir: Path | str = ".",
    trust: Sequence[str | type] | str | type = (),
) -> Trained:
    """The trained scene of a checkpoint, on the clock and with the bounds of its run (``training.scales``).

    Args:
        checkpoint: such as outputs/<run>/checkpoints/last.ckpt; outputs/<run> means that file.
        data: settings of the data that differ from training, such as {"root": "/elsewhere"}; None keeps a setting, "null" is
            none.
        weather: table of another weather for the scene's place and times.
        weather_zone: zone of its times where they have no offset.
        output_dir: folder for what is measured of it.
        trust: classes of yours that the checkpoint may name, or one of them: themselves or their names, fully dotted
            (``runs.trust.trusted``).

    Raises:
        SceneError: there is no checkpoint of a run, it names classes that are not known, its data are not those of training any
            more (``training.trained_frames``), or its method or data set has no weather to change.
    """
    if checkpoint is None:
        raise SceneError("which checkpoint? Give ckpt=outputs/<run>/checkpoints/last.ckpt")
    checkpoint = checkpoint_of(checkpoint)
    loaded = load_checkpoint(checkpoint)
    config = trusted(stored_config(loaded), checkpoint, _names(trust))
    if not {"module", "data"} <= config.keys():
        raise SceneError(f"{checkpoint} was not written by heatsplat")
    changed = _changed(config["data"], data or {})
    with _naming(checkpoint):
        module = build_module(config, Path(output_dir))
    if weather is not None and "weather" not in module.thermal.needs:
        raise SceneError(
            f"weather={weather} changes nothing: {type(module.thermal).__name__} does not use weather. Train a method that "
            "does, or leave weather out."
        )
    scene_data = build(config["data"] | changed)
    trained_on = config["data"].get("root")
    if trained_on is not None and "root" not in changed and not Path(trained_on).expanduser().exists():
        raise SceneError(
            f"{checkpoint}: its data are not at data.root={trained_on} any more; if they were moved, give the folder where they "
            "are now, data.root=FOLDER"
        )
    if weather is not None:
        scene_data.change_weather(Path(weather).expanduser().resolve(), weather_zone)
    with _naming(checkpoint, changed):
        _adopt(module, scene_data, loaded)
        _try_render(module, scene_data.scene.train.frames[0])
    return Trained(config, module, scene_data, loaded)


def _changed(of_training: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of the data that differ from training, as they are built with."""
    changed = {key: None if value == "null" else value for key, value in given.items() if value is not None}
    if "root" in changed:
        changed["root"] = str(Path(changed["root"]).expanduser().resolve())
    if changed.get("split", "list") != "list" and of_training.get("split_file"):
        changed = {"split_file": None} | changed  # which belongs to the rule of training
    if "weather" in changed and "weather" not in of_training:
        raise SceneError(f"data.weather={changed['weather']}: the data set of this checkpoint has no weather to choose")
    return changed


def _adopt(module: SplatTraining, scene_data: Any, loaded: Mapping[str, Any]) -> None:
    """Puts what a checkpoint holds into the module, and the scene on the scales of its run."""
    state, scales = loaded.get("state_dict", {}), loaded[CHECKPOINT_KEY].get("scales", {})
    per_frame = any(name.endswith("frame_ids") for name in state)
    numbered = any(name.endswith("by_index") and bool(value) for name, value in state.items())
    scene_data.scene = on_scales(scene_data.scene, scales, exactly=per_frame, numbered=numbered)
    restore(module, scene_data, loaded)
    if module.renderer.backend in ("cpu", "gsplat"):  # what the machine had on which it was trained
        module.renderer.backend = "auto"


def _names(trust: Sequence[str | type] | str | type) -> list[str]:
    classes = [trust] if isinstance(trust, str | type) else trust
    return [one if isinstance(one, str) else f"{one.__module__}.{one.__qualname__}" for one in classes]


@torch.no_grad()
def _try_render(module: SplatTraining, frame: Frame) -> None:
    """Renders a small image: only there do tensors meet that must fit each other."""
    module.render(replace(frame, camera=frame.camera.resized(SMALL, SMALL)))


@contextmanager
def _naming(checkpoint: Path | str, changed: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Errors of building from a checkpoint, in which anything may stand, name it, and the settings of its data that changed."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{checkpoint}: {error}") from error
    except Exception as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        absent = re.search(r"Error locating target '([\w.]+)'", said)
        if absent and not absent[1].startswith("heatsplat."):
            raise SceneError(
                f"{checkpoint} needs {absent[1]}, which Python does not find here: install its package, or set PYTHONPATH to the "
                "folder that holds it"
            ) from error
        if changed:
            told = ", ".join(f"data.{key}={value}" for key, value in changed.items())
            raise SceneError(
                f"{checkpoint} does not fit {told} ({said}): leave out what differs from training"
            ) from error
        raise SceneError(
            f"{checkpoint} does not fit this heatsplat ({said}): it is of another version, or not as heatsplat wrote it"
        ) from error
