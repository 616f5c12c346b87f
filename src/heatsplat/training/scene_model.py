"""A scene as it is trained: splats, what they emit, and how that becomes the images of a camera."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor

from heatsplat.contracts import Camera, Frame, RenderOutput, SceneData, SceneError, View
from heatsplat.geometry.closest_depth import closest_depth
from heatsplat.geometry.coverage import gap_free, seen_means, surface_depth
from heatsplat.renderers.settings import Renderer
from heatsplat.renderers.smoothing import Smoothing
from heatsplat.same_bits import mean
from heatsplat.sensors.base import Composite, SensorChain
from heatsplat.splats import NOTHING, Splats
from heatsplat.thermal.base import Geometry, PerGaussian, Query, ThermalModel
from heatsplat.training.cameras import Cameras, aligned, seen_depths
from heatsplat.training.rng import generator_for


class SceneModel(pl.LightningModule):
    """What export, viewer, callbacks, merging and uncertainty know of a run. ``SplatTraining`` trains one.

    Args:
        thermal, renderer, sensor, composite, smoothing, cameras, seed: as for ``SplatTraining``.

    Attributes:
        scene, splats: None until ``SplatTraining.attach``, which also gives ``background``, blended behind all.
        modality: of the images that are scored, "thermal" or "rgb".
        config: the resolved configuration as plain containers. It travels in the checkpoint, so that a checkpoint and its data
            are enough to evaluate or render.
    """

    def __init__(
        self,
        thermal: ThermalModel,
        renderer: Renderer,
        sensor: SensorChain,
        composite: Composite,
        smoothing: Smoothing,
        cameras: Cameras,
        seed: int,
    ) -> None:
        super().__init__()
        self.thermal, self.renderer, self.sensor = thermal, renderer, sensor
        self.composite, self.smoothing, self.cameras, self.seed = composite, smoothing, cameras, seed
        self.modality = thermal.modality
        self.config: dict[str, Any] = {}
        self.scene: SceneData | None = None
        self.splats: Splats | None = None
        self._declared: dict[str, PerGaussian] = {}

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
                self._check_features(told, len(ids))
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

    def _check_features(self, told: Tensor, count: int) -> None:
        """Raises ValueError where the thermal model does not tell what each Gaussian in view emits."""
        shape = (count, sum(self.thermal.modality_channels))
        if not isinstance(told, Tensor) or tuple(told.shape) != shape:
            got = list(told.shape) if isinstance(told, Tensor) else type(told).__name__
            raise ValueError(
                f"what {type(self.thermal).__name__}.features returns must be {list(shape)}, a row for each Gaussian in view "
                f"(query.rows) and a column for each channel, got {got}"
            )

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

    def _images(self, output: RenderOutput) -> Sequence[Tensor]:
        """The image of each modality, the model's own first."""
        channels = self.thermal.modality_channels
        return [output.features] if len(channels) == 1 else output.features.split(channels, dim=-1)

    @torch.no_grad()
    def predict(self, frame: Frame) -> Tensor:
        """The image that the camera would record of ``frame``, [H, W, C] in [0, 1]; this is what metrics score."""
        return self.predict_all(frame)[self.modality]

    @torch.no_grad()
    def predict_all(self, frame: Frame, camera: Camera | None = None) -> dict[str, Tensor]:
        """The image that the camera would record and the images of the model's companions, by modality.

        Last comes "clean", what a camera without the flaws of the sensor chain would record. They are taken from where
        ``camera`` stands, as in ``render``.
        """
        output = self.render(frame, depth=self.sensor.needs_depth, camera=camera)
        image, *companions = self._images(output)
        images = (self.sensor(image, frame, output.seen_depth), *companions, image)
        names = (self.modality, *self.thermal.companions, "clean")
        return {name: seen.clamp(0, 1) for name, seen in zip(names, images, strict=True)}

    @torch.no_grad()
    def surface(self, frame: Frame) -> Tensor:
        """Camera z [H, W] of the surface in a frame, in world units, on the CPU; infinite where there is none. It is that of the
        frame's camera as it is given, by whose rays it is read.

        The mean depth of splats is far off where opacity is spread before or behind a surface; this is where it lies closest
        (``geometry.closest_depth``). Fields have no splats, and their mean depth.
        """
        if self.thermal.rows == NOTHING:
            output = self.render(frame, depth=True, camera=frame.camera)
            return surface_depth(output.depth, output.alpha[0]).cpu()
        *shape, opacities = self._shapes(self.thermal.geometry(self.splats, _query(frame)))
        return closest_depth(partial(self.renderer.depths_at_shares, (*shape, opacities[:1])), frame.camera)[0]

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
        self.smoothing.follow(splats.means.detach(), step=0, end=0, changed=True)

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
        seen_from = camera or self.cameras.of(frame)
        return self.renderer.values_seen((*shape, opacities[:1]), values, seen_from, depth, ratio)

    # Where images were taken from ----------------------------------------------------------------------------------

    def aligned(self, view: View, camera: Camera, steps: int) -> Camera:
        """The camera beside ``camera`` from which the image of a view differs least, as far as so many steps go."""
        return aligned(camera, partial(self.squared_error, view), steps, self._middle)

    @cached_property
    def _middle(self) -> float:
        """How far away what the cameras see lies, in the median."""
        return statistics.median(seen_depths(self.scene))

    def squared_error(self, view: View, camera: Camera) -> Tensor:
        """Mean squared error of the image of a view as seen from a camera, over the pixels that count."""
        output = self.render(view.frame, self.sensor.needs_depth, camera=camera)
        image = self.sensor(self._images(output)[0], view.frame, output.seen_depth)
        target = view.image(self.modality)
        if (known := view.known) is not None:
            counts = known.clone()  # autograd keeps no tensor of Lightning's inference mode
            image, target = image[counts], target[counts]
        return mean((image - target).square())


def _query(frame: Frame, ids: Tensor | None = None, geometry: Geometry | None = None) -> Query:
    """What is asked of the thermal model for a frame: the Gaussians ``ids``, or all, with the geometry it gave them."""
    return Query(ids, frame.camera, frame.time_s, frame.frame_id, geometry)
