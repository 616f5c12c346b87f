"""Depths at which pixels reach shares of their opacity, against images of the foremost Gaussians alone."""

from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import Camera
from heatsplat.kernels.scheduling import use_threads
from heatsplat.renderers.settings import Renderer

WIDTH, HEIGHT, COUNT = 45, 37, 40  # a tile and parts of others
SHARES = (0.05, 0.3, 0.5, 0.8, 0.975)
NEAR_TIE = 2e-5  # of the opacity: float32 and float64 may disagree on which side of a share it is


@pytest.fixture
def camera() -> Camera:
    K = torch.tensor([[40.0, 0, 22.5], [0, 40.0, 18.5], [0, 0, 1]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, WIDTH, HEIGHT)


def cloud(count: int = COUNT, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Some faint and some nearly opaque Gaussians before a camera, in order of depth."""
    draws = torch.Generator().manual_seed(seed)
    z = (2.0 + 6.0 * torch.rand(count, generator=draws)).sort().values
    means = torch.stack([*(0.9 * z * (torch.rand(2, count, generator=draws) - 0.5)), z], dim=1)
    scales = 0.1 * z[:, None] * (0.5 + torch.rand(count, 3, generator=draws))
    opacities = torch.rand(1, count, generator=draws) ** 2 * 0.99
    return means, torch.randn(count, 4, generator=draws), scales, opacities


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_they_are_those_of_the_first_gaussians_with_which_a_pixel_has_as_much(camera, antialiased, ratio):
    shapes = cloud()
    alpha, depths = Renderer(antialiased=antialiased).depths_at_shares(shapes, camera, SHARES, ratio)
    exact, exactly = Renderer(backend="reference", antialiased=antialiased), tuple(one.double() for one in shapes)

    def opacity(first: int) -> torch.Tensor:
        some = (*(one[:first] for one in exactly[:3]), exactly[3][:, :first])
        return exact.values_seen(some, some[0][:, :1], camera, ratio=ratio).alpha[0]

    before = torch.stack([torch.zeros(HEIGHT, WIDTH), *(opacity(first) for first in range(1, COUNT + 1))])
    torch.testing.assert_close(alpha.double(), before[-1], atol=1e-5, rtol=0)
    seen, compared = before[-1] > 0.01, 0
    for number, share in enumerate(SHARES):
        reached = before[1:] >= share * before[-1]
        expected = shapes[0][reached.int().argmax(0), 2]
        tied = ((before - share * before[-1]).abs() < NEAR_TIE * before[-1]).any(0)
        clear = seen & ~tied
        compared += int(clear.sum())
        assert torch.equal(depths[..., number][clear], expected[clear])
    assert compared > 0.8 * len(SHARES) * int(seen.sum()) and depths[seen].diff(dim=-1).min() >= 0
    assert (depths[seen].diff(dim=-1) > 0).float().mean() > 0.1  # not all from one Gaussian


def test_bits_are_those_of_any_number_of_threads(camera):
    wide = replace(camera, width=200, height=150)
    found = []
    for threads in (1, 3):
        use_threads(threads)
        found.append(Renderer().depths_at_shares(cloud(500), wide, SHARES))
    use_threads(1)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_nothing_and_what_no_gaussian_covers_have_no_opacity(camera):
    means, quats, scales, opacities = cloud()
    alpha, depths = Renderer().depths_at_shares((means, quats, scales, 0 * opacities), camera, SHARES)
    assert not alpha.any() and depths.shape == (HEIGHT, WIDTH, len(SHARES))
    alpha, _ = Renderer().depths_at_shares((means[:0], quats[:0], scales[:0], opacities[:, :0]), camera, SHARES)
    assert not alpha.any()


def test_gaussians_in_float64_are_seen_too(camera):
    shapes = cloud()
    doubles = tuple(one.double().requires_grad_() for one in shapes)
    for one, other in zip(
        Renderer().depths_at_shares(shapes, camera, SHARES), Renderer().depths_at_shares(doubles, camera, SHARES),
        strict=True,
    ):  # fmt: skip
        assert torch.equal(one, other)
