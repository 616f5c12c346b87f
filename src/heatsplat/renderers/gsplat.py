"""The CUDA backend: gsplat's kernels behind heatsplat's contract.

It calls the four steps of ``gsplat.rasterization`` itself, one projection and one sort for all modalities, because
features may be wanted only for what the projection found visible. It adds a few passes over N numbers to those steps.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib import import_module
from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.contracts import RenderOutput
from heatsplat.renderers import reference
from heatsplat.renderers.base import RenderInputs

TILE = 16  # the tile size that gsplat's kernels are tuned and tested for
CHANNELS = 32  # composited in one go; gsplat's kernels slow down beyond, as they keep a pixel's channels in registers
TOOLKIT = (
    "Install the toolkit of PyTorch's CUDA version, with nvcc, or a wheel of gsplat for this PyTorch from "
    "https://docs.gsplat.studio/whl; or choose renderer=cpu"
)


class Kernels(NamedTuple):
    """The functions of gsplat that this backend calls."""

    project: Callable
    intersect: Callable
    offsets: Callable
    rasterize: Callable


def render(inputs: RenderInputs) -> RenderOutput:
    """Composited features, alpha and depth; ``heatsplat.renderers.rasterization`` has the contract.

    **Convention:** the constants of ``renderers.base`` other than eps2d are compiled into gsplat's kernels. Rows of
    ``meta["means2d"]`` that were not seen are undefined. Quaternions whose squared length is 0 in float32 are hidden.
    Covariances are formed in float32: Gaussians 50,000 times as long as they are thick are right to a thousandth, where
    the CPU's renderer keeps four digits. Absolute screen gradients are summed over modalities and over groups of 32
    channels, each of which gsplat composites on its own.

    Raises:
        ImportError: gsplat is missing.
        ValueError: tensors are not float32 on a CUDA device, or features do not fit.
    """
    kernels = load()
    check(inputs)
    count, width, height = len(inputs.means), inputs.width, inputs.height
    if count == 0:  # gsplat's launchers divide by the number of Gaussians
        return reference.render(inputs)

    radii, means2d, depths, conics, compensations = _project(kernels, inputs)
    ids = (radii[0] > 0).all(dim=1).nonzero().squeeze(1)
    # Squeezed and unbound rather than indexed, whose gradient is a tensor of zeros and a copy into it.
    means2d, depths = means2d.squeeze(0), depths.squeeze(0)
    if means2d.requires_grad:
        means2d.retain_grad()

    features, channels = _features_and_channels(inputs, ids)
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    _, pairs, order = kernels.intersect(means2d[None], radii, depths[None], TILE, columns, rows)
    starts = kernels.offsets(pairs, 1, columns, rows)

    parts: list[Tensor] = []  # gsplat leaves the absolute gradients of each call on the centres that it was given

    def composite(values: Tensor, opacities: Tensor, behind: Tensor | None) -> tuple[Tensor, Tensor]:
        images, alphas = [], []
        for some, ground in _in_groups(values, behind, CHANNELS):
            parts.append(means2d[None])
            image, alpha = kernels.rasterize(
                parts[-1],
                conics,
                some[None],
                opacities[None],
                width,
                height,
                TILE,
                starts,
                order,
                backgrounds=None if ground is None else ground[None],
                absgrad=inputs.absgrad,
            )
            images.append(image.squeeze(0))
            alphas.append(alpha.squeeze(-1).squeeze(0))
        return images[0] if len(images) == 1 else torch.cat(images, dim=2), alphas[0]

    images, alphas, depth = [], [], None
    modalities = zip(inputs.opacities.unbind(), _in_groups(features, inputs.background, channels), strict=True)
    for m, (opacities, (values, behind)) in enumerate(modalities):
        if inputs.antialiased:
            opacities = opacities * compensations.squeeze(0)
        with_depth = inputs.depth and m == 0
        if with_depth:  # one more channel of the first modality, with nothing behind it
            values = torch.cat([values, depths[:, None]], dim=1)
            behind = None if behind is None else torch.cat([behind, behind.new_zeros(1)])
        image, alpha = composite(values, opacities, behind)
        if with_depth:
            image, depth = image.split([image.shape[2] - 1, 1], dim=2)
            depth = depth.squeeze(2)
        images.append(image)
        alphas.append(alpha)
    if inputs.absgrad and means2d.requires_grad:
        _gather_absgrad(means2d, parts)
    meta = {"means2d": means2d, "radii": radii[0], "visible_ids": ids}
    image = images[0] if len(images) == 1 else torch.cat(images, dim=2)
    return RenderOutput(image, torch.stack(alphas), depth, meta)


def _project(kernels: Kernels, inputs: RenderInputs) -> tuple[Tensor, ...]:
    """Radii, means2d, depths, conics and compensations of one camera, each with a leading axis of 1."""
    # gsplat would divide by the length of a zero quaternion; an opacity of 0 culls the Gaussian before that is used.
    hidden = inputs.quats.detach().square().sum(dim=1) == 0
    return kernels.project(
        inputs.means,
        None,
        inputs.quats,
        inputs.scales,
        inputs.viewmat[None],
        inputs.K[None],
        inputs.width,
        inputs.height,
        eps2d=inputs.eps2d,
        near_plane=inputs.near,
        far_plane=inputs.far,
        calc_compensations=inputs.antialiased,
        opacities=inputs.opacities.detach().amax(0).masked_fill(hidden, 0.0),
    )


def _features_and_channels(inputs: RenderInputs, ids: Tensor) -> tuple[Tensor, tuple[int, ...]]:
    """Features of all Gaussians [N, C], zero where a function gives them and they are not in ``ids``; channels per modality."""
    features, count = inputs.features, len(inputs.means)
    if not callable(features):
        return features, reference.channel_counts(inputs, features, count)
    emitted = features(ids)
    channels = reference.channel_counts(inputs, emitted, len(ids))
    return emitted.new_zeros(count, emitted.shape[1]).index_copy(0, ids, emitted), channels


def _in_groups(
    values: Tensor, background: Tensor | None, sizes: int | tuple[int, ...]
) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Groups of the channels of values [N, C], each with its background (see ``Tensor.split``)."""
    groups = values.split(sizes, dim=1)
    grounds = [None] * len(groups) if background is None else background.split(sizes)
    return zip(groups, grounds, strict=True)


def load() -> Kernels:
    """gsplat's kernels, which gsplat compiles on first use where it was not installed with them (some minutes, once).

    Raises:
        ImportError: gsplat, something that it needs, or the means to compile its kernels is missing.
    """
    remedy = "Install it with: pip install -e '.[gsplat]', or choose renderer=cpu"
    try:
        from gsplat import fully_fused_projection, isect_offset_encode, isect_tiles, rasterize_to_pixels
    except ImportError as error:
        raise ImportError(f"the CUDA renderer needs gsplat ({error}). {remedy}") from error
    try:
        compiled = import_module("gsplat.cuda._backend")._C
    except Exception as error:  # of compilers, of whichever kind
        raise ImportError(f"gsplat could not compile its kernels: {error}. {TOOLKIT}") from error
    if compiled is None:
        raise ImportError(f"gsplat has no compiled kernels, and finds no CUDA toolkit to compile them with. {TOOLKIT}")
    return Kernels(fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels)


@lru_cache(maxsize=1)
def why_not() -> str | None:
    """Why gsplat cannot render here, or None where it can."""
    try:
        load()
    except ImportError as error:
        return str(error)
    return None


def check(inputs: RenderInputs) -> None:
    """Refuses tensors that gsplat's kernels cannot read.

    Raises:
        ValueError: a tensor is not float32 on a CUDA device.
    """
    means = inputs.means
    if means.device.type != "cuda" or means.dtype != torch.float32:
        raise ValueError(
            f"the gsplat renderer needs float32 tensors on a CUDA device, got {means.dtype} on {means.device}; move "
            "the splats there or choose renderer=cpu (float32) or renderer=reference (any)"
        )


def _gather_absgrad(means2d: Tensor, parts: list[Tensor]) -> None:
    """Makes the backward pass leave the sum of the parts' ``absgrad`` [N, 2] on ``means2d``.

    The hook knows ``means2d`` weakly and ``means2d`` holds the parts: a hook that held them would be a reference cycle
    through the autograd graph, which the garbage collector cannot see, and would leak every training step.
    """
    means2d.parts = parts
    owner = weakref.ref(means2d)

    def gather(_grad: Tensor) -> None:
        if (centres := owner()) is None:
            return
        # A modality that the loss does not use has no backward pass and leaves nothing.
        found = [part.absgrad for part in centres.parts if hasattr(part, "absgrad")]
        centres.absgrad = torch.cat(found).sum(0) if found else torch.zeros_like(centres)

    means2d.register_hook(gather)
