"""The training of a scene: one view, one render, one loss, one step of one optimiser. It knows no variant by name."""

from __future__ import annotations

import logging
import operator
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Camera, Frame, RenderOutput, SceneData, SceneError, View
from heatsplat.density.base import DensityChange, DensityControl, Merging
from heatsplat.density.ops import Cloud
from heatsplat.geometry.resampling import with_what_lies_beyond
from heatsplat.io.results import RunResults
from heatsplat.losses.compose import Loss, LossInputs, known_target, pixel_errors, summands
from heatsplat.renderers.settings import Renderer
from heatsplat.renderers.smoothing import Smoothing
from heatsplat.sensors.base import Composite, SensorChain
from heatsplat.splats import ANCHORS, GAUSSIANS, NOTHING
from heatsplat.thermal.base import Rate, ThermalModel
from heatsplat.training.adam import load_waiting_gradients, waiting_gradients
from heatsplat.training.averaging import Average
from heatsplat.training.cameras import Cameras, check_sight
from heatsplat.training.init import Start
from heatsplat.training.loop import plain
from heatsplat.training.optimisation import Optimisation, penalties
from heatsplat.training.overlap import Overlap
from heatsplat.training.registered import check_registered, check_trained, warn_of_untrained
from heatsplat.training.resolution import Resolution, rendered
from heatsplat.training.rng import generator_for
from heatsplat.training.scales import check_same_scene, scales_of
from heatsplat.training.scene_model import SceneModel
from heatsplat.training.schedule import Schedule
from heatsplat.training.stages import Stages
from heatsplat.training.surroundings import Surroundings

log = logging.getLogger(__name__)

CHECKPOINT_KEY = "heatsplat"


class SplatTraining(SceneModel):
    """Trains splats with a thermal model on the views of a scene.

    Callbacks know, beside what is in ``SceneModel``, the parts below by their names, ``results`` (what metrics.json will hold),
    ``schedule`` (how far the run is, and when it ends) and ``density_change`` (what density control did in the last step, None
    for nothing).

    Args:
        thermal: what splats emit.
        renderer: how splats become pixels.
        sensor: what the camera does to the clean image.
        density: how many Gaussians there are.
        loss: what is minimised.
        init: how splats start.
        optim: learning rates and their decay.
        stages: which parameters are frozen at which steps, and where training begins anew; None: all train throughout.
        composite: in which quantity splats are blended; None: in image values, as they are.
        smoothing: what is done to Gaussians before they are projected; None: nothing.
        merging: what is done to Gaussians after training, before the test; None: nothing.
        resolution: how large images are over the run; None: full size throughout.
        overlap: what is done against many Gaussians in one pixel; None: nothing.
        cameras: from where training images were taken; None: from where the data say.
        surroundings: what Gaussians are told of the scene around them, of models that ask; None: once, before training.
        max_steps: planned length of a run.
        seed: seed of every random draw.
        supersample: how much finer than the training images training renders; the loss compares on their grid.
        dtype: "float32" or "float64", of splats, heat, sensor, loss and optimiser; what the renderer makes of it is said
            in ``Renderer``.
        output_dir: folder of the run.

    Raises:
        ValueError: the dtype is none of the two.
    """

    def __init__(
        self,
        thermal: ThermalModel,
        renderer: Renderer,
        sensor: SensorChain,
        density: DensityControl,
        loss: Loss,
        init: Start,
        optim: Optimisation,
        stages: Stages | None = None,
        composite: Composite | None = None,
        smoothing: Smoothing | None = None,
        merging: Merging | None = None,
        resolution: Resolution | None = None,
        overlap: Overlap | None = None,
        cameras: Cameras | None = None,
        surroundings: Surroundings | None = None,
        max_steps: int = 30_000,
        seed: int = 0,
        supersample: int = 1,
        dtype: str = "float32",
        output_dir: Path | str = ".",
    ) -> None:
        super().__init__(
            thermal, renderer, sensor, composite or Composite(), smoothing or Smoothing(), cameras or Cameras(), seed
        )
        self.density, self.loss, self.init, self.optim = density, loss, init, optim
        self.stages = stages or Stages({})
        self.schedule = Schedule(max_steps, self.stages.restarts)
        self.merging = merging or Merging()
        self.resolution = resolution or Resolution()
        self.overlap = overlap or Overlap()
        self.overlap.planned = self.schedule.planned
        self.surroundings = surroundings or Surroundings()
        self.output_dir = Path(output_dir)
        self.supersample = supersample
        if dtype not in ("float32", "float64"):
            raise ValueError(f"dtype must be float32 or float64, got '{dtype}'")
        self._wide = dtype == "float64"
        self.results = RunResults()
        self._density_state: dict[str, Tensor] = {}
        self.density_change: DensityChange | None = None
        self._rendered: tuple[RenderOutput, Camera] | None = None
        self._pixels = 0  # of the last target
        self._checked_trained = False  # after the first step, which may make parameters
        # Whether the last step updated; else its gradients wait, whatever a plan that was moved since says of it.
        self._updated = True
        self._average = Average()
        self._averaged = thermal.averaged if optim.averaged is None else optim.averaged
        self._waiting: dict[str, Any] = {}  # gradients of a checkpoint that was written between two updates

    # Set-up ------------------------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        """Builds splats from the scene of the trainer's data module, once."""
        if self.scene is None:
            self.attach(self.trainer.datamodule.scene)
        if stage == "fit":
            if self.thermal.rows != NOTHING:
                check_sight(self.scene, self.renderer.near)
            for name in self.thermal.companions:
                if not self.loss.compares(name):
                    log.warning("no term of loss.terms compares %s images: they are scored, but not learned", name)
            self.loss.check([self.schedule.progress(step) for step in range(self.schedule.steps)])
            self.results.data |= self.loss.prepare(self.scene, self.modality)
            held, stop = self.stages.held_from("means"), getattr(self.density, "stop", None)
            if stop is not None and held < min(stop, self.schedule.steps):
                log.warning(
                    "from step %d on a stage freezes where Gaussians lie: none comes or goes, though density control would until "
                    "step %d; give density.stop=%d, so that all of its plan is done before",
                    held, stop, held,
                )  # fmt: skip
            self.trainer.val_check_interval = self._between_resets(self.trainer.val_check_interval)

    def attach(self, scene: SceneData) -> None:
        """Builds all that depends on the scene. Refuses a scene that lacks what the thermal model needs."""
        self.thermal.check(scene)
        self._check_parts()
        self.scene = scene
        self.thermal.prepare(scene)
        self.sensor.prepare(scene, self.modality)
        self.composite.prepare(scene, self.modality)
        self.cameras.prepare(scene)
        self.splats, self._declared = self.init(scene, self.thermal, self.seed, self.density.cap_max)
        self.smoothing.prepare(scene, self.splats.means.detach())
        self.surroundings.prepare(scene, self.renderer, self.splats, self.composited)
        self.density.initial_count = len(self.splats)
        self.density.opacities_until = self.stages.held_from("opacity_logits")
        self.density.prepare(scene, self.modality)
        self.resolution.prepare(scene, [name for name, _ in self.thermal.images], self.composite, self.supersample)
        self._density_state = self.density.initial_state(len(self.splats), torch.device("cpu"))
        for name, statistic in self._density_state.items():
            if statistic.shape[:1] != (len(self.splats),):
                raise ValueError(
                    f"'{name}' of {type(self.density).__name__}.initial_state is {list(statistic.shape)}; it needs a row for "
                    f"each of the {len(self.splats)} Gaussians"
                )
        behind = [torch.full((count,), self.renderer.background_of(scene, name)) for name, count in self.thermal.images]
        self.register_buffer("background", self.composite.encode(torch.cat(behind), self.thermal.modality_channels[0]))
        if self._wide:  # float32 is how everything is made, and some of that is float64 on purpose
            self.double()
        self.merging.check(self)

    def _check_parts(self) -> None:
        """Raises SceneError where a part counts on rows of the splats that are something else to the thermal model."""
        rows, model = self.thermal.rows, type(self.thermal).__name__
        names = {GAUSSIANS: "Gaussians", ANCHORS: "anchors", NOTHING: "fields"}
        what = "is a field without Gaussians" if rows == NOTHING else f"has {names[rows]}"
        for name in ("density", "renderer", "init"):
            part = getattr(self, name)
            known = getattr(part, "rows", {GAUSSIANS})
            if rows not in known:
                raise SceneError(
                    f"{model} {what}, and {type(part).__name__} is for {' and '.join(names[row] for row in sorted(known))}: "
                    f"leave {name} to the method, and thermal with it"
                )
        if not self.resolution.whole and self.sensor.parts:
            raise SceneError(
                f"{type(self.resolution).__name__} takes single pixels out of images, which the parts of a sensor take for "
                f"neighbours ({', '.join(self.sensor.parts)}): give sensor=none, or schedule=off"
            )
        if not self.resolution.whole and rows != NOTHING:
            raise SceneError(
                f"{type(self.resolution).__name__} shows single pixels far apart, and {names[rows]} between them are never seen: "
                f"it is for fields, and {model} {what}; give schedule=off"
            )
        if rows != GAUSSIANS and self.smoothing.changes:
            raise SceneError(f"{model} {what}, which no filter of Gaussians in space knows: give smoothing=none")
        if rows not in self.overlap.rows:
            raise SceneError(
                f"{model} {what}, whose sizes {type(self.overlap).__name__} would reset: give overlap=none"
            )
        if rows == NOTHING and self.cameras.learns:
            raise SceneError(f"{model} {what}, whose rays carry no gradient to cameras: give cameras=given")
        if rows == NOTHING and self.optim.decoupled is not None:
            raise SceneError(f"{model} {what}, whose opacities and sizes optim.decoupled lets decay: give optim=adam")

    def on_fit_start(self) -> None:
        if self.trainer.world_size > 1:
            raise RuntimeError(
                f"one scene trains on one device, but trainer.devices asks for {self.trainer.world_size}. "
                "Use several devices by jobs side by side: add -m and launcher=joblib or launcher=slurm."
            )
        if self.trainer.precision != "32-true":
            raise SceneError(
                f"trainer.precision={self.trainer.precision} would convert what has a precision of its own, such as phases and "
                "times: leave it out, and give dtype=float64 for a run in double precision"
            )
        self._density_state = {name: tensor.to(self.device) for name, tensor in self._density_state.items()}

    def configure_optimizers(self):
        group = self.optim.group
        groups = self.optim.geometry_groups(self.splats, self.scene.extent)
        for name, item in self._declared.items():
            rate = Rate(item.lr, item.lr_end, item.paced)
            groups.append(group(name, self.splats[name], rate, **penalties(item, len(self.splats))))
        for name, parameter in self.thermal.named_parameters():
            groups.append(group(f"thermal.{name}", parameter, self.thermal.rate_of(name)))
        for name, part in self.sensor.parts.items():
            for inner, parameter in part.named_parameters():
                groups.append(group(f"sensor.{name}.{inner}", parameter, Rate(part.lr, part.lr_end)))
        for name, parameter in self.cameras.named_parameters():
            rate = Rate(self.cameras.lr, self.cameras.lr_end, paced=True)
            groups.append(group(f"cameras.{name}", parameter, rate))
        optimizer, scheduler = self.optim.build(groups, self.schedule.round_progress)
        self.stages.check(optimizer)
        check_registered(self)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _between_resets(self, interval: int | float) -> int | float:
        """Steps between validations, none of which measures opacities that were just reset."""
        if not isinstance(interval, int):
            return interval
        parts = (self.density, self.overlap)
        return self.schedule.interval(
            interval, lambda step: all(part.settled(self.schedule.round_step(step - 1)) for part in parts)
        )

    # One step ----------------------------------------------------------------------------------------

    def on_train_start(self) -> None:
        load_waiting_gradients(self, self._waiting)
        self._waiting = {}
        self._stop_at_the_end()

    def on_train_batch_end(self, *_: Any) -> None:
        self._stop_at_the_end()

    def _stop_at_the_end(self) -> None:
        if self.global_step >= self.schedule.end:
            self.trainer.should_stop = True
            warn_of_untrained(plain(self.trainer.optimizers[0]), self.stages)
            if self._average:
                self.results.run["averaged_updates"] = self._average.give(self._learned())
            if (learned := self.cameras.learned()) is not None:
                self.results.run["cameras"] = learned

    def on_train_epoch_end(self) -> None:
        """After the last step and its validation, before last.ckpt is written: what is merged is in it."""
        if self.global_step < self.schedule.end:  # stopped by hand
            return
        found = self.merging(self, self.cloud(plain(self.trainer.optimizers[0])))
        if found is not None:
            self._show(self.splats)
            self.results.run["merging"] = found

    def training_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        step = self.global_step
        round_step, progress = self.schedule.round_step(step), self.schedule.progress(step)
        ratio = self.resolution.ratio(progress)
        view = self.resolution.chosen(view, step, self.seed)
        camera = rendered(view.camera, self.supersample / ratio)
        view = self.resolution.reduced(view.to(self.device, self.dtype), ratio)
        frame = view.frame if camera is view.camera else replace(view.frame, camera=camera)
        self.thermal.on_step(round_step)
        self.cameras.keep_apart()
        rests = self._density_rests(step)
        signs = self.overlap.signs_at(round_step, len(self.splats) * self.thermal.per_row, self.seed)
        output = self.render(
            frame,
            depth=self.sensor.needs_depth,
            absgrad=not rests and self.density.absgrad_at(round_step),
            maps=0 if rests else self.density.maps_at(round_step),
            ratio=ratio,
            signs=signs,
            generator=generator_for(self.seed, step, "rays") if self.thermal.rows == NOTHING else None,
            camera=self.cameras.of(frame, progress),
        )
        image, *companions = self._images(output)
        prediction, target = self.sensor(image, frame, output.seen_depth), view.image(self.modality)
        if self.modality == "thermal":
            target = with_what_lies_beyond(target, view.ends, prediction)
        inputs = LossInputs(
            prediction=prediction,
            target=target,
            mask=view.mask,
            view=view,
            splats=self.splats,
            step=step,
            progress=progress,
            companions={
                name: (seen, view.image(name)) for name, seen in zip(self.thermal.companions, companions, strict=True)
            },
            ratio=ratio,
        )
        terms = summands(
            self.loss(inputs),
            self.thermal.regularisers(self.splats),
            self.sensor.regularisers(),
            self.cameras.regularisers(),
            {} if signs is None else {"entropy": self.overlap.entropy(output)},
        )
        loss = reduce(operator.add, terms.values())
        if output.weighted is not None:  # adds 0 to the loss; sums count pixels of full size
            maps = self.density.pixel_maps(pixel_errors(inputs, camera), known_target(inputs, camera), round_step)
            loss = loss + (output.weighted.image * maps).sum() * ratio**2
        self._rendered, self._pixels = (output, camera), inputs.target[..., 0].numel()
        told = {name: term.detach() for name, term in terms.items()}
        return {"loss": loss, "terms": told, "prediction": inputs.prediction.detach()}

    def on_after_backward(self) -> None:
        output, camera = self._rendered
        if not self._density_rests(self.global_step):
            self.density.observe(self._density_state, output, camera, self.schedule.round_step(self.global_step))
        self._rendered = None

    def _updates(self, step: int) -> bool:
        """Whether parameters change after ``step``: always, but where gradients of several views are summed."""
        last = step + 1 >= self.schedule.end or step + 1 in self.schedule.restarts
        return last or self.optim.updates(step, self.schedule.round_progress(step))

    def optimizer_zero_grad(self, epoch, batch_idx, optimizer) -> None:
        if self._updated:
            # What Lightning clips has to be in grad.
            plain(optimizer).takes_unwritten = not self.trainer.gradient_clip_val
            optimizer.zero_grad()

    def optimizer_step(self, epoch, batch_idx, optimizer, optimizer_closure=None) -> None:
        """The optimiser's step, then density control: before any callback can write a checkpoint of this step."""
        step, inner = self.global_step, plain(optimizer)
        round_step = self.schedule.round_step(step)
        if step in self.schedule.restarts:
            inner.state.clear()
            for statistic in self._density_state.values():
                statistic.zero_()
        update = self._updates(step)
        with self.stages.on_step(step, inner):
            optimizer.step(closure=optimizer_closure) if update else optimizer_closure()
        self._updated = update
        if not self._checked_trained:
            self._checked_trained = True
            check_trained(self, inner)
        if self.optim.decoupled is not None and update:
            self.optim.decoupled(inner, self.schedule.planned(round_step), self._pixels, self.scene.extent)
        self._change_gaussians(self.cloud(inner), step, round_step)
        if update and self.schedule.left(step + 1) < self._averaged:
            self._average.take(self._learned())

    def _change_gaussians(self, cloud: Cloud, step: int, round_step: int) -> None:
        """What comes after the optimiser's step: resets of sizes, density control, and what both mean for all that knows of
        the Gaussians by their number or place."""
        shrunk = self.overlap.shrink(cloud, round_step)
        for name, gone, instead in self.thermal.rows_to_drop(self.splats, round_step):
            cloud.drop(name, gone, instead)
        before, centres = len(self.splats), self.splats.means
        change = None
        if not self._density_rests(step):
            generator = generator_for(self.seed, step, "density")
            change = self.density.refine(cloud, round_step, self.scene.extent, generator)
        self._check_change(change, len(self.splats) - before)
        self.density_change = change
        if change is not None and not len(self.splats):
            raise SceneError(
                f"{type(self.density).__name__} removed all Gaussians in step {step + 1}: give it milder thresholds"
            )
        if self.splats.means is not centres:
            self.thermal.on_rows_changed()
        self.smoothing.follow(self.splats.means.detach(), step, self.schedule.end, change is not None)
        self.surroundings.after_step(step, self.splats, self.composited)
        if change is not None or shrunk:
            self._average.forget()
        if change is not None:
            for group in cloud.optimizer.param_groups:
                if group["name"] in self._declared:
                    group |= penalties(self._declared[group["name"]], len(self.splats))

    def _density_rests(self, step: int) -> bool:
        """Whether a stage freezes where Gaussians lie in ``step``: what density control made of them would lie elsewhere, and
        never settle."""
        return self.stages.freezes_at("means", step)

    def _check_change(self, change: Any, more: int) -> None:
        """Raises ValueError where density control does not tell what it did: averages and penalties would go on as before."""
        rule = f"{type(self.density).__name__}.refine"
        wanted = "DensityChange(added=..., removed=...), or None where nothing was changed"
        if not isinstance(change, DensityChange | None):
            raise ValueError(f"{rule} returned {change!r}: return {wanted}")
        if change is None and more:
            raise ValueError(
                f"{rule} returned None and left {abs(more)} Gaussians {'more' if more > 0 else 'fewer'}: return {wanted}"
            )

    def _learned(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters by name, without those that are given."""
        given = {f"splats.raw.{name}" for name in self.constants}
        return ((name, parameter) for name, parameter in self.named_parameters() if name not in given)

    def cloud(self, optimizer: torch.optim.Optimizer) -> Cloud:
        """The Gaussians with their moments and statistics, through which alone they come and go."""
        return Cloud(self.splats, optimizer, self._density_state, self.smoothing.kept_opacity)

    # Evaluation --------------------------------------------------------------------------------------

    def validation_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        return self._scored(view, view.frame)

    def test_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        steps = self.cameras.align_steps
        if steps == 0:
            return self._scored(view, view.frame)
        self.results.data["test_cameras_aligned"] = f"each to its image, in {steps} steps"
        camera = self.aligned(view, view.frame.camera, steps)
        return self._scored(view, replace(view.frame, camera=camera), camera)

    def _scored(self, view: View, frame: Frame, camera: Camera | None = None) -> dict[str, Any]:
        """What is scored of a view, as ``predict_all`` tells it of a frame and a camera."""
        start = time.perf_counter()
        images = self.predict_all(frame, camera)
        if view.clean is None and not self.sensor.parts:
            del images["clean"]  # it is the recorded image, judged against the same target
        if images[self.modality].is_cuda:
            torch.cuda.synchronize()
        seconds = time.perf_counter() - start
        return {"view": view, "prediction": images.pop(self.modality), "companions": images, "seconds": seconds}

    def transfer_batch_to_device(self, batch: View, device: torch.device, dataloader_idx: int) -> View:
        return batch.to(device)

    # Checkpoints -------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint[CHECKPOINT_KEY] = {
            "config": self.config,
            "rows": self.thermal.rows,
            "scales": scales_of(self.scene),
            "schedule": self.schedule.state_dict(),
            "density_times": self.density.times(),
            "density_state": {name: tensor.detach().cpu() for name, tensor in self._density_state.items()},
        }
        if not self._updated:
            checkpoint[CHECKPOINT_KEY] |= waiting_gradients(self)
        if self._average:
            checkpoint[CHECKPOINT_KEY]["average"] = self._average.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Training goes on from the checkpoint, on the scene that it was trained on; Lightning then loads the values."""
        self.make_room(checkpoint)
        check_same_scene(self.scene, checkpoint[CHECKPOINT_KEY].get("scales", {}))

    def make_room(self, checkpoint: dict[str, Any]) -> None:
        """Gives every tensor the size that it has in the checkpoint, and takes over what is no tensor."""
        weights = checkpoint["state_dict"]
        for name in self.thermal.optional.intersection(self.splats.names):
            if f"splats.raw.{name}" not in weights:
                self.splats.remove(name)
                del self._declared[name]
        check_same_method(self, checkpoint)
        stored = {name: tuple(weights[f"splats.raw.{name}"].shape) for name in self.splats.names}
        # What does not learn may have other columns under the weather of today: those of the checkpoint count.
        still = {name: stored[name][1:] for name, item in self._declared.items() if item.lr == 0}
        self.splats.resize(stored["means"][0], still)
        for name, buffer in list(self.named_buffers()):
            given = weights.get(name)
            if given is not None and given.shape != buffer.shape:
                owner, _, leaf = name.rpartition(".")
                setattr(self.get_submodule(owner), leaf, torch.empty_like(given, device=buffer.device))
        own = checkpoint[CHECKPOINT_KEY]
        if self.schedule.load_state_dict(own["schedule"]):
            self.density.load_times(own["density_times"])
            if "average" in own:  # of a run that goes on for longer, these updates are not the last ones
                self._average.load_state_dict(own["average"], self.device)
        self._waiting = {name: own[name] for name in ("gradients", "unwritten") if name in own}
        self._updated = not self._waiting
        state = own["density_state"]
        self._density_state = {name: tensor.to(self.device) for name, tensor in state.items()}


def check_same_method(module: SplatTraining, checkpoint: dict[str, Any]) -> None:
    """Raises SceneError when a checkpoint was written by another method, or on data that told other things."""
    if CHECKPOINT_KEY not in checkpoint:
        raise SceneError("the checkpoint was not written by heatsplat: it holds no 'heatsplat' entry")
    stored = checkpoint[CHECKPOINT_KEY]["config"].get("name")
    here = module.config.get("name")
    names = {f"splats.raw.{name}" for name in module.splats.names}
    found = {name for name in checkpoint["state_dict"] if name.startswith("splats.raw.")}
    if stored == here and names != found:
        told = (
            f"{what} {', '.join(sorted(name.removeprefix('splats.raw.') for name in some))}"
            for what, some in (("lacks", names - found), ("has beyond this run", found - names))
            if some
        )
        raise SceneError(
            f"the checkpoint of method '{stored}' {' and '.join(told)}: it was trained with other settings, or on data that told "
            "other things, such as a weather record that has gained or lost its irradiance since. Give the settings and the data "
            "that it was trained with (columns that are new in a table taken out again), or start without ckpt."
        )
    if stored != here:
        difference = ", ".join(sorted(name.removeprefix("splats.raw.") for name in names ^ found)) or "none"
        raise SceneError(
            f"the checkpoint is of method '{stored}', this run is method '{here}' (tensors that differ: {difference}). "
            f"Continue it with method={stored} and the settings it was trained with, or start without ckpt."
        )
