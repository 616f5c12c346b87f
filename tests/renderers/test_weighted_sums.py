"""Sums of maps over pixels, weighted by blending weights: the same as pixel by pixel, and free of side effects."""

from __future__ import annotations

import pytest
import torch

from heatsplat.renderers.base import rasterization

WIDTH, HEIGHT, COUNT = 40, 32, 60
CHANNELS = 4  # with no map or three, which runs have compiled as well; without absolute gradients they have one


def scene(dtype: torch.dtype):
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(COUNT, 3, generator=generator) * torch.tensor([2.0, 1.6, 1.0]) + torch.tensor([-1.0, -0.8, 2.0])
    means[0, 2] = -1.0  # behind the camera: rows are those of the visible
    quats = torch.randn(COUNT, 4, generator=generator)
    scales = 0.02 + 0.15 * torch.rand(COUNT, 3, generator=generator)
    opacities = 0.1 + 0.85 * torch.rand(COUNT, generator=generator)
    values = torch.rand(COUNT, CHANNELS, generator=generator)
    K = torch.tensor([[35.0, 0.0, 20.0], [0.0, 35.0, 16.0], [0.0, 0.0, 1.0]])
    tensors = [tensor.to(dtype) for tensor in (means, quats, scales, opacities, values)]
    return tensors, torch.eye(4, dtype=dtype), K.to(dtype)


def drawn(
    backend: str,
    maps: int,
    as_function: bool = True,
    background: torch.Tensor | None = None,
    channels: int = CHANNELS,
):
    dtype = torch.float64 if backend == "reference" else torch.float32
    (means, quats, scales, opacities, values), viewmat, K = scene(dtype)
    leaves = [tensor.clone().requires_grad_() for tensor in (means, quats, scales, opacities, values[:, :channels])]
    emitted = (lambda ids: leaves[4].index_select(0, ids)) if as_function else leaves[4]
    output = rasterization(
        *leaves[:4], emitted, viewmat, K, WIDTH, HEIGHT,
        backend=backend, depth=False, maps=maps, absgrad=maps > 0, background=background,
    )  # fmt: skip
    return output, leaves


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("as_function", [True, False])
def test_sums_are_those_of_brute_force(backend: str, as_function: bool):
    maps = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    output, _ = drawn(backend, 3, as_function, channels=1)
    (output.weighted.image * maps).sum().backward()
    # Weights one Gaussian at a time: the image of a cloud in which it alone emits 1.
    (means, quats, scales, opacities, _), viewmat, K = scene(torch.float64)
    alone = torch.eye(COUNT, dtype=torch.float64)
    weights = rasterization(
        means, quats, scales, opacities, alone, viewmat, K, WIDTH, HEIGHT, backend="reference", depth=False
    ).features
    expected = torch.einsum("hwn,hws->ns", weights, maps.double())[output.meta["visible_ids"]]
    assert output.weighted.sums.shape == expected.shape and expected.max() > 10
    tolerance = 1e-10 if backend == "reference" else 1e-5
    torch.testing.assert_close(output.weighted.sums.double(), expected, rtol=tolerance, atol=tolerance)


def test_weights_and_what_is_left_add_up_to_one():
    output, _ = drawn("reference", 1)
    (output.weighted.image * torch.ones(HEIGHT, WIDTH, 1)).sum().backward()
    torch.testing.assert_close(output.weighted.sums.sum(), output.alpha[0].sum(), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_maps_change_neither_image_nor_gradients(backend: str):
    dtype = torch.float64 if backend == "reference" else torch.float32
    background = torch.linspace(0.3, 0.6, CHANNELS, dtype=dtype)
    plain, leaves = drawn(backend, 0, background=background)
    probed, others = drawn(backend, 3, background=background)
    assert plain.weighted is None
    assert torch.equal(plain.features, probed.features)
    plain.features.square().sum().backward()
    (probed.features.square().sum() + (probed.weighted.image * 7.0).sum()).backward()
    for mine, theirs in zip(leaves, others, strict=True):
        torch.testing.assert_close(mine.grad, theirs.grad, rtol=2e-5, atol=1e-6)
    torch.testing.assert_close(plain.meta["means2d"].grad, probed.meta["means2d"].grad, rtol=2e-5, atol=1e-6)
