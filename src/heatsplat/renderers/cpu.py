"""The fast renderer of this machine's processor: drives heatsplat.kernels and puts them into autograd.

Forward: project, (features of what is visible), sort_by_depth, find_instances, deal_to_tiles, composite. Backward:
composite_backward, project_backward. What they pass to each other lies in buffers that outlive the call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import RenderOutput, WeightedSums
from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import binning, compositing, projection
from heatsplat.kernels.buffers import Buffers
from heatsplat.kernels.constants import BLOCKS, CHUNK, RANK, SCREEN, SUMS, TILE
from heatsplat.kernels.layout import Layout
from heatsplat.kernels.scheduling import thread_count
from heatsplat.kernels.simd import LANES
from heatsplat.renderers.base import FOV_MARGIN, RenderInputs
from heatsplat.renderers.reference import channel_counts

_CENTRES = compositing.pixel_centres()
_UNWANTED, _NO_MAPS = np.empty((0, 0), np.float32), np.empty((0, 0, 0), np.float32)


def render(inputs: RenderInputs) -> RenderOutput:
    """Composited features, alpha and depth; ``heatsplat.renderers.rasterization`` has the contract.

    The image and all gradients are bitwise the same for any number of threads and from run to run.

    **Convention:** Gaussians whose screen covariance has a determinant beyond float32 are not seen (round ones of 4e9 pixels).

    Raises:
        ValueError: tensors are not float32 on the CPU, or features do not fit.
    """
    for name in ("means", "quats", "scales", "opacities"):
        _check(name, getattr(inputs, name))
    frame = _Frame(inputs)
    ids = frame.project()
    features = inputs.features(ids) if callable(inputs.features) else inputs.features
    channels = channel_counts(inputs, features, len(ids) if callable(inputs.features) else frame.count)
    background = features.new_zeros(features.shape[1]) if inputs.background is None else inputs.background
    _check("features", features)
    _check("background", background)
    sums = torch.zeros(len(ids), inputs.maps, requires_grad=True) if inputs.maps else None
    image, alpha, depth, maps = _Rasterize.apply(
        frame, channels, ids, inputs.means, inputs.quats, inputs.scales, inputs.opacities, features, background,
        inputs.viewmat, inputs.K, frame.means2d, sums,
    )  # fmt: skip
    meta = {"means2d": frame.means2d, "radii": frame.radii, "visible_ids": ids}
    return RenderOutput(image, alpha, depth, meta, None if sums is None else WeightedSums(maps, sums))


def depths_at_shares(inputs: RenderInputs, shares: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Alpha [H, W], and camera z [H, W, S] of the Gaussians with which pixels reach ``shares`` of it, front to back. Pixels
    without opacity have any.

    Args:
        inputs: with depth, of one modality without features ([N, 0]).
        shares: [S] increasing, above 0 and below 1.

    Raises:
        ValueError: as of ``render``.
    """
    for name in ("means", "quats", "scales", "opacities", "features"):
        _check(name, getattr(inputs, name))
    frame = _Frame(inputs)
    frame.bin((0,), frame.project(), inputs.features)
    _, alpha, _ = frame.composite(inputs.features.new_zeros(0))
    return alpha[0], frame.depths_at_shares(shares)


def _check(name: str, tensor: Tensor) -> None:
    if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
        raise ValueError(
            f"renderer 'cpu' needs float32 tensors on the CPU, {name} is {tensor.dtype} on {tensor.device}; "
            "'reference' takes float64 and 'gsplat' takes CUDA"
        )


class _Rasterize(torch.autograd.Function):
    """The image of a projected frame; ``means2d`` and ``sums`` are inputs, for density control looks at their gradients."""

    @staticmethod
    def forward(
        ctx, frame, channels, ids, means, quats, scales, opacities, features, background, viewmat, K, means2d, sums
    ):
        ctx.frame, ctx.means2d = frame, means2d
        ctx.save_for_backward(means, quats, scales, opacities, features)
        frame.bin(channels, ids, features)
        maps = None if sums is None else torch.zeros(frame.inputs.height, frame.inputs.width, sums.shape[1])
        return *frame.composite(background), maps

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image, v_alpha, v_depth, maps):
        means, quats, scales, opacities, features = ctx.saved_tensors
        v_background = ctx.frame.composite_backward(v_image, v_alpha, v_depth, maps)
        *v_gaussians, v_means2d, sums, absgrad, v_viewmat, v_K = ctx.frame.project_backward(
            means, quats, scales, opacities, features, camera=any(ctx.needs_input_grad[9:11])
        )
        if absgrad is not None:
            ctx.means2d.absgrad = absgrad
        return None, None, None, *v_gaussians, v_background, v_viewmat, v_K, v_means2d, sums


class _Frame:
    """One rendering: what the forward kernels leave for each other and for the backward kernels.

    It keeps its buffers for as long as autograd keeps it, so that any number of renderings may wait for their backward
    pass; then it leaves them to the next rendering.
    """

    def __init__(self, inputs: RenderInputs) -> None:
        self.inputs = inputs
        self.count, self.chunks = len(inputs.means), -(-len(inputs.means) // CHUNK)
        self.tiles_x, self.tiles_y = -(-inputs.width // TILE), -(-inputs.height // TILE)
        self.workers = thread_count()
        self.camera = _camera_vector(inputs)
        self.buffers = Buffers.lend()

    def __del__(self) -> None:
        if hasattr(self, "buffers"):
            self.buffers.give_back()

    def project(self) -> Tensor:
        """Ids of the visible Gaussians, ascending [n] int64. Makes ``means2d`` and ``radii``."""
        array, inputs, count, chunks = self.buffers.array, self.inputs, self.count, self.chunks
        self.means2d, self.radii = torch.empty(count, 2), torch.empty(count, 2, dtype=torch.int32)
        self.screen, self.depths = array("screen", np.float32, count, SCREEN), array("depths", np.float32, count)
        self.seen = array("seen", np.int32, -(-count // LANES))
        self.first_ranks = array("first_ranks", np.int64, chunks)
        ids = torch.empty(count, dtype=torch.int64)
        given = _numpy(inputs.opacities)
        self.opacities = array("opacities", np.float32, *given.shape) if inputs.raw else given
        visible, self.bound = projection.project(
            _numpy(inputs.means), _numpy(inputs.quats), _numpy(inputs.scales), given, inputs.raw,
            self.camera, inputs.width, inputs.height, inputs.antialiased,
            self.opacities, self.screen, self.depths, self.means2d.numpy(), self.radii.numpy(), self.seen, ids.numpy(),
            self.first_ranks, array("bounds", np.int64, chunks), array("columns", np.float32, chunks, RANK, LANES),
        )  # fmt: skip
        self.means2d.requires_grad_(any(x.requires_grad for x in (inputs.means, inputs.viewmat, inputs.K)))
        return ids[:visible]

    def bin(self, channels: tuple[int, ...], visible: Tensor, features: Tensor) -> None:
        """Deals out the visible Gaussians, with their features, to the tiles."""
        array, inputs = self.buffers.array, self.inputs
        modality_of = [modality for modality, count in enumerate(channels) for _ in range(count)]
        self.layout = Layout(tuple(modality_of + [0] * inputs.depth), len(channels))
        self.backward_layout = replace(self.layout, absgrad=inputs.absgrad, maps=inputs.maps)
        count, slabs = len(visible), binning.SLABS * self.workers

        self.ids = array("ids", np.int32, count)
        binning.sort_by_depth(
            visible.numpy(), self.depths, self.ids, array("keys", np.float32, count),
            array("other_ids", np.int32, count), array("other_keys", np.float32, count),
            array("histogram", np.int64, binning.BUCKETS),
        )  # fmt: skip
        self.records = array("records", np.float32, count, self.layout.record_size)
        found = array("found", np.int64, self.bound + slabs, 2)
        found_starts, found_counts = array("found_starts", np.int64, slabs), array("found_counts", np.int32, count)
        counts = array("counts", np.int64, slabs, self.tiles_x * (self.tiles_y + 1))
        binning.find_instances(
            self.workers, self.ids, self.screen, inputs.width, _numpy(features), callable(inputs.features),
            self.first_ranks, self.opacities, inputs.depth, np.zeros((2, 1), np.int64),
            self.records, found, found_starts, found_counts, counts,
        )  # fmt: skip
        self.spans = array("spans", np.int32, self.count, 2)
        self.tile_starts = array("tile_starts", np.int64, self.tiles_x * self.tiles_y + 1)
        self.instances = array("instances", np.int64, self.bound, 2)
        binning.deal_to_tiles(
            self.workers, self.ids, found, found_starts, found_counts, counts, np.zeros(1, np.int64),
            array("slab_starts", np.int64, slabs), self.spans, self.tile_starts, self.instances,
        )  # fmt: skip

    def composite(self, background: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The image [H, W, C], alpha [M, H, W] and depth [H, W] or None."""
        array, layout, height, width = self.buffers.array, self.layout, self.inputs.height, self.inputs.width
        image, alpha = torch.empty(height, width, len(background)), torch.empty(layout.modalities, height, width)
        depth = torch.empty(height, width) if self.inputs.depth else None
        self.tile_ends = array("tile_ends", np.int64, self.tiles_x * self.tiles_y)
        blocks = self.tiles_x * self.tiles_y * BLOCKS
        self.transmittances = array("transmittances", np.float32, blocks, layout.modalities, LANES)
        self.composited = array("composited", np.float32, blocks, layout.channels, LANES)
        compositing.composite(
            layout, self.workers, self.records, self.instances, self.tile_starts, _CENTRES, _numpy(background),
            np.zeros(1, np.int64), self.tile_ends, self.transmittances, self.composited,
            image.numpy(), alpha.numpy(), _UNWANTED if depth is None else depth.numpy(),
        )  # fmt: skip
        return image, alpha, depth

    def depths_at_shares(self, shares: Sequence[float]) -> Tensor:
        """Depths [H, W, S] at which composited pixels reach shares of their opacity."""
        array, rows = self.buffers.array, self.workers * BLOCKS
        depths = torch.full((self.inputs.height, self.inputs.width, len(shares)), torch.inf)
        compositing.depths_at_shares(
            self.layout, self.workers, self.records, self.instances, self.tile_starts, self.tile_ends, _CENTRES,
            self.transmittances, np.array(shares, np.float32), np.zeros(1, np.int64),
            array("state", np.float32, rows, 3, LANES), array("numbers", np.int64, rows, LANES), depths.numpy(),
        )  # fmt: skip
        return depths

    def composite_backward(
        self, v_image: Tensor, v_alpha: Tensor, v_depth: Tensor | None, maps: Tensor | None
    ) -> Tensor:
        """The gradient of the background [C]. Leaves what the Gaussians need in their slots."""
        array, layout, rows = self.buffers.array, self.backward_layout, self.workers * BLOCKS
        self.slots = array("slots", np.float32, int(self.tile_starts[-1]), layout.slot_size)
        v_background = array("v_background", np.float32, self.tiles_x * self.tiles_y, v_image.shape[2])
        compositing.composite_backward(
            layout, self.workers, self.records, self.instances, self.tile_starts, self.tile_ends, _CENTRES,
            self.transmittances, self.composited, np.zeros(1, np.int64),
            _numpy(v_image), _numpy(v_alpha), _UNWANTED if v_depth is None else _numpy(v_depth),
            _NO_MAPS if maps is None else _numpy(maps), array("v_pixels", np.float32, rows, layout.pixel_rows, LANES),
            array("state", np.float32, rows, 2 * layout.modalities, LANES), self.slots, v_background,
        )  # fmt: skip
        return torch.from_numpy(v_background.sum(axis=0, dtype=np.float64).astype(np.float32))

    def project_backward(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, camera: bool
    ) -> tuple[Tensor | None, ...]:
        """Gradients of the Gaussians and of ``means2d``; where they are wanted sums of maps [n, S] and absolute screen
        gradients [N, 2]; and the gradients of the view matrix and of the intrinsics where ``camera`` wants them."""
        v = [torch.empty(tensor.shape) for tensor in (means, quats, scales, opacities, features)]
        absgrad = torch.empty(self.count, 2) if self.inputs.absgrad else None
        v_means2d, sums = torch.empty(self.count, 2), torch.empty(len(self.ids), self.inputs.maps)
        v_cameras = np.zeros((self.chunks, 16 if camera else 0))
        scratch = LANES * SUMS + -(-self.backward_layout.slot_size // LANES) * LANES
        projection.project_backward(
            _numpy(means), _numpy(quats), _numpy(scales), self.opacities, self.inputs.raw, self.camera,
            self.inputs.antialiased, self.inputs.depth, callable(self.inputs.features), self.first_ranks, self.seen,
            self.spans, self.slots,
            self.buffers.array("sums", np.float32, self.chunks * scratch),
            *(gradient.numpy() for gradient in v), sums.numpy(), _UNWANTED if absgrad is None else absgrad.numpy(),
            v_means2d.numpy(), v_cameras,
        )  # fmt: skip
        sums = sums if self.inputs.maps else None
        if not camera:
            return *v, v_means2d, sums, absgrad, None, None
        v_viewmat, v_K = torch.zeros(4, 4), torch.zeros(3, 3)
        v_camera = torch.from_numpy(v_cameras.sum(axis=0))
        v_viewmat[:3, :3], v_viewmat[:3, 3] = v_camera[:9].view(3, 3), v_camera[9:12]
        v_K[0, 0], v_K[1, 1], v_K[:2, 2] = v_camera[12], v_camera[13], v_camera[14:]
        return *v, v_means2d, sums, absgrad, v_viewmat, v_K


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _camera_vector(inputs: RenderInputs) -> np.ndarray:
    """The camera as ``heatsplat.kernels.projection`` takes it."""
    width, height = inputs.width, inputs.height
    viewmat, intrinsics = inputs.viewmat.detach().tolist(), inputs.K.detach().tolist()
    (fx, _, cx), (_, fy, cy), _ = intrinsics
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    limits = -cx / fx - margin_x, (width - cx) / fx + margin_x, -cy / fy - margin_y, (height - cy) / fy + margin_y
    rows = viewmat[:3]
    numbers = [number for row in rows for number in row[:3]] + [row[3] for row in rows]
    eps2d = np.float32(inputs.eps2d)  # squared here: a square inside the kernel could melt into a fused multiply-add
    return np.array((*numbers, fx, fy, cx, cy, *limits, inputs.near, inputs.far, eps2d, eps2d * eps2d), np.float32)
