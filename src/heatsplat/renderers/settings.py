"""A renderer as a run uses it: the rasterisation function with its settings fixed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput, SceneData, check_option, is_number
from heatsplat.renderers import cpu
from heatsplat.renderers.base import BACKENDS, EPS2D, RenderInputs, rasterization
from heatsplat.splats import ANCHORS, GAUSSIANS

NEAR, FAR = 0.01, 1e10  # visible range of camera z in world units, unless a run sets another


class Renderer:
    """``rasterization`` with the settings of a run.

    A run in float64 is rasterised in float32 all the same, and its images and gradients are float64 again: only the
    backend "reference" computes in float64.

    Args:
        backend: "auto", "cpu", "gsplat" or "reference".
        antialiased: compensates opacity for the screen blur (Mip-Splatting's 2D filter).
        eps2d: pixels² of full size added to both variances of a Gaussian on the screen.
        near, far: visible range of camera z in world units.
        background: what lies behind the splats: "ambient" (the ambient temperature where the scene has one, black where
            not), or an image value in [0, 1].

    Attributes:
        rows: what rows of the splats may be that it makes images of (``heatsplat.splats``).

    Raises:
        ValueError: an option is out of its range.
    """

    rows = frozenset({GAUSSIANS, ANCHORS})

    def __init__(
        self,
        backend: str = "auto",
        antialiased: bool = False,
        near: float = NEAR,
        far: float = FAR,
        background: str | float = "ambient",
        eps2d: float = EPS2D,
    ) -> None:
        check_option("renderer.backend", backend, ("auto", *BACKENDS))
        if background != "ambient" and not (is_number(background) and 0 <= background <= 1):
            raise ValueError(f"renderer.background must be 'ambient' or a number in [0, 1], got '{background}'")
        if not 0 < eps2d < math.inf:
            raise ValueError(
                f"renderer.eps2d must be above 0 pixels² (3DGS: 0.3, Mip-Splatting: 0.1) and finite, got {eps2d}"
            )
        if not 0 <= near < far:
            raise ValueError(f"renderer.near must be 0 or more, and renderer.far beyond it, got {near} and {far}")
        self.eps2d = eps2d
        self.backend, self.antialiased, self.near, self.far = backend, antialiased, near, far
        self.background = background

    def seeing_far(self) -> Renderer:
        """The same renderer with no end of sight, for cameras far outside of the scene."""
        other = copy(self)
        other.near, other.far = min(self.near, NEAR), FAR  # in a small world even those may stand nearer than NEAR
        return other

    def background_of(self, scene: SceneData, modality: str) -> float:
        """Image value behind the splats of a scene, in [0, 1]."""
        if self.background != "ambient":
            return float(self.background)
        if modality != "thermal" or scene.thermal_range is None or scene.ambient_c is None:
            return 0.0
        return min(1.0, max(0.0, scene.thermal_range.to_unit(scene.ambient_c)))

    def __call__(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features,
        camera: Camera,
        background: Tensor | None,
        modality_channels: tuple[int, ...],
        absgrad: bool = False,
        depth: bool = False,
        maps: int = 0,
        ratio: float = 1.0,
        signs: Tensor | None = None,
        raw: bool = False,
    ) -> RenderOutput:
        """What ``camera`` sees; arguments and result as ``heatsplat.renderers.rasterization``.

        Args:
            ratio: how many pixels of full size fit beside one of ``camera``. The screen blur is that of full size, so that
                Gaussians have the same size in the scene; a blur of coarse pixels would thicken them, and their training
                would make up for it. Where opacity is compensated, a coarse pixel also averages over the r² of full size
                in it, whose variance is (1 - 1 / r²) / 12 of its own size.
        """
        blur = self._blur(ratio)
        given = means.dtype
        dtype = given if self.backend == "reference" else torch.float32

        def narrowed(ids: Tensor) -> Tensor:
            return features(ids).to(dtype)

        seen = rasterization(
            means.to(dtype),
            quats.to(dtype),
            scales.to(dtype),
            opacities.to(dtype),
            narrowed if callable(features) else features.to(dtype),
            camera.viewmat.to(dtype),
            camera.K.to(dtype),
            camera.width,
            camera.height,
            near=self.near,
            far=self.far,
            background=None if background is None else background.to(dtype),
            antialiased=self.antialiased,
            modality_channels=modality_channels,
            backend=self.backend,
            absgrad=absgrad,
            depth=depth,
            eps2d=blur,
            maps=maps,
            signs=signs,
            raw=raw,
        )
        if given == dtype:
            return seen
        return replace(seen, features=seen.features.to(given), alpha=seen.alpha.to(given))

    def _blur(self, ratio: float) -> float:
        """Pixels² that are added to variances on the screen."""
        blur = self.eps2d / ratio**2
        return blur + (1 - 1 / ratio**2) / 12 if self.antialiased else blur

    def values_seen(
        self,
        shapes: tuple[Tensor, Tensor, Tensor, Tensor],
        values: Tensor,
        camera: Camera,
        depth: bool = False,
        ratio: float = 1.0,
    ) -> RenderOutput:
        """What ``camera`` sees of any values [N, C] of Gaussians, with black behind.

        Args:
            shapes: means [N, 3], rotations [N, 4], semi-axes [N, 3] and opacities [1, N] of one modality.
            depth, ratio: as for the renderer itself.
        """
        return self(*shapes, values, camera, None, (values.shape[1],), depth=depth, ratio=ratio)

    def depths_at_shares(
        self, shapes: tuple[Tensor, Tensor, Tensor, Tensor], camera: Camera, shares: Sequence[float], ratio: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Alpha [H, W] that ``camera`` sees, and camera z [H, W, S] of the Gaussians with which pixels reach these shares of it,
        front to back; pixels without opacity have any. On the CPU, whatever renders images, without gradients.

        Args:
            shapes, ratio: as for ``values_seen``.
            shares: [S] increasing, above 0 and below 1.
        """
        means, quats, scales, opacities = (tensor.detach().to("cpu", torch.float32) for tensor in shapes)
        inputs = RenderInputs(
            means, quats, scales, opacities, means[:, :0], camera.viewmat.to(means), camera.K.to(means), camera.width,
            camera.height, self.near, self.far, None, self.antialiased, (0,), absgrad=False, depth=True, eps2d=self._blur(ratio),
        )  # fmt: skip
        return cpu.depths_at_shares(inputs, shares)
