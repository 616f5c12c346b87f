"""Needles, pancakes, quaternions and stacks of layers (geometry and the renderers)."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from benchmarks.stability.case import Case, log_uniform, uniform
from heatsplat.geometry.projection import project_gaussians
from heatsplat.geometry.rotations import matrices_to_quats, quats_to_matrices, slerp
from heatsplat.renderers import rasterization
from heatsplat.renderers.base import EPS2D, FOV_MARGIN

COUNT = 150
FOCAL, SIDE = 500.0, 400  # of the camera of needles
LAYERS = 2000


def _flat(second: float) -> dict[str, Tensor]:
    """Gaussians with axes s, s · second and s · ratio before a camera."""
    draw = {f"q{i}": uniform(f"quat {i}", -1.0, 1.0, COUNT) for i in range(4)}
    return draw | {
        "growth": torch.ones(COUNT, dtype=torch.float64),
        "x": uniform("slope x", -0.4, 0.4, COUNT),
        "y": uniform("slope y", -0.4, 0.4, COUNT),
        "z": log_uniform("depth", 0.5, 50.0, COUNT),
        "s": log_uniform("axis", 0.05, 20.0, COUNT),
        "ratio": log_uniform("ratio", 1e-6, 1.0, COUNT),
        "second": torch.full((COUNT,), second, dtype=torch.float64),
    }


def _rows(q0, q1, q2, q3, growth, x, y, z, s, ratio, second) -> tuple[Tensor, Tensor, Tensor]:
    middle = torch.where(second == 0, ratio, second)
    means, quats = torch.stack([x * z, y * z, z], 1), torch.stack([q0, q1, q2, q3], 1)
    return means, quats, torch.stack([s, s * middle, s * ratio], 1) * growth[:, None]


def _camera(like: Tensor) -> Tensor:
    return torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]).to(like)


def _screen_ours(output: str, **inputs: Tensor) -> Tensor:
    rows = _rows(**inputs)
    screen = project_gaussians(*rows, torch.eye(4).to(rows[0]), _camera(rows[0]), SIDE, SIDE, EPS2D, FOV_MARGIN)
    return screen.whitening[:, 0] if output == "whitening" else screen.compensation


def _screen_printed(output: str, **inputs: Tensor) -> Tensor:
    """3DGS: J W Σ Wᵀ Jᵀ multiplied out, its determinant as xx yy - xy²."""
    means, quats, scales = _rows(**inputs)
    axes = quats_to_matrices(quats) * scales[:, None]
    x, y, z = means.unbind(1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([FOCAL / z, zero, -FOCAL * x / z**2, zero, FOCAL / z, -FOCAL * y / z**2], 1).view(-1, 2, 3)
    screen = jacobian @ (axes @ axes.mT) @ jacobian.mT
    plain = screen[:, 0, 0] * screen[:, 1, 1] - screen[:, 0, 1] ** 2
    xx, yy, xy = screen[:, 0, 0] + EPS2D, screen[:, 1, 1] + EPS2D, screen[:, 0, 1]
    blurred = xx * yy - xy * xy
    return (yy / blurred).sqrt() if output == "whitening" else (plain / blurred).sqrt()


def _screen_exact(output, q0, q1, q2, q3, growth, x, y, z, s, ratio, second):
    import mpmath

    norm = mpmath.sqrt(q0**2 + q1**2 + q2**2 + q3**2)
    a, b, c, d = q0 / norm, q1 / norm, q2 / norm, q3 / norm
    rotation = (
        (1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)),
        (2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)),
        (2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)),
    )
    axes = [growth * s * share for share in (1, ratio if second == 0 else second, ratio)]
    u = [FOCAL / z * (rotation[0][i] - x * rotation[2][i]) * axes[i] for i in range(3)]
    w = [FOCAL / z * (rotation[1][i] - y * rotation[2][i]) * axes[i] for i in range(3)]
    xx, yy, xy = sum(v * v for v in u), sum(v * v for v in w), sum(v * t for v, t in zip(u, w, strict=True))
    plain, blur = xx * yy - xy * xy, mpmath.mpf(EPS2D)
    blurred = plain + blur * (xx + yy) + blur * blur
    return (mpmath.sqrt((yy + blur) / blurred) if output == "whitening" else mpmath.sqrt(plain / blurred),)


def _quaternion() -> dict[str, Tensor]:
    length = log_uniform("length", 1e-30, 1e30, COUNT)
    return {f"q{i}": (length * uniform(f"part {i}", 0.1, 1.0, COUNT)).float().double() for i in range(4)}


def _entry(quats: Tensor) -> Tensor:
    return quats_to_matrices(quats)[:, 0, 1]


def _entry_printed(q0, q1, q2, q3) -> Tensor:
    a, b, c, d = (torch.stack([q0, q1, q2, q3], 1) / (q0**2 + q1**2 + q2**2 + q3**2).sqrt()[:, None]).unbind(1)
    return 2 * (b * c - a * d)


def _entry_exact(q0, q1, q2, q3):
    return (2 * (q1 * q2 - q0 * q3) / (q0**2 + q1**2 + q2**2 + q3**2),)


def _turn(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions of no turn and of a turn by 2 · angle about x."""
    zero = torch.zeros_like(angle)
    return torch.stack([zero + 1, zero, zero, zero], 1), torch.stack(
        [torch.cos(angle), torch.sin(angle), zero, zero], 1
    )


def _slerp_ours(angle: Tensor) -> Tensor:
    return slerp(*_turn(angle), 0.25)[:, 1]


def _slerp_printed(angle: Tensor) -> Tensor:
    start, end = _turn(angle)
    found = torch.acos((start * end).sum(1))
    return torch.sin(0.25 * found) / torch.sin(found) * end[:, 1]


def _slerp_exact(angle):
    import mpmath

    return (mpmath.sin(angle / 4),)


def _half_turn_matrices(gap: Tensor) -> Tensor:
    """Rotations about z by a half turn less 2 · gap."""
    cosine, sine, zero = -torch.cos(2 * gap), torch.sin(2 * gap), torch.zeros_like(gap)
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1)
    return torch.stack(rows, 1).view(-1, 3, 3)


def _half_turn_printed(gap: Tensor) -> Tensor:
    matrices = _half_turn_matrices(gap)
    w = (1 + matrices.diagonal(dim1=1, dim2=2).sum(1)).sqrt() / 2
    return (matrices[:, 1, 0] - matrices[:, 0, 1]) / (4 * w)


def _half_turn_exact(gap):
    import mpmath

    return (mpmath.cos(gap),)


def _stack(alpha: Tensor, backend: str) -> tuple[Tensor, Tensor]:
    """Brightness of one pixel behind 2000 layers, and its gradient by the opacity of the last."""
    values, slopes = [], []
    for a in alpha:
        opacities = a.detach().repeat(LAYERS).requires_grad_()
        like = {"dtype": alpha.dtype}
        means = torch.tensor([0.0, 0.0, 1.0], **like).repeat(LAYERS, 1)
        features = torch.cat([torch.zeros(LAYERS - 1, 1, **like), torch.ones(1, 1, **like)])
        camera = torch.tensor([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]], **like)
        image = rasterization(
            means, torch.tensor([1.0, 0, 0, 0], **like).repeat(LAYERS, 1), torch.full((LAYERS, 3), 1e4, **like),
            opacities, features, torch.eye(4, **like), camera, 1, 1, backend=backend,
        ).features  # fmt: skip
        image.sum().backward()
        values.append(image.detach().sum())
        slopes.append(opacities.grad[0])
    return torch.stack(values), torch.stack(slopes)


def _stack_printed(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """The backward pass of 3DGS: transmittances recovered from the last one by division."""
    left = torch.ones_like(alpha)
    for _ in range(LAYERS):
        left = left * (1 - alpha)
    image = alpha * left / (1 - alpha)
    before, behind, last = left.clone(), torch.zeros_like(alpha), torch.ones_like(alpha)
    for layer in range(LAYERS):
        before = before / (1 - alpha)
        colour = 1.0 if layer == 0 else 0.0
        slope = before * (colour - behind)
        behind = alpha * colour + (1 - alpha) * behind
        last = slope
    return image, last


def _stack_exact(alpha):
    left = (1 - alpha) ** (LAYERS - 1)
    return alpha * left, -alpha * left / (1 - alpha)


def _largest(exact):
    return abs(exact[0]) + abs(exact[1])


def _screen(name: str, second: float, output: str) -> Case:
    shape = {0.0: "needles (two axes s · ratio)", 0.9: "pancakes (s, 0.9 s, s · ratio)"}[second]
    return Case(
        f"{name} of {shape}",
        "s 0.05 .. 20, ratio 1e-6 .. 1, depth 0.5 .. 50, any rotation, focal length 500 pixels; slope by log s",
        "xx yy - xy² of J W Σ Wᵀ Jᵀ (3DGS)",
        "value",
        partial(_flat, second),
        partial(_screen_printed, output),
        partial(_screen_ours, output),
        partial(_screen_exact, output),
        by="growth",
        slope_scale=lambda exact, slopes: abs(exact[0]),
        promise=600.0,
    )


CASES = (
    _screen("Inverse width on the screen", 0.0, "whitening"),
    _screen("Inverse width on the screen", 0.9, "whitening"),
    _screen("Antialiasing factor", 0.0, "compensation"),
    _screen("Antialiasing factor", 0.9, "compensation"),
    Case(
        "Rotations of quaternions of any length",
        "length 1e-30 .. 1e30",
        "q/√(q·q)",
        "1",
        _quaternion, _entry_printed, lambda q0, q1, q2, q3: _entry(torch.stack([q0, q1, q2, q3], 1)), _entry_exact,
        scale=lambda exact: 1, promise=4.0,
    ),
    Case(
        "Interpolation between two nearly equal rotations",
        "half angle 1e-8 .. 1",
        "sin(θ/4)/sin θ with θ = acos(p·q)",
        "itself",
        lambda: {"angle": log_uniform("angle", 1e-8, 1.0, COUNT)},
        _slerp_printed, _slerp_ours, _slerp_exact, promise=8.0,
    ),
    Case(
        "Quaternions of rotations by almost half a turn",
        "half a turn less 1e-8 .. 1",
        "w = √(1 + trace)/2",
        "itself",
        lambda: {"gap": log_uniform("gap", 1e-8, 0.7, COUNT)},
        _half_turn_printed, lambda gap: matrices_to_quats(_half_turn_matrices(gap))[:, 3].abs(), _half_turn_exact,
        promise=4.0,
    ),
    Case(
        "The last of 2000 layers, and its gradient by the first (CPU renderer)",
        "opacity 0.004 .. 0.0045",
        "transmittance recovered by division (3DGS)",
        "both",
        lambda: {"alpha": uniform("alpha", 0.00395, 0.0045, 6)},
        _stack_printed, partial(_stack, backend="cpu"), _stack_exact, scale=_largest, promise=40.0, types=("float32",),
    ),
)  # fmt: skip
