"""Splats before the first step: where they are, how large, and what image value they start from."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, evenly_spread, quantile
from heatsplat.geometry.neighbours import neighbour_distances
from heatsplat.geometry.rotations import matrices_to_quats
from heatsplat.geometry.surfaces import plane_thickness
from heatsplat.geometry.voxels import cells, middles, spacing
from heatsplat.io.ply import read_splats
from heatsplat.physics.units import celsius
from heatsplat.splats import ANCHORS, GAUSSIANS, GEOMETRY, NOTHING, Splats
from heatsplat.thermal.base import PerGaussian, Seeds, ThermalModel
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.rng import generator_for
from heatsplat.training.trained_frames import camera_movement

log = logging.getLogger(__name__)

NEIGHBOURS = 3  # a new splat is as large as the distance to its nearest points (Kerbl et al. 2023)
OF_A_PLANE = 10  # points, itself among them, that tell the plane in which it lies
# Distance to the nearest points from which a splat's size is taken, at least: in world units (Kerbl et al. 2023), and in
# extents, which is less where a world is small.
LEAST_DISTANCE, LEAST_OF_EXTENT = 1e-7**0.5, 1e-4
LONE_SIZE = 0.1  # semi-axis in extents of a Gaussian that is the only one and has no neighbours
ABSENT = -30.0  # logit of an opacity of 1e-13: what no renderer shows and no gradient reaches
SAMPLED_VIEWS = 64  # image values at the points come from this many views at most, evenly spread
# Share of Gaussians in view below which they may be of another world, and the factor between their size and that of the scene's
# points from which they may. Those of a run on the same images are nearly all in view; of a larger survey a part is.
FEW_SEEN, ANOTHER_SIZE = 0.2, 10.0
MAX_MEASURED = 100_000  # Gaussians that tell both
# What a point cloud may hold beside the geometry, in words (``read_splats``).
APPEARANCE = {"values": "colours", "sh_rest": "spherical harmonics", "temperature_k": "temperatures"}


class Start(ABC):
    """How splats start.

    Attributes:
        rows: of which models (``ThermalModel.rows``) it knows how the rows of their splats start.
    """

    rows = frozenset({GAUSSIANS, ANCHORS})

    @abstractmethod
    def __call__(
        self, scene: SceneData, thermal: ThermalModel, seed: int, cap_max: float | None = None
    ) -> tuple[Splats, dict[str, PerGaussian]]:
        """Splats for a scene, and what the thermal model declared about its tensors (learning rates, penalties).

        There are at most ``cap_max`` of them (``DensityControl``): of more points, a seeded draw.
        """


class Initialisation(Start):
    """Splats start at points, of the scene or drawn.

    Args:
        source: "sfm" takes the scene's points, "random" draws ``count`` of them in the box of the points.
        count: number of Gaussians drawn by "random"; for "sfm", points beyond this many are left out by a seeded
            draw. None takes all points.
        opacity: initial opacity in (0, 1); None: that of the thermal model (``ThermalModel.start_opacity``).
        scale: factor on the initial size, above 0.
        thinnest: least semi-axis across the plane of the nearest points, as a share of those in it. A Gaussian is as thick as
            these points are, and lies in their plane; at 1 it is a ball.
        separate: each modality starts with Gaussians of its own, which the others do not see and never will: their
            opacity there is ``ABSENT``. Needs a thermal model whose images have opacities of their own.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    def __init__(
        self,
        source: str = "sfm",
        count: int | None = None,
        opacity: float | None = None,
        scale: float = 1.0,
        thinnest: float = 1.0,
        separate: bool = False,
    ) -> None:
        if source not in ("sfm", "random"):
            raise ValueError(f"init.source must be 'sfm' or 'random', got '{source}'")
        if opacity is not None and not 0 < opacity < 1:
            raise ValueError(f"init.opacity must lie in (0, 1), or be null, got {opacity}")
        if scale <= 0 or (count is not None and count < 1):
            raise ValueError(f"init.scale must be above 0 and init.count at least 1, or null, got {scale} and {count}")
        if not 0 < thinnest <= 1:
            raise ValueError(f"init.thinnest must lie in (0, 1], got {thinnest}")
        self.source, self.count, self.opacity, self.scale = source, count, opacity, scale
        self.thinnest, self.separate = thinnest, separate

    def __call__(
        self, scene: SceneData, thermal: ThermalModel, seed: int, cap_max: float | None = None
    ) -> tuple[Splats, dict[str, PerGaussian]]:
        times = len(thermal.opacity_channels) if self.separate else 1
        most = None if cap_max is None else max(cap_max / times, 1)
        means = self._means(scene, generator_for(seed, 0, "init"), most)
        count, distances = len(means), neighbour_distances(means, NEIGHBOURS)
        if count == 1:
            distances = torch.full((1, 1), LONE_SIZE * scene.extent)
        squared = distances.square().mean(1).clamp(min=min(LEAST_DISTANCE, LEAST_OF_EXTENT * scene.extent) ** 2)
        opacity = thermal.start_opacity if self.opacity is None else self.opacity
        logit = torch.logit(torch.tensor(opacity))
        geometry = {
            "means": means,
            "log_scales": (0.5 * squared.log() + np.log(self.scale))[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "opacity_logits": logit.repeat(count, len(thermal.opacity_channels)),
        }
        if self.thinnest < 1:
            axes, thickness = plane_thickness(scene.points, means, OF_A_PLANE)
            geometry["quats"] = matrices_to_quats(axes).float()
            geometry["log_scales"][:, 2] += thickness.clamp(self.thinnest, 1.0).log().float()
        if self.separate:
            geometry = _separate(geometry)
        return with_heat(geometry, scene, thermal, seed)

    def _means(self, scene: SceneData, generator: torch.Generator, most: float | None) -> Tensor:
        points = scene.points.float()
        wanted = (self.count or 100_000) if self.source == "random" else min(self.count or len(points), len(points))
        count = wanted if most is None else int(min(wanted, most))
        if count < wanted:
            log.info("init: %s of %s Gaussians, as many as density.cap_max allows", f"{count:,}", f"{wanted:,}")
        if self.source == "random":
            low, high = scene.box
            return low + (high - low) * torch.rand(count, 3, generator=generator)
        if len(points) < NEIGHBOURS + 1:
            raise SceneError(
                f"scene '{scene.name}' has {len(points)} points, at least {NEIGHBOURS + 1} are needed to start from; "
                "use init=random."
            )
        return _drawn(points, count, generator)


class NoSplats(Start):
    """No rows: how fields start, whose tables and networks the model draws itself."""

    rows = frozenset({NOTHING})

    def __call__(
        self, scene: SceneData, thermal: ThermalModel, seed: int, cap_max: float | None = None
    ) -> tuple[Splats, dict[str, PerGaussian]]:
        """Splats without rows, and what the thermal model declared, which is nothing as a rule."""
        shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (len(thermal.opacity_channels),)}
        means, values = torch.zeros(0, 3), torch.zeros(0, sum(thermal.modality_channels))
        declared = declared_by(thermal, Seeds(means, values, generator_for(seed, 0, "thermal")))
        geometry = {name: torch.zeros(0, *shape) for name, shape in shapes.items()}
        return Splats(geometry | {name: item.initial for name, item in declared.items()}), declared


class Voxels(Initialisation):
    """One row in the middle of each cube that holds a point of the scene: where anchors begin.

    Args:
        voxel: edge of the cubes in world units; None takes the median distance of the points to the nearest other one.
        opacity, scale: as for ``Initialisation``.

    Raises:
        ValueError: an option is out of its range.
        SceneError: the points lie on one another, so that they tell no size of cubes.
    """

    def __init__(self, voxel: float | None = None, opacity: float = 0.1, scale: float = 1.0) -> None:
        super().__init__("sfm", None, opacity, scale)
        if voxel is not None and voxel <= 0:
            raise ValueError(f"init.voxel must be above 0, or null, got {voxel}")
        self.voxel = voxel

    def _means(self, scene: SceneData, generator: torch.Generator, most: float | None) -> Tensor:
        size = self.voxel or spacing(scene.points)
        if size == 0:
            raise SceneError(
                f"most points of scene '{scene.name}' coincide, so no voxel size can be derived from them: give init.voxel"
            )
        means = middles(torch.unique(cells(scene.points, size), dim=0), size)
        return means if most is None else _drawn(means, most, generator)


class Pretrained(Start):
    """Splats whose geometry and opacity are those of an earlier run or of a file.

    Heat starts as it does elsewhere, but for a model of the images that a file holds: of colours, of visible images, or of
    temperatures, where the scene has bounds. What is not taken is logged; Gaussians that are hardly in view, or of another size
    than the scene, are warned of.

    Args:
        path: a point cloud .ply in the layout of 3DGS, or a checkpoint .ckpt of heatsplat, in the world of the scene. A
            restored run reads it again.

    Raises:
        SceneError: there is no such file, or it holds no splats, or anchors where Gaussians are wanted, or no training view sees
            any of them.
    """

    def __init__(self, path: str | None) -> None:
        if path is None:
            raise SceneError("init.path is not set; give a point cloud .ply or a checkpoint .ckpt of the same scene")
        self.path = Path(path).expanduser()

    def __call__(
        self, scene: SceneData, thermal: ThermalModel, seed: int, cap_max: float | None = None
    ) -> tuple[Splats, dict[str, PerGaussian]]:
        """Splats for a scene, and what the thermal model declared about its tensors; more than ``cap_max`` are all kept."""
        check_start(self.path)
        if self.path.suffix == ".ply":
            geometry, appearance = _splats_of_file(self.path)
        else:
            geometry, appearance = _geometry_of_checkpoint(self.path, scene, thermal), {}
        wanted = len(thermal.opacity_channels)
        if geometry["opacity_logits"].shape[1] != wanted:  # of another number of modalities: all start from the first
            geometry["opacity_logits"] = geometry["opacity_logits"][:, :1].repeat(1, wanted)
        log.info("%d Gaussians from %s", len(geometry["means"]), self.path)
        _check_world(self.path, geometry["means"], scene)
        values = _take_values(appearance, scene, thermal)
        splats, declared = with_heat(geometry, scene, thermal, seed, values)
        _take_harmonics(appearance, splats)
        if appearance:
            left = ", ".join(APPEARANCE[name] for name in appearance)
            log.info("init.path: %s of the file are not taken: they are not what this model starts from", left)
        return splats, declared


def check_start(path: Path | str) -> None:
    """Raises SceneError where there is no file at a path that splats are to start from."""
    if not Path(path).expanduser().is_file():
        raise SceneError(f"init.path={path}: there is no such file (a run that started from one needs it again)")


def _check_world(path: Path, means: Tensor, scene: SceneData) -> None:
    """Warns of Gaussians at ``means`` that may be of another world than the scene. Raises SceneError where none is in view."""
    means = means[:: max(1, len(means) // MAX_MEASURED)]
    if not len(means):
        return
    seen = torch.zeros(len(means), dtype=torch.bool)
    for position in evenly_spread(len(scene.train), SAMPLED_VIEWS):
        camera = scene.train.frames[position].camera
        seen |= camera.inside(*camera.project(means))
    share = float(seen.double().mean())
    remedy = "give a .ply or a checkpoint in the coordinates of this scene, or take init=sfm"
    if share == 0:
        raise SceneError(
            f"init.path={path}: no training view of scene '{scene.name}' sees any of its Gaussians: {remedy}"
        )
    if share < FEW_SEEN:
        log.warning(
            "init.path=%s: training views see %.2g %% of its Gaussians, which may be of another world: %s",
            path, 100 * share, remedy,
        )  # fmt: skip
    low, high = quantile(means.float(), torch.tensor([0.01, 0.99]))
    size, own = float((high - low).max()), scene.bulk[1]
    if "points_random" not in scene.notes and not 1 / ANOTHER_SIZE < size / own < ANOTHER_SIZE:
        log.warning(
            "init.path=%s: its Gaussians extend over %.3g world units and the points of scene '%s' over %.3g, so they may be of "
            "another world: %s", path, size, scene.name, own, remedy,
        )  # fmt: skip


def _drawn(points: Tensor, most: float, generator: torch.Generator) -> Tensor:
    """Points [n, 3] in their order, at most ``most`` of them, infinity for all: of more, a draw."""
    if most >= len(points):
        return points
    return points[torch.randperm(len(points), generator=generator)[: int(most)].sort().values]


def _separate(geometry: dict[str, Tensor]) -> dict[str, Tensor]:
    """The Gaussians [N] once for each of their M opacities, M N of them, of which each has only that one."""
    count, modalities = geometry["opacity_logits"].shape
    if modalities < 2:
        raise SceneError(
            "init.separate=true gives every image Gaussians of its own, but the thermal model has one opacity for all; give "
            "it more (thermal.shared_opacity=false, or thermal.dual_opacity=true), or leave init.separate out"
        )
    several = {name: tensor.repeat(modalities, 1) for name, tensor in geometry.items()}
    own = torch.eye(modalities, dtype=torch.bool).repeat_interleave(count, dim=0)
    return several | {"opacity_logits": several["opacity_logits"].where(own, ABSENT)}


def _take_values(appearance: dict[str, Tensor], scene: SceneData, thermal: ThermalModel) -> Tensor | None:
    """Image values [N, C] that a model starts from, taken out of what a file holds: its colours for a model of visible images,
    its temperatures in the scene's bounds for one of temperatures; None where it holds neither for this model."""
    images, bounds = (thermal.modality, thermal.modality_channels), scene.range_of(thermal.modality)
    if images == ("rgb", (3,)):
        return appearance.pop("values", None)
    if images == ("thermal", (1,)) and bounds is not None and "temperature_k" in appearance:
        return bounds.to_unit(celsius(appearance.pop("temperature_k")))[:, None].clamp(0, 1)
    return None


@torch.no_grad()
def _take_harmonics(appearance: dict[str, Tensor], splats: Splats) -> None:
    """Puts the harmonics that a file holds into splats that have such, as many as both have; only beside colours that were
    taken (``_take_values``)."""
    if "values" in appearance or "sh_rest" not in appearance or "sh_rest" not in splats:
        return
    rest, own = appearance["sh_rest"], splats["sh_rest"]
    if rest.shape[2] == own.shape[2]:
        count = min(rest.shape[1], own.shape[1])
        own[:, :count] = appearance.pop("sh_rest")[:, :count]


def with_heat(
    geometry: dict[str, Tensor], scene: SceneData, thermal: ThermalModel, seed: int, values: Tensor | None = None
) -> tuple[Splats, dict[str, PerGaussian]]:
    """Splats of geometry tensors and of what a thermal model wants beside them, and what it declared.

    Image ``values`` [N, C] of the Gaussians are, unless they are given, those that the training views see.
    """
    means = geometry["means"]
    looks = torch.cat([looks_at(scene, means, name, channels) for name, channels in thermal.images], dim=2)
    generator, log_scales = generator_for(seed, 0, "thermal"), geometry["log_scales"]
    seen = usual_values(scene, looks) if values is None else values
    seeds = Seeds(means, seen, generator, looks, _times(scene), log_scales)
    declared = declared_by(thermal, seeds)
    return Splats(geometry | {name: item.initial for name, item in declared.items()}), declared


def declared_by(thermal: ThermalModel, seeds: Seeds) -> dict[str, PerGaussian]:
    """What a thermal model declares in ``per_gaussian``.

    Raises:
        ValueError: a tensor has a name of the geometry, a negative rate, or values that are no finite floats, one row for each
            Gaussian; the message names it.
    """
    declared, count = thermal.per_gaussian(seeds), len(seeds.means)
    for name, item in declared.items():
        what = f"'{name}' in per_gaussian of {type(thermal).__name__}"
        if name in GEOMETRY:
            raise ValueError(f"{what} is the name of a tensor of the geometry ({', '.join(GEOMETRY)}): choose another")
        if not isinstance(item, PerGaussian):
            raise ValueError(f"{what} is of type {type(item).__name__}: give PerGaussian(initial, lr)")
        initial = item.initial
        if not isinstance(initial, Tensor) or not initial.is_floating_point() or initial.shape[:1] != (count,):
            shown = f"{initial.dtype} {list(initial.shape)}" if isinstance(initial, Tensor) else type(initial).__name__
            raise ValueError(f"{what} must start from floats [{count}, ...], one row for each Gaussian, got {shown}")
        if not bool(initial.isfinite().all()):
            raise ValueError(f"{what} starts from {int((~initial.isfinite()).sum())} values that are NaN or infinite")
        if not isinstance(item.lr, int | float) or not 0 <= item.lr < float("inf"):
            raise ValueError(f"{what} has a learning rate of {item.lr}, which must be 0 (not trained) or more")
    return declared


def _times(scene: SceneData) -> Tensor | None:
    """When the views of ``looks_at`` were taken, in seconds."""
    times = [scene.train.frames[i].time_s for i in evenly_spread(len(scene.train), SAMPLED_VIEWS)]
    return None if None in times else torch.tensor(times, dtype=torch.float64)


def _splats_of_file(path: Path) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Geometry of a point cloud, and what else it holds (``APPEARANCE``)."""
    try:
        tensors = {name: torch.from_numpy(values.copy()) for name, values in read_splats(path).items()}
    except ValueError as error:
        raise SceneError(f"init.path: {error}") from error
    return {name: tensors.pop(name) for name in GEOMETRY}, tensors


def _geometry_of_checkpoint(path: Path, scene: SceneData, thermal: ThermalModel) -> dict[str, Tensor]:
    """Geometry of a checkpoint, whose rows are Gaussians or what those of the model are; cameras of frames of the same names that
    moved are warned of."""
    try:
        stored = load_checkpoint(path)
    except SceneError as error:
        raise SceneError(f"init.path: {error}") from error
    tensors = stored.get("state_dict", {})
    missing = [name for name in GEOMETRY if f"splats.raw.{name}" not in tensors]
    if missing:
        raise SceneError(f"init.path={path} is no checkpoint of heatsplat: it holds no {', '.join(missing)} of splats")
    geometry = {name: tensors[f"splats.raw.{name}"] for name in GEOMETRY}
    written = stored.get("heatsplat", {})
    frames = written.get("scales", {}).get("frames")
    movement = None if frames is None else camera_movement(frames, scene.train.frames, scene)
    if movement is not None:
        # Frames of another camera have other places too, by its mounting.
        log.warning(
            "init.path=%s: %s: unless the frames are of another camera, its Gaussians are not in the world of this scene",
            path,
            movement,
        )
    rows = written.get("rows", GAUSSIANS) if len(geometry["means"]) else NOTHING
    if rows not in (GAUSSIANS, thermal.rows):
        kind = "a field without Gaussians" if rows == NOTHING else "anchors, whose Gaussians are made for each view"
        raise SceneError(
            f"init.path={path} holds {kind}: give a .ply, or the checkpoint of a method of Gaussians such as 3dgs"
        )
    return geometry


def looks_at(scene: SceneData, points: Tensor, modality: str, channels: int) -> Tensor:
    """Image values at the projections of points in ``SAMPLED_VIEWS`` training views, [P, F, channels] in [0, 1], NaN where a
    view does not see one. No test for occlusion. What is a mere bound of a temperature counts at points of which no view knows
    more."""
    positions = evenly_spread(len(scene.train), SAMPLED_VIEWS)
    samples = torch.full((len(positions), len(points), channels), float("nan"))
    bound = torch.zeros(len(positions), len(points), dtype=torch.bool)
    for row, position in enumerate(positions):
        view = scene.train[position]
        image, camera = view.image(modality), view.camera
        pixels, depths = camera.project(points)
        ids = camera.inside(pixels, depths).nonzero().squeeze(1)
        at_column, at_line = pixels[ids].long().unbind(1)
        if view.mask is not None:
            valid = view.mask[at_line, at_column]
            ids, at_line, at_column = ids[valid], at_line[valid], at_column[valid]
        values = image[at_line, at_column]
        samples[row, ids] = values if values.shape[1] == channels else values.mean(1, keepdim=True).expand(-1, channels)
        if modality == "thermal" and view.ends is not None:
            bound[row, ids] = view.ends[at_line, at_column] != 0
    known = (~bound & ~samples.isnan().any(2)).any(0)
    samples[bound & known] = torch.nan
    return samples.transpose(0, 1)


def usual_values(scene: SceneData, looks: Tensor) -> Tensor:
    """Median [P, channels] of what views see of points, [P, F, channels]: it stands what was hidden in some of them.

    Points that no view sees get the median of the others.
    """
    medians = looks.nanmedian(dim=1).values
    unseen = medians.isnan().any(1)
    if unseen.all():
        raise SceneError(
            f"none of the {len(looks)} points of scene '{scene.name}' lies in any training view: points and cameras "
            "are in different coordinate systems"
        )
    medians[unseen] = medians[~unseen].median(0).values
    return medians
