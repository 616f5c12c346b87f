"""The contract of a thermal model: what a splat emits, seen from a camera at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from heatsplat.contracts import METADATA, Camera, Course, SceneData, SceneError, check_option
from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import GAUSSIANS, Splats

NORMALS = "normals"  # the tensor that ``surface_normals`` declares
# Tensors that training fills where a model declares them, and new Gaussians inherit: shares [N, D] of the sun from the D
# directions of ``geometry.exposure.sun_directions``, and [N] of the sky (heatsplat.training.exposure).
SUN_SEEN, SKY_SEEN = "sun_seen", "sky_seen"
GIVEN_BY = {  # metadata: what gives it to a scene of one's own
    "ambient": "data.ambient_c",
    "metres": "data.metres_per_unit",
    "thermal_range": "data.bounds_c or temperature_bounds.json",
    "time": "data.time_csv or data.time_regex",
    "weather": "weather.csv of data=thermo",
}
KELVIN_RANGE = 0.01  # K; float32 holds 300 K to 3e-5 K, a three-hundredth of it. Cameras have noise of 0.03 K and more.


@dataclass(frozen=True)
class Query:
    """What is asked of a thermal model: these Gaussians, from this camera, at this time.

    Args:
        ids: [n] int64 indices of the Gaussians in view, or None for all of them.
        camera: the camera that looks.
        time_s: float64 seconds since the first training frame, or None.
        frame_id: id of the frame, or None for a view that no one took.
        geometry: what the model answered when it was asked for the geometry of this very view: None where it answered
            nothing or was not asked. A deforming model may return a subclass of ``Geometry`` that carries what its
            features need too, so that nothing is computed twice.
    """

    ids: Tensor | None = None
    camera: Camera | None = None
    time_s: float | None = None
    frame_id: int | None = None
    geometry: Geometry | None = None

    def rows(self, tensor: Tensor) -> Tensor:
        """The rows of a per-Gaussian tensor that are asked for, [n, ...]."""
        return tensor if self.ids is None else tensor.index_select(0, self.ids)

    def normals(self, splats: Splats) -> Tensor:
        """Unit normals [n, 3] of the surfaces that the Gaussians show, of models that declared ``surface_normals``.

        They point to the side from which the surface is seen. Images and not heat decide how it lies: no gradient passes.
        """
        return self.rows(splats[NORMALS].detach())

    def sight(self, splats: Splats, what: str) -> Tensor:
        """Unit vectors [n, 3] from the camera to the Gaussians. No gradient passes: what is seen must not pull at the geometry.

        Raises:
            ValueError: there is no camera, on which ``what`` depends.
        """
        if self.camera is None:
            raise ValueError(f"{what} depends on the view: give a camera")
        means = self.rows(splats.means).detach()
        return spherical_harmonics.unit(means - self.camera.center.to(means))


@dataclass(frozen=True)
class Geometry:
    """Geometry of all Gaussians at a time: means [n, 3], quats [n, 4], scales [n, 3], opacities [M, n].

    There is one for each row of the splats, or ``ThermalModel.per_row`` for each, one row after the other.
    ``in_view`` [N] bool says which rows the camera may see where the model found that out: the others have none.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    in_view: Tensor | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Seeds:
    """What is known of the Gaussians before training: positions and the image values seen there.

    Args:
        means: [N, 3] positions.
        values: [N, C] median image value at the projections of each point, in [0, 1]; the channels of all modalities.
        generator: for models that start from random numbers.
        looks: [N, F, C] image values at the projections in F training views, NaN where a point is not seen; None: not known.
        looks_s: [F] times of those views in seconds; None: not known.
        log_scales: [N, 3] logarithms of the semi-axes that they start with; None where nobody knows.
    """

    means: Tensor
    values: Tensor
    generator: torch.Generator
    looks: Tensor | None = None
    looks_s: Tensor | None = None
    log_scales: Tensor | None = None

    def of(self, first: int, last: int) -> Seeds:
        """The same Gaussians with the channels from ``first`` up to ``last`` alone."""
        looks = None if self.looks is None else self.looks[..., first:last]
        return replace(self, values=self.values[:, first:last], looks=looks)


@dataclass(frozen=True)
class PerGaussian:
    """A tensor that every Gaussian carries for a thermal model.

    Args:
        initial: [N, ...] starting values.
        lr: learning rate.
        l2: weight of the penalty l2 * sum(x²); applied inside the optimiser, where it costs nothing (Adam's coupled
            weight decay of 2 * l2 is exactly its gradient).
        l2_mean: divides l2 by the current number of Gaussians, which makes the penalty a mean over them; and ``group`` by its
            root, which makes that one a root mean square.
        group: weight of the penalty Σ_k √(Σ_i x_ik²) over the columns k of the last dimension; inside the optimiser, too.
        lr_end: factor on lr at the last step of the run, log-linear in between.
        paced: whether it learns faster in shorter runs (``Optimisation.length_power``). Not what many numbers make up
            together, such as the gains of a series: their steps add up. Nor what has to be a mean over images that differ.
    """

    initial: Tensor
    lr: float
    l2: float = 0.0
    l2_mean: bool = False
    lr_end: float = 1.0
    paced: bool = True
    group: float = 0.0


class Rate(NamedTuple):
    """How fast a parameter learns that is not per Gaussian.

    Args:
        lr: learning rate.
        lr_end: factor on it at the last step of the run, log-linear in between.
        paced: whether it learns faster in shorter runs (``Optimisation.length_power``), as the weights of a network do.
        held: share of a short run in which the rate stays as it is, and falls in the rest (``Optimisation.held``).
    """

    lr: float
    lr_end: float = 1.0
    paced: bool = False
    held: float = 0.0


def surface_normals(seeds: Seeds) -> dict[str, PerGaussian]:
    """What a model adds to its tensors that reads ``Query.normals``: a constant [N, 3] that training fills and refreshes.

    Several members of one model may declare it; it is the same tensor. Where none does, normals are never computed.
    """
    return {NORMALS: PerGaussian(torch.zeros_like(seeds.means), 0.0)}


class Heat(nn.Module, ABC):
    """What thermal models and the parts of them (``HeatPart``) have in common. Whatever holds some asks all of them.

    Class attributes:
        needs: metadata it cannot do without, a subset of SceneData.metadata's vocabulary; checked at set-up.
        narrowest_range_k: narrowest range of temperatures in kelvin that it can show; checked at set-up.
        lr, lr_end, paced, held: the ``Rate`` of its own parameters (those that are not per Gaussian).
        optional: tensors that it does without where a checkpoint has none, as of a weather that told less than that of now.
        inseparable: one clause that says why its Gaussians cannot be merged one by one; empty where they can.
        beyond_record: one clause that says what it assumes of moments outside the training record, for warnings; empty
            where that goes without saying.
    """

    needs: frozenset[str] = frozenset()
    narrowest_range_k: float = 0.0
    optional: frozenset[str] = frozenset()
    inseparable: str = ""
    beyond_record: str = "it is evaluated as within the record, which nothing has tested"
    lr: float = 1e-3
    lr_end: float = 1.0
    paced: bool = False
    held: float = 0.0

    def check(self, scene: SceneData) -> None:
        """Raises SceneError, naming the model and what is missing, when the scene lacks metadata in ``needs`` or its range
        is too narrow; ValueError when there is no such metadata. Called once, before ``prepare``."""
        for name in sorted(self.needs):
            check_option(f"each of {type(self).__name__}.needs", name, METADATA)
        missing = sorted(self.needs - scene.metadata)
        if missing:
            given = [f"{name} by {GIVEN_BY[name]}" for name in missing if name in GIVEN_BY]
            how = f": {', '.join(given)} (docs/your_own_data.md)" if given else ""
            raise SceneError(
                f"{type(self).__name__} needs {', '.join(missing)}, which scene '{scene.name}' does not have "
                f"(it has: {', '.join(sorted(scene.metadata)) or 'images only'}). Choose a method that does without, "
                f"or give the data set the missing metadata{how}."
            )
        if scene.thermal_range is not None and scene.thermal_range.span_k < self.narrowest_range_k:
            raise SceneError(
                f"the thermal range of scene '{scene.name}' is {scene.thermal_range.span_k:.3g} K wide. {type(self).__name__} "
                f"computes in kelvin, which float32 holds to 3e-5 K: give a range of at least {self.narrowest_range_k:g} K "
                "(no camera resolves less), or choose a method that works in image values, such as etgs."
            )

    def prepare(self, scene: SceneData) -> None:
        """Takes constants (time grids, ranges) from the scene into buffers. Called once, after ``check`` and
        before anything else."""
        return

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """The tensors that every Gaussian carries for it, by the name under which they live in Splats."""
        return {}

    def on_step(self, step: int) -> None:
        """Told the training step before it runs, for schedules such as the degree of spherical harmonics."""
        return

    def on_rows_changed(self) -> None:
        """Told after Gaussians came, went or changed their numbers: what is kept by number belongs to others now."""
        return

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """Extra loss terms by name, each a weighted scalar with a gradient. Penalties x² belong in PerGaussian.l2."""
        return {}

    def rows_to_drop(self, splats: Splats, step: int) -> Iterable[tuple[str, Tensor, Mapping[str, Tensor]]]:
        """Rows of tensors that some Gaussians can do without from now on, asked for after every step of the optimiser.

        Each is the name of a tensor, the Gaussians that lose their row of it, [N] bool, and the values [N, ...] that their
        other tensors take instead, by name (see ``density.ops.Cloud.drop``).
        """
        return ()

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Further quantities of the Gaussians in ``query.ids`` that are worth a picture, by name, each [n]; with a gradient to
        what Gaussians learned, by which their intervals are told (``heatsplat.uncertainty``)."""
        return {}

    def quotients(self, told: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Those of ``attributes`` that follow from others, by name, of ``told`` of any shape.

        Pixels mix Gaussians: a quotient of what they mix is not the mean of the quotients of each.
        """
        return {}

    def prior(self, splats: Splats) -> dict[str, Tensor]:
        """What a table says of attributes that training pulls towards it, by name, each [N]; NaN where it says nothing."""
        return {}

    def doubts(self) -> Mapping[str, Callable[[], AbstractContextManager[None]]]:
        """What it takes for granted, by name: contexts in which that is wrong by one standard deviation."""
        return {}

    def rate_of(self, name: str) -> Rate:
        """That of its own parameter of that name."""
        return Rate(self.lr, self.lr_end, self.paced, self.held)

    def effects(self) -> dict[str, dict[str, Any]]:
        """The physical effects that it simulates: catalogue name -> settings (for metrics.json)."""
        return {}

    def courses(self) -> list[Course]:
        """What it has learned to change over the record for the whole scene, for a picture."""
        return []

    @property
    @abstractmethod
    def cost(self) -> int:
        """Multiply-adds per Gaussian and view."""


class ThermalModel(Heat):
    """What a splat emits. One model is one file with one subclass and one yaml in conf/thermal/.

    Class attributes, beside those of ``Heat``:
        modality: the image that it explains, "thermal" or "rgb"; this is what metrics score.
        companions: further images that it explains with the same Gaussians, such as ("rgb",).
        modality_channels: channels of the image and of its companions, such as (1, 3); their sum is the number of
            features.
        shared_opacity: one opacity serves the image and its companions; otherwise each has its own.
        start_opacity: with which its Gaussians start at points of a scene, in (0, 1), where nobody asks for another
            (``Initialisation``).
        averaged: share of a run, at its end, over whose updates parameters are averaged; likewise (``Optimisation``).
        rows: what a row of the splats is, GAUSSIANS or ANCHORS; or NOTHING for a ``Field``, whose splats have no rows.
            Parts of a run that touch rows say which they know.
        per_row: Gaussians that a row becomes in ``geometry``; those of row i begin at i * per_row, and ``Query.ids`` and
            what ``features`` returns count them.
        stays_here: one clause that says why no Gaussians can be handed to other programs; empty where they can.
    """

    rows: str = GAUSSIANS
    per_row: int = 1
    stays_here: str = ""
    modality: str = "thermal"
    companions: tuple[str, ...] = ()
    modality_channels: tuple[int, ...] = (1,)
    shared_opacity: bool = False
    start_opacity: float = 0.6
    averaged: float = 0.1

    @property
    def images(self) -> tuple[tuple[str, int], ...]:
        """Name and channels of each image that it explains, its own first."""
        return tuple(zip((self.modality, *self.companions), self.modality_channels, strict=True))

    @property
    def opacity_channels(self) -> tuple[int, ...]:
        """Channels that each set of opacities composites: those of the renderer's modalities."""
        return (sum(self.modality_channels),) if self.shared_opacity else self.modality_channels

    def check(self, scene: SceneData) -> None:
        """As ``Heat.check``; raises SceneError also when a view has no image of a companion."""
        super().check(scene)
        for modality in self.companions:
            parts = scene.train, scene.val, scene.test
            without = {  # by their names, as validation views are test views, too
                view.frame.name: None for part in parts for view in part if getattr(view, modality) is None
            }
            if without:
                raise SceneError(
                    f"{type(self).__name__} explains {modality} images too, but {len(without)} of the views of "
                    f"scene '{scene.name}' have none, {next(iter(without))} first. Give each thermal image its {modality} image "
                    "(of the same name), or choose a method that explains thermal images alone."
                )

    @property
    def removable(self) -> tuple[str, ...]:
        """Names of parts without which it can be looked at."""
        return ()

    @contextmanager
    def without(self, name: str) -> Iterator[None]:
        """While it lasts, a part of ``removable`` is absent."""
        raise KeyError(name)
        yield

    @abstractmethod
    def features(self, splats: Splats, query: Query) -> Tensor:
        """What the Gaussians in ``query.ids`` emit, [n, C] in image units. Evaluates those only."""

    def geometry(self, splats: Splats, query: Query) -> Geometry | None:
        """Geometry at ``query.time_s`` for deforming models; None means that splats stay as they are."""
        return None

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        """Temperature at a time in kelvin of the Gaussians ``ids``, or of all, [n]; None where the model has no temperature."""
        return None

    def temperatures(self, splats: Splats, times_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        """``temperature`` at increasing times, [T, n], of a model that has one: a model that goes on from one time to the next
        is quicker so."""
        return torch.stack([self.temperature(splats, time_s, ids) for time_s in times_s])
