"""The fast renderer of this machine's processor: drives heatsplat.kernels and puts them into autograd.

A call runs five kernels forward (project, find_instances, sort_by_depth, deal_to_tiles, composite) and two backward
(composite_backward, project_backward). What they pass to each other lies in buffers that outlive the call.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from heatsplat.contracts import RenderOutput
from heatsplat.kernels import binning, compositing, projection
from heatsplat.kernels.compilation import announced
from heatsplat.kernels.layout import Layout
from heatsplat.kernels.scheduling import thread_count
from heatsplat.kernels.simd import LANES
from heatsplat.renderers.base import FOV_MARGIN, RenderInputs
from heatsplat.renderers.reference import channel_counts


def render(inputs: RenderInputs) -> RenderOutput:
    """Composited features, alpha and depth; ``heatsplat.renderers.rasterization`` has the contract.

    Raises:
        ValueError: tensors are not float32 on the CPU, or features do not fit.
    """
    _check(inputs)
    frame = _Frame(inputs)
    with announced("compiling the CPU renderer's kernels, once, about 10 s ..."):
        ids = frame.project()
    features = inputs.features(ids) if callable(inputs.features) else inputs.features
    channels = channel_counts(inputs, features, len(ids) if callable(inputs.features) else frame.count)
    background = features.new_zeros(features.shape[1]) if inputs.background is None else inputs.background
    with announced(f"compiling the CPU renderer's kernels for C = {features.shape[1]}, once, about 10 s ..."):
        image, alpha, depth = _Rasterize.apply(
            frame, channels, ids, inputs.means, inputs.quats, inputs.scales, inputs.opacities, features, background,
            inputs.viewmat, frame.means2d,
        )  # fmt: skip
    meta = {"means2d": frame.means2d, "radii": frame.radii, "visible_ids": ids}
    return RenderOutput(image, alpha, depth, meta)


def _check(inputs: RenderInputs) -> None:
    for name in ("means", "quats", "scales", "opacities"):
        tensor = getattr(inputs, name)
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"renderer 'cpu' needs float32 tensors on the CPU, {name} is {tensor.dtype} on {tensor.device}; "
                "use renderer 'reference' for float64 and 'gsplat' for CUDA"
            )


class _Rasterize(torch.autograd.Function):
    """The rendering of a projected frame as one differentiable operation."""

    @staticmethod
    def forward(ctx, frame, channels, ids, means, quats, scales, opacities, features, background, viewmat, means2d):
        ctx.frame, ctx.means2d = frame, means2d
        ctx.save_for_backward(means, quats, scales, opacities, features)
        frame.find_instances(channels, ids, features)
        return frame.composite(background)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image, v_alpha, v_depth):
        frame = ctx.frame
        means, quats, scales, opacities, features = ctx.saved_tensors
        v_background = frame.composite_backward(v_image, v_alpha, v_depth)
        gradients = frame.project_backward(means, quats, scales, opacities, features, ctx.needs_input_grad[9])
        if frame.inputs.absgrad:
            ctx.means2d.absgrad = gradients.pop("absgrad")
        v_means, v_quats, v_scales, v_opacities, v_features, v_means2d, v_viewmat = gradients.values()
        return None, None, None, v_means, v_quats, v_scales, v_opacities, v_features, v_background, v_viewmat, v_means2d


class _Buffers:
    """Arrays by name that are used again by the next rendering and grow when they must."""

    _idle: list[_Buffers] = []

    def __init__(self) -> None:
        self._flat: dict[str, np.ndarray] = {}

    @classmethod
    def lend(cls) -> _Buffers:
        """Buffers that no rendering uses; ``give_back`` returns them."""
        return cls._idle.pop() if cls._idle else cls()

    def give_back(self) -> None:
        self._idle.append(self)

    def array(self, name: str, dtype: type, *shape: int) -> np.ndarray:
        """An uninitialised array of that shape, 64-byte aligned; what an earlier call of the same name wrote is lost."""
        size = math.prod(shape)
        flat = self._flat.get(name)
        if flat is None or flat.size < size:
            items = size + size // 4 + LANES  # room to grow, and for a whole vector at the end
            raw = np.empty(items * np.dtype(dtype).itemsize + 64, np.uint8)
            skip = -raw.ctypes.data % 64
            flat = raw[skip : skip + items * np.dtype(dtype).itemsize].view(dtype)
            self._flat[name] = flat
        return flat[:size].reshape(shape)


class _Frame:
    """One rendering in the making, and then what its backward pass needs.

    It keeps its buffers for as long as autograd keeps it, so that any number of renderings may wait for their backward
    passes; then it leaves them to the next rendering.
    """

    def __init__(self, inputs: RenderInputs) -> None:
        self.inputs = inputs
        self.count, self.width, self.height = len(inputs.means), inputs.width, inputs.height
        self.chunks = -(-self.count // projection.CHUNK)
        self.tiles = -(-inputs.width // projection.TILE) * -(-inputs.height // projection.TILE)
        self.workers = thread_count()
        self.camera = _camera_vector(inputs)
        self.buffers = _Buffers.lend()

    def __del__(self) -> None:
        if hasattr(self, "buffers"):
            self.buffers.give_back()

    def project(self) -> Tensor:
        """Ids of the visible Gaussians, ascending [n] int64. Makes ``means2d`` and ``radii``."""
        array, inputs = self.buffers.array, self.inputs
        self.means2d = torch.empty(self.count, 2)
        self.radii = torch.empty(self.count, 2, dtype=torch.int32)
        self.depths = array("depths", np.float32, self.count)
        self.screen = array("screen", np.float32, self.count, projection.SCREEN)
        self.seen = array("seen", np.int32, -(-self.count // LANES))
        self.first_ranks = array("first_ranks", np.int64, self.chunks)
        ids = torch.empty(self.count, dtype=torch.int64)
        visible, self.bound = projection.project(
            _numpy(inputs.means), _numpy(inputs.quats), _numpy(inputs.scales), _numpy(inputs.opacities),
            self.camera, self.width, self.height, inputs.antialiased,
            self.screen, self.depths, self.means2d.numpy(), self.radii.numpy(), self.seen, ids.numpy(),
            self.first_ranks, array("bounds", np.int64, self.chunks),
            array("projection", np.float32, self.chunks, projection.SCREEN, LANES),
        )  # fmt: skip
        ids = ids[:visible]
        self.means2d.requires_grad_(inputs.means.requires_grad or inputs.viewmat.requires_grad)
        return ids

    def find_instances(self, channels: tuple[int, ...], visible: Tensor, features: Tensor) -> None:
        """Bins the projected Gaussians, with their ``features``, into tiles front to back."""
        array, inputs = self.buffers.array, self.inputs
        modality_of = tuple(m for m, count in enumerate(channels) for _ in range(count)) + (0,) * inputs.depth
        self.layout = Layout(modality_of, len(channels), inputs.depth, inputs.absgrad)
        seen, slabs, slots = len(visible), binning.SLABS * self.workers, self.bound
        self.ids, other_ids = array("ids", np.int32, seen), array("other_ids", np.int32, seen)
        keys, other_keys = array("keys", np.float32, seen), array("other_keys", np.float32, seen)
        binning.sort_by_depth(
            visible.numpy(), self.depths, self.ids, keys, other_ids, other_keys,
            array("histogram", np.int64, binning.BUCKETS),
        )  # fmt: skip
        self.records = array("records", np.float32, seen, self.layout.record)
        found = array("found", np.int32, slots, 2)
        found_starts, found_counts = array("found_starts", np.int64, slabs), array("found_counts", np.int32, seen)
        counts = array("counts", np.int64, slabs, self.tiles)
        binning.find_instances(
            self.workers, self.ids, self.screen, self.width, _numpy(features), callable(inputs.features),
            self.first_ranks, _numpy(inputs.opacities), inputs.depth, np.zeros((2, 1), np.int64),
            self.records, found, found_starts, found_counts, counts,
        )  # fmt: skip
        self.slot_starts = array("slot_starts", np.int64, seen + 1)
        self.instances = array("instances", np.int32, slots, binning.INSTANCE)
        self.tile_starts = array("tile_starts", np.int64, self.tiles + 1)
        binning.deal_to_tiles(
            self.workers, found, found_starts, found_counts, counts, np.zeros(1, np.int64),
            array("slab_starts", np.int64, slabs), self.slot_starts, self.tile_starts, self.instances,
        )  # fmt: skip

    def composite(self, background: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The image [H, W, C], alpha [M, H, W] and depth [H, W] or None."""
        array, layout = self.buffers.array, self.layout
        image = torch.empty(self.height, self.width, len(background))
        alpha = torch.empty(layout.modalities, self.height, self.width)
        depth = torch.empty(self.height, self.width) if self.inputs.depth else None
        self.tile_ends = array("tile_ends", np.int64, self.tiles)
        blocks = self.tiles * compositing.BLOCKS
        self.transmittances = array("transmittances", np.float32, blocks, layout.modalities, LANES)
        self.composited = array("composited", np.float32, blocks, layout.channels, LANES)
        compositing.composite(
            layout, self.workers, self.width, self.height, self.records, self.instances, self.tile_starts,
            _numpy(background), self._pixels(), np.zeros(1, np.int64), self.tile_ends, self.transmittances, self.composited,
            image.numpy(), alpha.numpy(), _NO_DEPTH if depth is None else depth.numpy(),
        )  # fmt: skip
        return image, alpha, depth

    def _pixels(self):
        pixels = self.buffers.array("pixels", np.float32, 2, 16, LANES)
        k, b = np.arange(16), np.arange(16)[:, None]
        pixels[0] = b % 4 * 4 + k % 4 + 0.5
        pixels[1] = b // 4 * 4 + k // 4 + 0.5
        return pixels

    def composite_backward(self, v_image: Tensor, v_alpha: Tensor, v_depth: Tensor | None) -> Tensor:
        """The gradient of the background [C]. Leaves what the Gaussians need in their gradient slots."""
        array, layout = self.buffers.array, self.layout
        rows = self.workers * compositing.BLOCKS
        v_background = array("v_background", np.float32, self.tiles, v_image.shape[2])
        self.moments = array("moments", np.float32, int(self.slot_starts[-1]), layout.slot)
        compositing.composite_backward(
            layout, self.workers, self.width, self.height, self.records, self.instances, self.tile_starts,
            self.tile_ends, self.transmittances, self.composited, self._pixels(), np.zeros(1, np.int64),
            _numpy(v_image), _numpy(v_alpha), _NO_DEPTH if v_depth is None else _numpy(v_depth),
            array("v_pixels", np.float32, rows, layout.channels + layout.modalities, LANES),
            array("state", np.float32, rows, layout.modalities, 2, LANES), self.moments, v_background,
        )  # fmt: skip
        return torch.from_numpy(v_background.sum(axis=0, dtype=np.float64).astype(np.float32))

    def project_backward(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, camera: bool
    ) -> dict[str, Tensor | None]:
        """Gradients by name, of the inputs in the order of the arguments, of ``means2d`` and of the view matrix."""
        inputs = self.inputs
        inputs_and_screen = {
            "means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features,
            "means2d": self.means2d,
        }  # fmt: skip
        v = {name: torch.empty(tensor.shape) for name, tensor in inputs_and_screen.items()}
        v["opacities"].zero_()
        v["features"].zero_()
        if inputs.absgrad:
            v["absgrad"] = torch.zeros(self.means2d.shape)
        v_cameras = np.zeros((self.chunks, 12 if camera else 0))
        sums = self.buffers.array("sums", np.float32, self.count, projection.SUMS)
        projection.add_up_slots(
            self.ids, self.slot_starts, self.moments, self.screen, _numpy(opacities), inputs.depth,
            callable(inputs.features), self.first_ranks, sums, v["opacities"].numpy(), v["features"].numpy(),
            v["absgrad"].numpy() if inputs.absgrad else _NO_DEPTH,
        )  # fmt: skip
        projection.project_backward(
            _numpy(means), _numpy(quats), _numpy(scales), self.camera, inputs.antialiased, self.seen, sums,
            v["means"].numpy(), v["quats"].numpy(), v["scales"].numpy(), v["means2d"].numpy(), v_cameras,
        )  # fmt: skip
        v["viewmat"] = _viewmat_gradient(v_cameras) if camera else None
        return v


_NO_DEPTH = np.empty((0, 0), np.float32)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _camera_vector(inputs: RenderInputs) -> np.ndarray:
    """The camera as the kernels take it (heatsplat.kernels.projection has the order)."""
    viewmat, intrinsics = inputs.viewmat.detach(), inputs.K.detach()
    fx, fy, cx, cy = (intrinsics[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x, margin_y = FOV_MARGIN * 0.5 * inputs.width / fx, FOV_MARGIN * 0.5 * inputs.height / fy
    limits = (
        -cx / fx - margin_x, (inputs.width - cx) / fx + margin_x,
        -cy / fy - margin_y, (inputs.height - cy) / fy + margin_y,
    )  # fmt: skip
    rotation, translation = viewmat[:3, :3].flatten().tolist(), viewmat[:3, 3].tolist()
    return np.array([*rotation, *translation, fx, fy, cx, cy, *limits, inputs.near, inputs.far], np.float32)


def _viewmat_gradient(v_camera: np.ndarray) -> Tensor:
    """[4, 4] from the chunks' gradients of rotation (9) and translation (3)."""
    v_camera = v_camera.sum(axis=0)
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3, :3], v_viewmat[:3, 3] = v_camera[:9].reshape(3, 3), v_camera[9:]
    return torch.from_numpy(v_viewmat.astype(np.float32))
