"""Sums of spherical harmonics of the direction of view, for the Gaussians in view: fused on a CPU, else plain torch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable
from heatsplat.geometry import spherical_harmonics
from heatsplat.kernels import spherical_harmonics as kernel
from heatsplat.thermal.base import Query

# Operations that a Gaussian's harmonics of each degree take before the sum: normalising the direction, and the polynomials in it.
BASIS_COST = {0: 0, 1: 12, 2: 27, 3: 48}


def active_degree(step: int, degree: int, interval: int) -> int:
    """Degree of the harmonics that are trained at a step: one more every ``interval`` steps, up to ``degree``; 0 trains all."""
    return min(degree, step // interval) if interval > 0 else degree


def spherical_harmonics_of(constant: Tensor, rest: Tensor | None, means: Tensor, query: Query, degree: int) -> Tensor:
    """Sums of harmonics of the direction from the camera to the Gaussians in ``query.ids``, [n, C].

    Args:
        constant: [N, 1, C] coefficients of the constant harmonic.
        rest: [N, B - 1, C] those of the further ones, at least (degree + 1)² - 1 of them; not read at degree 0.
        means: [N, 3] positions; differentiable, and not read at degree 0.
        query: which Gaussians (ids do not repeat), and the camera, whose view matrix may have a gradient.
        degree: 0 to 3.

    Raises:
        ValueError: the degree is above 0 and there is no camera.
    """
    if degree == 0:
        return spherical_harmonics.C0 * query.rows(constant)[:, 0]
    if query.camera is None:
        raise ValueError(f"an emission of degree {degree} depends on the view: give a camera")
    center = query.camera.center.to(means)
    if center.device.type == "cpu" and center.dtype == torch.float32:
        return _Fused.apply(constant, rest, means, center, query.ids, degree)
    coefficients = torch.cat((query.rows(constant), query.rows(rest)), 1)
    return spherical_harmonics.evaluate(coefficients, query.rows(means) - center, degree)


class _Fused(torch.autograd.Function):
    """The kernel with its gradients; ids are unique, as a renderer's visible ids are."""

    @staticmethod
    def forward(ctx, constant, rest, means, center, ids, degree):
        ids = torch.arange(len(means)) if ids is None else ids
        values = constant.new_empty(len(ids), constant.shape[2])
        arrays = [tensor.detach().contiguous().numpy() for tensor in (constant, rest, means, center, ids)]
        kernel.forward(*arrays, degree, values.numpy())
        ctx.inputs = *arrays[1:], degree
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx, v_values):
        rest, means, _, ids, _ = ctx.inputs
        allocate = torch.empty if len(ids) == len(means) else torch.zeros  # rows out of view get no gradient
        v_constant = allocate(len(means), 1, v_values.shape[1])
        gradients = v_constant, allocate(rest.shape), allocate(means.shape)
        kernel.backward(*ctx.inputs, v_values.contiguous().numpy(), *(tensor.numpy() for tensor in gradients))
        v_center = None
        if ctx.needs_input_grad[3]:
            # Directions go from the center to the means. numpy adds in one order on any number of threads.
            v_center = -torch.from_numpy(gradients[2].numpy().sum(axis=0, dtype=np.float64)).to(v_values)
        return *gradients, v_center, None, None
