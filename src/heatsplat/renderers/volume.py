"""Images of a field: along the line of sight of every pixel, what the medium in front lets through (NeRF, 2020)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput
from heatsplat.geometry.sight_lines import rays
from heatsplat.geometry.volume import drawn, reached, weights
from heatsplat.renderers.settings import Renderer
from heatsplat.splats import NOTHING

NEAREST = 0.02  # of the span of a field, where rays begin
CHUNK = 1024  # rays at a time, where no gradient keeps what they went through: it stays in the cache


class VolumeRenderer(Renderer):
    """Two passes along each ray: even samples of the density alone, without a gradient, say where those of the second lie.

    The density is taken to be constant between two edges, and its value is that in the middle.

    Args:
        coarse: samples of the first pass.
        fine: samples of the second.
        background: what lies behind all, as for ``Renderer``.

    Raises:
        ValueError: there are fewer than two samples.
    """

    rows = frozenset({NOTHING})

    def __init__(self, coarse: int = 32, fine: int = 24, background: str | float = "ambient") -> None:
        super().__init__(background=background)
        if min(coarse, fine) < 2:
            raise ValueError(f"renderer.coarse and fine must be at least 2, got {coarse} and {fine}")
        self.coarse, self.fine = coarse, fine

    def of_field(
        self,
        density: Callable[[Tensor], tuple[Tensor, Tensor]],
        values: Callable[[Tensor, Tensor], Tensor],
        span: float,
        camera: Camera,
        background: Tensor,
        generator: torch.Generator | None = None,
    ) -> RenderOutput:
        """What ``camera`` sees, features [H, W, C], alpha [1, H, W] and depth [H, W]; ``meta`` is empty.

        Args:
            density: function of world points [n, 3] to σ [n] and what ``values`` wants to know of them.
            values: function of that and of directions [n, 3] to what is sent, [n, C].
            span: world units up to which samples of the first pass lie evenly.
            background: [C] behind all.
            generator: draws where between even shares the samples of each ray lie; None takes the middle.
        """
        sight = rays(camera).reshape(-1, 3)
        lengths = sight.norm(dim=1)
        away = (sight @ camera.viewmat[:3, :3] / lengths[:, None]).to(background)
        slant = (1 / lengths).to(background)  # camera z of a unit of distance
        offsets = torch.full((len(away), 2), 0.5)
        if generator is not None:
            offsets = torch.rand(offsets.shape, generator=generator)
        origin, offsets = camera.center.to(background), offsets.to(background)
        step = len(away) if torch.is_grad_enabled() else CHUNK
        parts = [
            self._gathered(
                density, values, span, origin, *(part[start : start + step] for part in (away, slant, offsets))
            )
            for start in range(0, len(away), step)
        ]
        image, alpha, depth = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
        size = camera.height, camera.width
        image = image + (1 - alpha)[:, None] * background
        return RenderOutput(image.view(*size, -1), alpha.view(1, *size), depth.view(size), {})

    def _gathered(self, density, values, span, origin, away, slant, offsets) -> tuple[Tensor, Tensor, Tensor]:
        """Values [R, C], alpha [R] and accumulated camera z [R] of rays, without what lies behind."""
        near = NEAREST * span
        with torch.no_grad():
            shares = (torch.arange(self.coarse + 1).to(away) / self.coarse).expand(len(away), -1)
            edges = reached(shares, near, span)
            middles = torch.lerp(edges[:, :-1], edges[:, 1:], offsets[:, :1])
            found, _ = density(_points(origin, away, middles))
            edges = drawn(edges, weights(found.view_as(middles), edges.diff(dim=1)), self.fine, offsets[:, 1:])
            middles = 0.5 * (edges[:, :-1] + edges[:, 1:])
        found, known = density(_points(origin, away, middles))
        shares = weights(found.view_as(middles), edges.diff(dim=1))
        sent = values(known, away[:, None].expand(-1, self.fine, -1).reshape(-1, 3)).view(*middles.shape, -1)
        image = (shares[..., None] * sent).sum(1)
        return image, shares.sum(1), (shares * middles).sum(1) * slant


def _points(origin: Tensor, away: Tensor, distances: Tensor) -> Tensor:
    return (origin + away[:, None] * distances[..., None]).reshape(-1, 3)
