"""The LightningModule: one view, one render, one loss, one step of one optimiser. It knows no variant by name."""

from __future__ import annotations

import logging
import operator
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from heatsplat.contracts import Camera, Frame, RenderOutput, SceneData, SceneError, View
from heatsplat.density.base import DensityChange, DensityControl, Merging
from heatsplat.density.ops import Cloud
from heatsplat.geometry.coverage import gap_free, seen_means, surface_depth
from heatsplat.geometry.resampling import resampled
from heatsplat.io.results import RunResults
from heatsplat.losses.compose import Loss, LossInputs, pixel_errors
from heatsplat.renderers.settings import Renderer
from heatsplat.renderers.smoothing import Smoothing
from heatsplat.sensors.base import Composite, SensorChain
from heatsplat.splats import ANCHORS, GAUSSIANS, NOTHING, Splats
from heatsplat.thermal.base import Geometry, PerGaussian, Query, Rate, ThermalModel
from heatsplat.training.adam import load_waiting_gradients, waiting_gradients
from heatsplat.training.averaging import Average
from heatsplat.training.cameras import Cameras, aligned, seen_depths
from heatsplat.training.init import Initialisation
from heatsplat.training.loop import plain
from heatsplat.training.optimisation import Optimisation, penalties
from heatsplat.training.overlap import Overlap
from heatsplat.training.resolution import Resolution, rendered
from heatsplat.training.rng import generator_for
from heatsplat.training.scales import scales_of
from heatsplat.training.schedule import Schedule
from heatsplat.training.stages import Stages
from heatsplat.training.surroundings import Surroundings

log = logging.getLogger(__name__)

CHECKPOINT_KEY = "heatsplat"


class SplatTraining(pl.LightningModule):
    """Trains splats with a thermal model on the views of a scene.

    Public attributes for callbacks: ``scene``, ``splats``, ``thermal``, ``sensor``, ``modality``, ``results``,
    ``output_dir``, ``predict(frame)``, ``attribute_maps(frame)``, ``schedule`` (how far the run is, and when it ends),
    ``density_change`` (what density control did in the last step, None for nothing), and ``config``, the resolved
    configuration as plain containers: it travels in the checkpoint, so that a checkpoint and its data are enough to evaluate
    or render.

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
        init: Initialisation,
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
        super().__init__()
        self.thermal, self.renderer, self.sensor = thermal, renderer, sensor
        self.density, self.loss, self.init, self.optim = density, loss, init, optim
        self.stages = stages or Stages({})
        self.schedule = Schedule(max_steps, self.stages.restarts)
        self.composite = composite or Composite()
        self.smoothing = smoothing or Smoothing()
        self.merging = merging or Merging()
        self.resolution = resolution or Resolution()
        self.overlap = overlap or Overlap()
        self.cameras = cameras or Cameras()
        self.surroundings = surroundings or Surroundings()
        self.seed, self.output_dir = seed, Path(output_dir)
        self.config: dict[str, Any] = {}
        self.modality = thermal.modality
        self.supersample = supersample
        if dtype not in ("float32", "float64"):
            raise ValueError(f"dtype must be float32 or float64, got '{dtype}'")
        self._wide = dtype == "float64"
        self.results = RunResults()
        self.scene: SceneData | None = None
        self.splats: Splats | None = None
        self._declared: dict[str, PerGaussian] = {}
        self._density_state: dict[str, Tensor] = {}
        self.density_change: DensityChange | None = None
        self._rendered: tuple[RenderOutput, Camera] | None = None
        self._pixels = 0  # of the last image
        self._average = Average()
        self._waiting: dict[str, Any] = {}  # gradients of a checkpoint that was written between two updates

    # Set-up ------------------------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        """Builds splats from the scene of the trainer's data module, once."""
        if self.scene is None:
            self.attach(self.trainer.datamodule.scene)
        if stage == "fit":
            for name in self.thermal.companions:
                if not self.loss.compares(name):
                    log.warning("no term of loss.terms compares %s images: they are scored, but not learned", name)
            self.results.data |= self.loss.prepare(self.scene, self.modality)
            self.trainer.val_check_interval = self._between_resets(self.trainer.val_check_interval)

    def attach(self, scene: SceneData) -> None:
        """Builds all that depends on the scene. Refuses a scene that lacks what the thermal model needs."""
        self.thermal.check(scene)
        self._check_parts()
        self.scene = scene
        self.thermal.prepare(scene)
        self.sensor.prepare(scene)
        self.composite.prepare(scene, self.modality)
        self.cameras.prepare(scene)
        self.splats, self._declared = self.init(scene, self.thermal, self.seed, self.density.cap_max)
        self.smoothing.prepare(scene, self.splats.means.detach())
        self.surroundings.prepare(scene, self.renderer, self.splats, self.composited)
        self.density.opacities_until = self.stages.held_from("opacity_logits")
        self.density.prepare(scene, self.modality)
        learned = (self.modality, *self.thermal.companions)
        self.resolution.prepare(scene, learned, self.composite, self.supersample)
        self._density_state = self.density.initial_state(len(self.splats), torch.device("cpu"))
        modalities = zip(learned, self.thermal.modality_channels, strict=True)
        behind = [torch.full((count,), self.renderer.background_of(scene, name)) for name, count in modalities]
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
        if rows == NOTHING and type(self.overlap) is not Overlap:
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
            if self._average:
                self.results.run["averaged_updates"] = self._average.give(self._learned())
            if (found := self.cameras.found()) is not None:
                self.results.run["cameras"] = found

    def on_train_epoch_end(self) -> None:
        """After the last step and its validation, before last.ckpt is written: what is merged is in it."""
        if self.global_step < self.schedule.end:  # stopped by hand
            return
        found = self.merging(self, self.cloud(plain(self.trainer.optimizers[0])))
        if found is not None:
            self._show(self.splats)
            self.results.run["merging"] = found

    def render(
        self,
        frame: Frame,
        depth: bool = False,
        absgrad: bool = False,
        maps: int = 0,
        ratio: float = 1.0,
        signs: Tensor | None = None,
        values: Tensor | None = None,
        generator: torch.Generator | None = None,
        camera: Camera | None = None,
    ) -> RenderOutput:
        """The clean image that the splats send to the camera of ``frame`` at its time.

        Where its pixels are ``ratio`` times as large as those of full size, Gaussians look as they do there. ``values``
        [N, C] are what rows of the splats emit in place of what the thermal model makes of them.
        ``generator`` draws where samples along rays lie, of fields. The image is taken from where ``camera`` stands, by default
        where the camera of ``frame`` is known to have stood (``Cameras.of``); what the splats emit is that towards the camera of
        ``frame``.
        """

        channels = self.thermal.modality_channels[0]
        if self.thermal.rows == NOTHING:
            return self._render_field(frame, channels, generator)
        moved = self.thermal.geometry(self.splats, _query(frame))

        def emitted(ids: Tensor) -> Tensor:
            query = _query(frame, ids, moved)
            if values is None:
                told = self.thermal.features(self.splats, query)
            else:
                told = values.index_select(0, ids // self.thermal.per_row)
            return self.composite.encode(told, channels)

        raw = moved is None and not self.smoothing.changes
        output = self.renderer(
            *(self._raw_shapes() if raw else self._shapes(moved)),
            emitted,
            camera or self.cameras.of(frame),
            self.background,
            self.thermal.opacity_channels,
            absgrad=absgrad,
            depth=depth,
            maps=maps,
            ratio=ratio,
            signs=signs,
            raw=raw,
        )
        if self.thermal.per_row > 1:
            output.meta["opacities"], output.meta["rows_in_view"] = moved.opacities.detach(), moved.in_view
        image = self.composite.decode(output.features, channels)
        return output if image is output.features else replace(output, features=image)

    def _render_field(self, frame: Frame, channels: int, generator: torch.Generator | None) -> RenderOutput:
        """As ``render``, of a model without Gaussians."""

        def sent(known: Tensor, directions: Tensor) -> Tensor:
            return self.composite.encode(self.thermal.values(known, directions, _query(frame)), channels)

        output = self.renderer.of_field(
            self.thermal.density, sent, self.thermal.span, frame.camera, self.background, generator
        )
        return replace(output, features=self.composite.decode(output.features, channels))

    def _raw_shapes(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, rotations, logarithms of scales and logits of opacities of all Gaussians."""
        splats = self.splats
        return splats.means, splats.quats, splats["log_scales"], splats["opacity_logits"].T

    def _shapes(self, moved: Geometry | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, rotations, scales and opacities of all Gaussians, as a model moved them or as they are.

        Raises:
            SceneError: the model has none.
        """
        if self.thermal.rows == NOTHING:
            raise SceneError(
                f"{type(self.thermal).__name__} has no Gaussians, which this asks for: leave it out, or train a method of splats "
                "such as method=3dgs"
            )
        shown = self.splats if moved is None else moved
        return shown.means, shown.quats, *self.smoothing(shown.scales, shown.opacities)

    def training_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        step = self.global_step
        here, progress = self.schedule.round_step(step), self.schedule.progress(step)
        ratio = self.resolution.ratio(progress)
        view = self.resolution.chosen(view, step, self.seed)
        camera = rendered(view.camera, self.supersample / ratio)
        view = self.resolution.reduced(view.to(self.device, self.dtype), ratio)
        frame = view.frame if camera is view.camera else replace(view.frame, camera=camera)
        self.thermal.on_step(here)
        signs = self.overlap.signs_at(here, len(self.splats) * self.thermal.per_row, self.seed)
        maps = self.density.maps_at(here)
        drawn = generator_for(self.seed, step, "rays") if self.thermal.rows == NOTHING else None
        self.cameras.keep_apart()
        stood = self.cameras.of(frame, progress)
        output = self.render(
            frame, self.sensor.needs_depth, self.density.absgrad, maps, ratio, signs, generator=drawn, camera=stood
        )
        image, *companions = self._images(output)
        prediction = self.sensor(image, frame, output.seen_depth)
        inputs = LossInputs(
            prediction,
            view.image(self.modality),
            view.mask,
            view,
            self.splats,
            step,
            progress,
            {name: (seen, view.image(name)) for name, seen in zip(self.thermal.companions, companions, strict=True)},
            ratio,
        )
        terms = self.loss(inputs) | self.thermal.regularisers(self.splats) | self.sensor.regularisers()
        terms |= self.cameras.regularisers()
        if signs is not None:
            terms["entropy"] = self.overlap.entropy(output)
        self._rendered = (output, camera)
        loss = reduce(operator.add, terms.values())
        if output.weighted is not None:  # adds 0 to the loss; sums count pixels of full size
            target = inputs.target
            if inputs.mask is not None and target.shape[:2] == (camera.height, camera.width):
                target = target.where(inputs.mask[..., None], torch.nan)
            target = resampled(target, camera.height, camera.width, "area")
            maps = self.density.pixel_maps(pixel_errors(inputs, camera), target, here)
            loss = loss + (output.weighted.image * maps).sum() * ratio**2
        told = {name: term.detach() for name, term in terms.items()}
        return {"loss": loss, "terms": told, "prediction": prediction.detach()}

    def _images(self, output: RenderOutput) -> Sequence[Tensor]:
        """The image of each modality, the model's own first."""
        channels = self.thermal.modality_channels
        return [output.features] if len(channels) == 1 else output.features.split(channels, dim=-1)

    def on_after_backward(self) -> None:
        output, camera = self._rendered
        self._pixels = camera.width * camera.height
        self.density.observe(self._density_state, output, camera, self.schedule.round_step(self.global_step))
        self._rendered = None

    def _updates(self, step: int) -> bool:
        """Whether parameters change after ``step``: always, but where gradients of several views are summed."""
        last = step + 1 >= self.schedule.end or step + 1 in self.schedule.restarts
        return last or self.optim.updates(step, self.schedule.round_progress(step))

    def optimizer_zero_grad(self, epoch, batch_idx, optimizer) -> None:
        step = self.global_step
        if step == 0 or self._updates(step - 1):
            # What Lightning clips has to be in grad.
            plain(optimizer).takes_unwritten = not self.trainer.gradient_clip_val
            optimizer.zero_grad()

    def optimizer_step(self, epoch, batch_idx, optimizer, optimizer_closure=None) -> None:
        """The optimiser's step, then density control: before any callback can write a checkpoint of this step."""
        step = self.global_step
        inner = plain(optimizer)
        if step in self.schedule.restarts:
            inner.state.clear()
            for statistic in self._density_state.values():
                statistic.zero_()
        update = self._updates(step)
        with self.stages.on_step(step, inner):
            optimizer.step(closure=optimizer_closure) if update else optimizer_closure()
        cloud = self.cloud(inner)
        here = self.schedule.round_step(step)
        if self.optim.decoupled is not None and update:
            self.optim.decoupled(inner, here, self._pixels, self.scene.extent)
        self.overlap.shrink(cloud, here)
        for name, gone, instead in self.thermal.rows_to_drop(self.splats, here):
            cloud.drop(name, gone, instead)
        change = self.density.refine(cloud, here, self.scene.extent, generator_for(self.seed, step, "density"))
        self.density_change = change
        self.smoothing.follow(self.splats.means.detach(), step, self.schedule.end, change is not None)
        self.surroundings.after_step(step, self.splats, self.composited)
        if change is not None:
            self._average.forget()
            for group in inner.param_groups:
                if group["name"] in self._declared:
                    group |= penalties(self._declared[group["name"]], len(self.splats))
        if update and self.schedule.left(step + 1) < self.optim.averaged:
            self._average.take(self._learned())

    def _learned(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters by name, without those that are given."""
        given = {f"splats.raw.{name}" for name in self.constants}
        return ((name, parameter) for name, parameter in self.named_parameters() if name not in given)

    def cloud(self, optimizer: torch.optim.Optimizer) -> Cloud:
        """The Gaussians with their moments and statistics, through which alone they come and go."""
        return Cloud(self.splats, optimizer, self._density_state, self.smoothing.kept_opacity)

    # Evaluation --------------------------------------------------------------------------------------

    @torch.no_grad()
    def predict(self, frame: Frame) -> Tensor:
        """The image that the camera would record of ``frame``, [H, W, C] in [0, 1]; this is what metrics score."""
        return self.predict_all(frame)[self.modality]

    @torch.no_grad()
    def predict_all(self, frame: Frame) -> dict[str, Tensor]:
        """The image that the camera would record and the images of the model's companions, by modality.

        Last comes "clean", what a camera without the flaws of the sensor chain would record.
        """
        output = self.render(frame, depth=self.sensor.needs_depth)
        image, *companions = self._images(output)
        images = (self.sensor(image, frame, output.seen_depth), *companions, image)
        names = (self.modality, *self.thermal.companions, "clean")
        return {name: seen.clamp(0, 1) for name, seen in zip(names, images, strict=True)}

    @torch.no_grad()
    def depth(self, frame: Frame) -> Tensor:
        """Camera z [H, W] of the surface in a frame, in world units, on the CPU; infinite where there is none. It is that of the
        frame's camera as it is given, by whose rays it is read."""
        output = self.render(frame, depth=True, camera=frame.camera)
        return surface_depth(output.depth, output.alpha[0]).cpu()

    @contextmanager
    def showing(self, splats: Splats) -> Iterator[None]:
        """While it lasts, other splats of the same tensors are rendered in place of its own."""
        own = self.splats
        self._show(splats)
        try:
            yield
        finally:
            self._show(own)

    def _show(self, splats: Splats) -> None:
        self.splats = splats
        self.smoothing.follow(splats.means.detach(), self.schedule.end, self.schedule.end, True)

    @torch.no_grad()
    def shapes(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, rotations, scales and opacities [M, N] of all Gaussians as they are rendered in a frame."""
        return self._shapes(self.thermal.geometry(self.splats, _query(frame)))

    @torch.no_grad()
    def emissions(self, splats: Splats, frame: Frame, ids: Tensor | None = None) -> Tensor:
        """What the thermal model makes of all Gaussians of some splats in a frame, or of ``ids``, [n, C] in image units."""
        return self.thermal.features(splats, _query(frame, ids))

    @property
    def constants(self) -> frozenset[str]:
        """Names of tensors of the thermal model that are given and not trained, such as the class of a surface."""
        return frozenset(name for name, item in self._declared.items() if item.lr == 0)

    def generator(self, number: int, purpose: str) -> torch.Generator:
        """A generator of random numbers of the run's seed."""
        return generator_for(self.seed, number, purpose)

    @torch.no_grad()
    def attributes(self, frame: Frame) -> dict[str, Tensor]:
        """What the thermal model tells of every Gaussian at the time of ``frame``, by name, each [N]."""
        return self.thermal.attributes(self.splats, _query(frame))

    @torch.no_grad()
    def attribute_maps(self, frame: Frame) -> dict[str, Tensor]:
        """Images [H, W] of what the thermal model tells of its Gaussians (``ThermalModel.attributes``), by name.

        Each is the mean over the Gaussians of a pixel, weighted as they are seen in the first modality, or follows from such
        means (``ThermalModel.quotients``); NaN where none is seen, or most have none. Empty for models that tell nothing.
        """
        told = self.attributes(frame)
        if not told:
            return {}
        output = self.composited(frame, gap_free(torch.stack(list(told.values()), dim=1)))
        maps = seen_means(output.features, output.alpha[0], len(told))
        found = dict(zip(told, maps.unbind(-1), strict=True))
        return found | self.thermal.quotients(found)

    def composited(
        self, frame: Frame, values: Tensor, depth: bool = False, ratio: float = 1.0, camera: Camera | None = None
    ) -> RenderOutput:
        """What is seen of values [N, C] of all rows of the splats, before black, in the first modality; from where ``render``
        takes the image."""
        *shape, opacities = self._shapes(self.thermal.geometry(self.splats, _query(frame)))
        if self.thermal.per_row > 1:
            values = values.repeat_interleave(self.thermal.per_row, dim=0)
        return self.renderer(
            *shape,
            opacities[:1],
            values,
            camera or self.cameras.of(frame),
            None,
            (values.shape[1],),
            depth=depth,
            ratio=ratio,
        )

    def validation_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        return self._scored(view, view.frame)

    def test_step(self, view: View, batch_idx: int) -> dict[str, Any]:
        steps = self.cameras.align_steps
        if steps == 0:
            return self._scored(view, view.frame)
        self.results.data["test_cameras_aligned"] = f"each to its image, in {steps} steps"
        return self._scored(view, replace(view.frame, camera=self.aligned(view, view.frame.camera, steps)))

    def aligned(self, view: View, camera: Camera, steps: int) -> Camera:
        """The camera beside ``camera`` from which the image of a view differs least, as far as so many steps go."""
        return aligned(camera, partial(self.squared_error, view), steps, self._middle)

    @cached_property
    def _middle(self) -> float:
        """How far away what the cameras see lies, in the median."""
        return statistics.median(seen_depths(self.scene))

    def _scored(self, view: View, frame: Frame) -> dict[str, Any]:
        """What is scored of a view, from the camera and at the time of ``frame``."""
        start = time.perf_counter()
        images = self.predict_all(frame)
        if view.clean is None and not self.sensor.parts:
            del images["clean"]  # it is the recorded image, judged against the same target
        if images[self.modality].is_cuda:
            torch.cuda.synchronize()
        seconds = time.perf_counter() - start
        return {"view": view, "prediction": images.pop(self.modality), "companions": images, "seconds": seconds}

    def squared_error(self, view: View, camera: Camera) -> Tensor:
        """Mean squared error of the image of a view as seen from a camera, over the pixels that count."""
        output = self.render(view.frame, self.sensor.needs_depth, camera=camera)
        image = self.sensor(self._images(output)[0], view.frame, output.seen_depth)
        target = view.image(self.modality)
        if view.mask is not None:
            counts = view.mask.clone()  # autograd keeps no tensor of Lightning's inference mode
            image, target = image[counts], target[counts]
        return (image - target).square().mean()

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
        if self.global_step > 0 and not self._updates(self.global_step - 1):
            checkpoint[CHECKPOINT_KEY] |= waiting_gradients(self)
        if self._average:
            checkpoint[CHECKPOINT_KEY]["average"] = self._average.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Gives every tensor the size that it has in the checkpoint; Lightning then loads the values."""
        weights = checkpoint["state_dict"]
        check_same_method(self, checkpoint)
        self.splats.resize(weights["splats.raw.means"].shape[0])
        for name, buffer in list(self.named_buffers()):
            stored = weights.get(name)
            if stored is not None and stored.shape != buffer.shape:
                owner, _, leaf = name.rpartition(".")
                setattr(self.get_submodule(owner), leaf, torch.empty_like(stored, device=buffer.device))
        own = checkpoint[CHECKPOINT_KEY]
        if self.schedule.load_state_dict(own["schedule"]):
            self.density.load_times(own.get("density_times", {}))
        self._waiting = {name: own[name] for name in ("gradients", "unwritten") if name in own}
        if "average" in own:
            self._average.load_state_dict(own["average"], self.device)
        state = own["density_state"]
        self._density_state = {name: tensor.to(self.device) for name, tensor in state.items()}


def _query(frame: Frame, ids: Tensor | None = None, geometry: Geometry | None = None) -> Query:
    """What is asked of the thermal model for a frame: the Gaussians ``ids``, or all, with the geometry it gave them."""
    return Query(ids, frame.camera, frame.time_s, frame.frame_id, geometry)


def check_same_method(module: SplatTraining, checkpoint: dict[str, Any]) -> None:
    """Raises SceneError when a checkpoint was written by another method than ``module`` trains."""
    if CHECKPOINT_KEY not in checkpoint:
        raise SceneError("the checkpoint was not written by heatsplat: it holds no 'heatsplat' entry")
    stored = checkpoint[CHECKPOINT_KEY]["config"].get("name")
    here = module.config.get("name")
    names = {f"splats.raw.{name}" for name in module.splats.names}
    found = {name for name in checkpoint["state_dict"] if name.startswith("splats.raw.")}
    if stored != here or names != found:
        difference = ", ".join(sorted(name.removeprefix("splats.raw.") for name in names ^ found)) or "none"
        raise SceneError(
            f"the checkpoint is of method '{stored}', this run is method '{here}' (tensors that differ: {difference}). "
            f"Continue it with method={stored} and the settings it was trained with, or start without ckpt."
        )
