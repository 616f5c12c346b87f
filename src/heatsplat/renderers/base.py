"""The renderer contract: one function, three backends, one test suite (tests/renderers)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from numbers import Integral

import torch
from torch import Tensor

from heatsplat.contracts import RenderOutput, WeightedSums

# Constants that all backends share, so that they can be compared pixel by pixel (values of gsplat 1.5).
EPS2D = 0.3  # pixels² added to the diagonal of the projected covariance, unless the caller gives others
ALPHA_MIN = 1.0 / 255.0  # a contribution below this is skipped
ALPHA_MAX = 0.999  # alpha is clamped here; its gradient is zero where it is
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance would fall to this
FOV_MARGIN = 0.3  # the Jacobian's x/z and y/z are clamped at the image border plus this times half the field of view

LAST_ROW = 1e-3  # of a view matrix, off 0, 0, 0, 1: more than rounding makes of it in float32

BACKENDS = ("reference", "cpu", "gsplat")


@dataclass(frozen=True)
class RenderInputs:
    """Checked arguments of ``rasterization`` in one shape: opacities [M, N], modality_channels a tuple of M counts."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor | Callable[[Tensor], Tensor]
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    near: float
    far: float
    background: Tensor | None
    antialiased: bool
    modality_channels: tuple[int, ...] | None
    absgrad: bool
    depth: bool
    eps2d: float = EPS2D
    maps: int = 0
    raw: bool = False


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor | Callable[[Tensor], Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near: float = 0.01,
    far: float = 1e10,
    background: Tensor | None = None,
    antialiased: bool = False,
    modality_channels: Sequence[int] | None = None,
    backend: str = "auto",
    absgrad: bool = False,
    depth: bool = True,
    eps2d: float = EPS2D,
    maps: int = 0,
    signs: Tensor | None = None,
    raw: bool = False,
) -> RenderOutput:
    """Composited features, alpha and depth of Gaussians seen by one camera; differentiable in the tensors of the Gaussians, the
    background and ``viewmats``, and in fx, fy, cx and cy of ``Ks`` but with "gsplat".

    **Convention:** OpenCV axes; ``viewmats`` maps world to camera; pixel centres at +0.5; quaternions wxyz, any length
    but zero; front to back in order of camera z, equal depths in order of index.

    Args:
        means: [N, 3] centres.
        quats: [N, 4] rotations wxyz; normalised inside; a zero quaternion hides its Gaussian.
        scales: [N, 3] semi-axes, not their logarithms.
        opacities: [N], or [M, N] for M modalities that share geometry, projection and depth order.
        features: [N, C], or a function from the visible ids [n] int64 to [n, C], called once after projection.
        viewmats: [4, 4] world to camera.
        Ks: [3, 3] intrinsics in pixels, without skew.
        width, height: image size in pixels.
        near, far: Gaussians whose camera z lies outside are not seen.
        background: [C] added behind what is left of the transmittance; None is black.
        antialiased: scales opacity by the square root of det(covariance) / det(blurred covariance) (Mip-Splatting, 2D).
        modality_channels: how many of the C channels each modality composites, M counts with sum C. Default: all in one
            (M = 1).
        backend: "reference" (float64-able oracle), "cpu", "gsplat" (CUDA), or "auto" by the device of ``means``.
        absgrad: also gather the sum of absolute values of the screen gradients in ``meta["means2d"].absgrad``.
        depth: composite the depth of the first modality as well.
        eps2d: pixels² added to both variances of the projected covariance (3DGS: 0.3; Mip-Splatting: 0.1, antialiased).
        maps: how many maps over pixels the backward pass sums by blending weights (``RenderOutput.weighted``).
        signs: [N] numbers, constant, that are composited like a feature of the first modality (``RenderOutput.signed``).
        raw: whether ``scales`` holds logarithms and ``opacities`` logits, as they are trained.

    Returns:
        RenderOutput with features [H, W, C], alpha [M, H, W], depth [H, W] or None, and meta.

    Raises:
        ValueError: shapes, types or devices do not fit together, eps2d is not positive and finite, near is negative or far not
            beyond it, a camera on the CPU is not finite, has no focal length or matrices of another form, Ks wants a gradient
            of "gsplat", or the backend is unknown.
        ImportError: the backend is gsplat and it is not installed (the message says how to get it).
    """
    _check_gaussians(means, quats, scales, opacities, features, background, signs)
    opacities = opacities[None] if opacities.ndim == 1 else opacities
    _check_modalities(modality_channels, len(opacities))
    _check_camera(viewmats, Ks, width, height, near, far, eps2d)
    backend = _backend_of(backend, means, Ks)
    if raw and backend != "cpu":
        scales, opacities, raw = scales.exp(), opacities.sigmoid(), False
    native = maps if backend == "cpu" else 0  # the others sum maps as gradients of channels that are zero
    probe = _Probe(features, means, maps - native, signs) if maps > native or signs is not None else None
    if probe is not None:
        features = probe
        background = None if background is None else torch.cat([background.new_zeros(probe.channels), background])
        first, *rest = modality_channels or (None,)
        modality_channels = first and (first + probe.channels, *rest)
    cameras = (matrix.to(means, non_blocking=means.is_cuda) for matrix in (viewmats, Ks))  # no step waits for them
    inputs = RenderInputs(
        means, quats, scales, opacities, features, *cameras, width, height, near, far,
        background, antialiased, tuple(modality_channels) if modality_channels is not None else None, absgrad, depth, eps2d,
        native, raw,
    )  # fmt: skip
    output = import_module(f"heatsplat.renderers.{backend}").render(inputs)
    return output if probe is None else probe.read(output)


def _check_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor | Callable[[Tensor], Tensor],
    background: Tensor | None,
    signs: Tensor | None,
) -> None:
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "features": features}
    given |= {name: value for name, value in (("background", background), ("signs", signs)) if value is not None}
    for name, value in given.items():
        if not (isinstance(value, Tensor) or (name == "features" and callable(value))):
            raise ValueError(f"{name} must be a tensor, got {_of_type(value)}: torch.as_tensor makes one")
    n = means.shape[0] if means.ndim else 0
    for name, tensor, shape in (("means", means, (n, 3)), ("quats", quats, (n, 4)), ("scales", scales, (n, 3))):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, got {list(tensor.shape)}")
    if opacities.ndim not in (1, 2) or opacities.shape[-1] != n:
        raise ValueError(f"opacities must have shape [{n}] or [M, {n}], got {list(opacities.shape)}")
    if means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"Gaussians must be float32 or float64, got means of {means.dtype}")
    alike = {name: value for name, value in given.items() if isinstance(value, Tensor) and name != "signs"}
    for name, tensor in alike.items():
        if tensor.dtype != means.dtype or tensor.device != means.device:
            raise ValueError(
                f"{name} must be like means, {means.dtype} on {means.device}, got {tensor.dtype} on {tensor.device}"
            )
    if isinstance(features, Tensor) and (features.ndim != 2 or features.shape[0] != n):
        raise ValueError(f"features must have shape [{n}, C], got {list(features.shape)}")
    if signs is not None and tuple(signs.shape) != (n,):
        raise ValueError(f"signs must have shape [{n}], got {list(signs.shape)}")


def _check_modalities(channels: Sequence[int] | None, modalities: int) -> None:
    if modalities > 1 and channels is None:
        raise ValueError(f"{modalities} opacity sets need modality_channels, such as (3, 1)")
    if channels is not None and len(channels) != modalities:
        raise ValueError(f"modality_channels {tuple(channels)} must name {modalities} counts")


def _check_camera(viewmats: Tensor, Ks: Tensor, width: int, height: int, near: float, far: float, eps2d: float) -> None:
    for name, matrix in (("viewmats", viewmats), ("Ks", Ks)):
        if not isinstance(matrix, Tensor):
            raise ValueError(f"{name} must be a tensor, got {_of_type(matrix)}: torch.as_tensor makes one")
    if tuple(viewmats.shape) != (4, 4) or tuple(Ks.shape) != (3, 3):
        batch = ": one camera per call, such as viewmats[0], Ks[0]" if viewmats.ndim == 3 or Ks.ndim == 3 else ""
        raise ValueError(
            f"viewmats and Ks must be [4, 4] and [3, 3], got {list(viewmats.shape)} and {list(Ks.shape)}{batch}"
        )
    # On a GPU a look at them would wait for the device.
    if Ks.device.type == "cpu":
        _check_intrinsics(Ks)
    if viewmats.device.type == "cpu":
        _check_pose(viewmats)
    if not 0 < eps2d < math.inf:
        raise ValueError(f"eps2d must be above 0 pixels² (3DGS: 0.3, Mip-Splatting: 0.1) and finite, got {eps2d}")
    if not 0 <= near < far:
        raise ValueError(f"near must be 0 or more, and far beyond it, got near {near} and far {far}")
    if not (isinstance(width, Integral) and isinstance(height, Integral)):
        raise ValueError(f"width and height must be whole numbers of pixels, got {width!r} and {height!r}")
    if width < 1 or height < 1:
        raise ValueError(f"image must have pixels, got {width} x {height}")


def _check_intrinsics(Ks: Tensor) -> None:
    (fx, skew, cx), (below, fy, cy), last = Ks.detach().tolist()
    if skew:
        raise ValueError(f"Ks has a skew of {skew:.6g} (its [0, 1]), which no renderer has: undistort images to 0")
    if not (fx > 0 and fy > 0):
        raise ValueError(f"Ks needs fx and fy above 0 pixels (its [0, 0] and [1, 1]), got {fx:.6g} and {fy:.6g}")
    if below or last != [0.0, 0.0, 1.0] or not all(map(math.isfinite, (fx, fy, cx, cy))):
        raise ValueError(f"Ks must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of finite numbers, got {Ks.tolist()}")


def _check_pose(viewmats: Tensor) -> None:
    if not bool(viewmats.detach().isfinite().all()):
        raise ValueError("viewmats has NaN or infinite values")
    last = viewmats[3].tolist()
    if max(abs(number - wanted) for number, wanted in zip(last, (0.0, 0.0, 0.0, 1.0), strict=True)) > LAST_ROW:
        raise ValueError(
            f"viewmats must map world to camera, with 0, 0, 0, 1 in its last row, got {last}: is it transposed, as 3DGS "
            "has its world_view_transform?"
        )


def _of_type(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")


def _backend_of(asked: str, means: Tensor, Ks: Tensor) -> str:
    if asked == "auto":
        asked = "gsplat" if means.device.type == "cuda" else "cpu" if means.dtype == torch.float32 else "reference"
    if asked not in BACKENDS:
        raise ValueError(f"unknown renderer backend '{asked}'; there are {', '.join(BACKENDS)} and auto")
    if asked == "gsplat" and Ks.requires_grad:
        raise ValueError(
            "gsplat gives no gradient to Ks: detach it, or take backend='cpu' or 'reference', which give those of fx, fy, cx, cy"
        )
    return asked


class _Probe:
    """Channels before those of the features: zeros whose gradients are sums over pixels of what weighs them, and signs."""

    def __init__(
        self, features: Tensor | Callable[[Tensor], Tensor], means: Tensor, maps: int, signs: Tensor | None
    ) -> None:
        self.features, self.maps, self.like = features, maps, means
        self.signs = None if signs is None else signs.to(means)[:, None]
        self.channels = maps + (signs is not None)
        self.rows: Tensor | None = None

    def __call__(self, ids: Tensor) -> Tensor:
        self.rows = self.like.new_zeros(len(ids), self.maps, requires_grad=True)
        seen = self.features(ids) if callable(self.features) else self.features.index_select(0, ids)
        own = [self.rows] if self.signs is None else [self.rows, self.signs[ids]]
        return torch.cat([*own, seen], dim=1)

    def read(self, output: RenderOutput) -> RenderOutput:
        image, features = output.features[..., : self.maps], output.features[..., self.channels :]
        return replace(
            output,
            features=features,
            weighted=WeightedSums(image, self.rows) if self.maps else output.weighted,
            signed=None if self.signs is None else output.features[..., self.maps],
        )
