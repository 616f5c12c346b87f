"""The oracle among the renderers: plain torch, any float type, every pixel against every Gaussian in view.

It is written to be read and believed, not to be fast: no tiles, no bounds within the image, and the gradient is that of
autograd. The other backends are tested against it in float64.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from heatsplat.contracts import RenderOutput
from heatsplat.geometry.projection import ScreenGaussians, project_gaussians, to_camera
from heatsplat.renderers.base import ALPHA_MAX, ALPHA_MIN, FOV_MARGIN, TRANSMITTANCE_MIN, RenderInputs

PAIRS = 2**20  # pixels times Gaussians held at once: 8 MiB per float64 tensor and about a dozen tensors


def render(inputs: RenderInputs) -> RenderOutput:
    """Composited features, alpha and depth; ``heatsplat.renderers.rasterization`` has the contract.

    **Convention:** absolute screen gradients are summed over pixels and modalities, as all backends do.
    """
    ids, radii = _visible(inputs)
    screen = _project(inputs, ids)
    means2d = inputs.means.new_zeros(len(inputs.means), 2).index_copy(0, ids, screen.means)
    if means2d.requires_grad:
        means2d.retain_grad()
        if inputs.absgrad:
            means2d.absgrad = torch.zeros_like(means2d)

    features = inputs.features(ids) if callable(inputs.features) else inputs.features.index_select(0, ids)
    channels = channel_counts(inputs, features, len(ids))
    background = features.new_zeros(features.shape[1]) if inputs.background is None else inputs.background
    opacities = inputs.opacities.index_select(1, ids)
    if inputs.antialiased:
        opacities = opacities * screen.compensation

    order = screen.depths.detach().argsort(stable=True)
    depths, whitening = screen.depths[order, None], screen.whitening[order]
    images, alphas, depth = [], [], None
    for m, (emitted, behind) in enumerate(
        zip(features[order].split(channels, 1), background.split(channels), strict=True)
    ):
        # Depth is composited like one more channel of the first modality, with nothing behind it.
        with_depth = inputs.depth and m == 0
        values = torch.cat([emitted, depths], dim=1) if with_depth else emitted
        image, left = _composite(inputs, means2d, ids[order], whitening, opacities[m, order], values)
        if with_depth:
            image, depth = image[..., :-1], image[..., -1]
        images.append(image + left[..., None] * behind)
        alphas.append(1 - left)
    meta = {"means2d": means2d, "radii": radii, "visible_ids": ids}
    return RenderOutput(torch.cat(images, dim=2), torch.stack(alphas), depth, meta)


def channel_counts(inputs: RenderInputs, features: Tensor, count: int) -> tuple[int, ...]:
    """How many channels each modality composites, once the features of ``count`` Gaussians are known.

    Raises:
        ValueError: features, modality_channels and background do not fit together.
    """
    if features.ndim != 2 or features.shape[0] != count:
        raise ValueError(f"features must give [{count}, C] for {count} ids, got {list(features.shape)}")
    channels = inputs.modality_channels or (features.shape[1],)
    if sum(channels) != features.shape[1]:
        raise ValueError(
            f"modality_channels {channels} must add up to the {features.shape[1]} channels of the features"
        )
    if inputs.background is not None and tuple(inputs.background.shape) != (features.shape[1],):
        raise ValueError(f"background must have shape [{features.shape[1]}], got {list(inputs.background.shape)}")
    return channels


def _project(inputs: RenderInputs, ids: Tensor) -> ScreenGaussians:
    means, quats, scales = (rows.index_select(0, ids) for rows in (inputs.means, inputs.quats, inputs.scales))
    return project_gaussians(
        means, quats, scales, inputs.viewmat, inputs.K, inputs.width, inputs.height, inputs.eps2d, FOV_MARGIN
    )


@torch.no_grad()
def _visible(inputs: RenderInputs) -> tuple[Tensor, Tensor]:
    """Ascending ids [n] of the Gaussians that can reach a pixel with alpha >= ALPHA_MIN, and extents [N, 2] in pixels.

    Every test is true for what is kept, so that a Gaussian with a NaN or an overflow anywhere is not seen.
    """
    z = to_camera(inputs.means, inputs.viewmat)[:, 2]
    ids = ((z >= inputs.near) & (z <= inputs.far) & inputs.quats.any(dim=1)).nonzero().squeeze(1)
    screen = _project(inputs, ids)
    opacities = inputs.opacities.index_select(1, ids).amax(0)
    if inputs.antialiased:
        opacities = opacities * screen.compensation
    # alpha falls to ALPHA_MIN where the Mahalanobis distance is sqrt(2 ln(opacity / ALPHA_MIN)).
    reach = (2 * (opacities / ALPHA_MIN).log()).sqrt()
    extent = (reach[:, None] * screen.variances.sqrt()).ceil().clamp(min=1)
    size = torch.tensor([inputs.width, inputs.height], dtype=extent.dtype, device=extent.device)
    touches = (screen.means + extent > 0) & (screen.means - extent < size) & extent.isfinite()
    seen = (opacities >= ALPHA_MIN) & touches.all(dim=1)
    ids, extent = ids[seen], extent[seen]
    radii = torch.zeros(len(inputs.means), 2, dtype=torch.int32, device=ids.device)
    return ids, radii.index_copy(0, ids, extent.clamp(max=2**30).to(torch.int32))


def _composite(
    inputs: RenderInputs, means2d: Tensor, ids: Tensor, whitening: Tensor, opacities: Tensor, values: Tensor
) -> tuple[Tensor, Tensor]:
    """Composited values [H, W, V] of one modality and the transmittance left [H, W]; rows are sorted front to back."""
    absgrad = getattr(means2d, "absgrad", None)

    def add_absolute(grad: Tensor) -> None:
        absgrad.index_add_(0, ids, grad.abs().sum(0))

    def block(pixels: Tensor, means2d: Tensor, whitening: Tensor, opacities: Tensor, values: Tensor):
        # One copy of every centre per pixel, so that the gradient of each pixel can be looked at before it is summed.
        centres = means2d.index_select(0, ids).expand(len(pixels), -1, 2)
        if absgrad is not None and centres.requires_grad:
            centres.register_hook(add_absolute)
        dx, dy = (pixels[:, None] - centres).unbind(-1)
        p, q, r = whitening.unbind(-1)
        sigma = 0.5 * ((p * (dx - q * dy)).square() + (r * dy).square())
        alpha = (opacities * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
        reached = torch.cumprod(1 - alpha.detach(), dim=1) > TRANSMITTANCE_MIN
        alpha = torch.where(reached, alpha, 0.0)
        after = torch.cumprod(1 - alpha, dim=1)
        before = torch.cat([after.new_ones(len(pixels), 1), after], dim=1)
        return (alpha * before[:, :-1]) @ values, before[:, -1]

    ys, xs = torch.meshgrid(
        torch.arange(inputs.height, dtype=values.dtype, device=values.device) + 0.5,
        torch.arange(inputs.width, dtype=values.dtype, device=values.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([xs, ys], dim=-1).view(-1, 2)
    # The blocks are computed again in the backward pass: memory stays bounded whatever the size of the image.
    blocks = [
        checkpoint(block, rows, means2d, whitening, opacities, values, use_reentrant=False, preserve_rng_state=False)
        for rows in pixels.split(max(1, PAIRS // max(1, len(ids))))
    ]
    composited, left = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return composited.view(inputs.height, inputs.width, -1), left.view(inputs.height, inputs.width)
