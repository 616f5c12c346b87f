"""The photometric loss by Triton's kernels against plain torch in float64."""

import pytest
import torch
from triton_device import DEVICE

pytest.importorskip("triton", reason="compares Triton's kernels with plain torch")

from heatsplat.losses import photometric
from heatsplat.losses.photometric import _mean, l1, ssim_map

DOUBLE = torch.float64


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(20, 23, 1), (5, 4, 1), (9, 60, 3)])
@pytest.mark.parametrize("level, off", [(0.0, 0.0), (0.5, 0.0), (0.99, 0.0), (0.5, 40.0)])
def test_photometric_terms_and_gradient(size, level, off, masked):
    generator = torch.Generator().manual_seed(0)
    x = level + 0.01 * torch.rand(size, generator=generator, dtype=DOUBLE)
    y = (x + 0.005 * torch.randn(size, generator=generator, dtype=DOUBLE)).clamp(0, 1)
    x = (x + off).float().double()
    mask = torch.rand(size[:2], generator=generator) > 0.2 if masked else None
    found = {}
    for name, dtype, device in (("kernel", torch.float32, DEVICE), ("plain", DOUBLE, "cpu")):
        image, target = x.to(device, dtype).requires_grad_(), y.to(device, dtype)
        counts = None if mask is None else mask.to(device)
        if name == "kernel":
            terms = photometric._FusedOnCuda.apply(image, target, counts, 0.8, 0.2)
        else:
            shown = [one if mask is None else torch.where(mask[..., None], one, 0.0) for one in (image, target)]
            terms = 0.8 * _mean(l1(*shown), mask).mean(), 0.2 * _mean(1 - ssim_map(*shown, mask), mask).mean()
        (1.3 * terms[0] + 0.7 * terms[1]).backward()
        found[name] = [*(term.item() for term in terms), image.grad.cpu().double()]
    difference, dissimilarity, gradient = (
        (one - other) for one, other in zip(found["kernel"], found["plain"], strict=True)
    )
    assert abs(difference) < 1e-7 * (1 + off) and abs(dissimilarity) < 2e-6
    assert gradient.norm() < 1e-3 * found["plain"][2].norm()


def test_an_image_without_a_pixel_that_counts_costs_nothing():
    image = torch.rand(12, 9, 1, device=DEVICE).requires_grad_()
    terms = photometric._FusedOnCuda.apply(
        image, torch.rand(12, 9, 1, device=DEVICE), torch.zeros(12, 9, dtype=torch.bool, device=DEVICE), 0.8, 0.2
    )
    sum(terms).backward()
    assert [term.item() for term in terms] == [0.0, 0.0] and (image.grad == 0).all()
