"""Mip-Splatting's two filters at work: an image from farther away is the average of the one nearby; a pixel averages over its
area; bad eps2d is refused."""

import pytest
import torch

from heatsplat.composition import compose
from heatsplat.contracts import Camera
from heatsplat.geometry.smoothing import sampling_intervals, smoothed
from heatsplat.renderers import rasterization
from heatsplat.renderers.settings import Renderer


def sparks(count: int = 150) -> tuple[torch.Tensor, ...]:
    """Bright Gaussians of half a pixel of the near camera, well apart, in front of black."""
    generator = torch.Generator().manual_seed(5)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([3.0, 2.4, 0.5]) - torch.tensor([1.5, 1.2, 0.25])
    quats = torch.randn(count, 4, generator=generator)
    return means, quats, torch.full((count, 3), 0.0125), torch.full((1, count), 0.9)


def seen(camera: Camera, mip: bool) -> torch.Tensor:
    means, quats, scales, opacities = sparks()
    if mip:
        widths = 0.2**0.5 * sampling_intervals(means, [near()])
        scales, opacities = smoothed(scales, opacities, widths)
    renderer = Renderer("cpu", antialiased=True, eps2d=0.1) if mip else Renderer("cpu")
    return renderer(means, quats, scales, opacities, torch.ones(len(means), 1), camera, None, (1,)).features[..., 0]


def near() -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    return Camera(viewmat, torch.tensor([[160.0, 0, 64], [0, 160.0, 52], [0, 0, 1]]), 128, 104)


def test_a_coarser_image_is_the_average_of_the_fine_one():
    brighter, errors = {}, {}
    for mip in (False, True):
        fine = seen(near(), mip).view(26, 4, 32, 4).mean((1, 3))
        coarse = seen(near().resized(32, 26), mip)
        brighter[mip], errors[mip] = (coarse.mean() / fine.mean()).item(), (coarse - fine).abs().mean().item()
    assert brighter[False] > 5  # 0.3 pixels² of the coarse image are sixteen times as much space
    assert 0.95 < brighter[True] < 1.05
    assert errors[True] < 0.02 * errors[False]


def test_pixels_of_the_default_average_over_their_area():
    """Against the mean of 8 x 8 samples in each pixel, of surfaces a fifth to three pixels wide that cover one another."""
    generator = torch.Generator().manual_seed(7)
    means, quats, scales, opacities = sparks(600)
    scales = 0.005 * 15 ** torch.rand(scales.shape, generator=generator)
    values, camera = torch.rand(len(means), 1, generator=generator), near()

    def image(camera: Camera, **settings) -> torch.Tensor:
        renderer = Renderer("cpu", **settings)
        return renderer(means, quats, scales, opacities, values, camera, None, (1,)).features[..., 0]

    sampled = image(camera.resized(8 * camera.width, 8 * camera.height), antialiased=True, eps2d=1e-4)
    wanted = sampled.view(camera.height, 8, camera.width, 8).mean((1, 3))
    errors = {}
    for name, overrides in {"ours": [], "3dgs": ["recipe=published"], "mip": ["method=mip_splatting"]}.items():
        settings = compose(["method=3dgs", *overrides])["renderer"]
        found = image(camera, antialiased=settings["antialiased"], eps2d=settings["eps2d"])
        errors[name] = (found - wanted).square().mean().sqrt().item()
    assert errors["ours"] < 0.98 * errors["mip"] and errors["ours"] < 0.3 * errors["3dgs"], errors


def test_a_finer_image_does_not_lose_what_the_fine_one_shows():
    """Closer than the training cameras came, 3DGS's dilation shrinks in space and lines grow thin; the filter stays."""
    fine, finer = near(), near().resized(512, 416)
    kept = {mip: (seen(finer, mip).mean() / seen(fine, mip).mean()).item() for mip in (False, True)}
    assert kept[False] < 0.6 and 0.95 < kept[True] < 1.05


@pytest.mark.parametrize("eps2d", [0.0, -0.1, float("nan")])
def test_a_blur_that_is_none_is_refused(eps2d):
    with pytest.raises(ValueError, match=r"renderer.eps2d must be above 0 pixels² \(3DGS: 0.3, Mip-Splatting: 0.1\)"):
        Renderer(eps2d=eps2d)
    means, quats, scales, opacities = sparks(3)
    with pytest.raises(ValueError, match="eps2d must be above 0 pixels²"):
        rasterization(
            means,
            quats,
            scales,
            opacities,
            torch.ones(3, 1),
            torch.eye(4),
            torch.eye(3),
            8,
            8,
            backend="cpu",
            eps2d=eps2d,
        )
