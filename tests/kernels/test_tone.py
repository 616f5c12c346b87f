"""Brightness corrected by a curve: the kernel beside its plain-torch twin in double precision."""

import pytest
import torch

from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.sensors.tone import corrected, corrected_reference


@pytest.mark.parametrize(("height", "width", "channels"), [(5, 7, 1), (96, 130, 1), (40, 33, 3)])
def test_the_kernel_is_its_twin(height, width, channels):
    """On images of several blocks of pixels, with values beyond the ends of the curve, on them and on its levels."""
    generator = torch.Generator().manual_seed(height)
    image = 1.6 * torch.rand(height, width, channels, generator=generator) - 0.3
    image[0], image[1], image[2] = 0.0, 1.0, 7 / 255
    curve = 0.1 * torch.randn(256, 2, generator=generator)
    weights = torch.randn(image.shape, generator=generator)
    found = []
    for function, kind in ((corrected, torch.float32), (corrected_reference, torch.float64)):
        inputs = [tensor.detach().clone().to(kind).requires_grad_() for tensor in (image, curve)]
        result = function(*inputs)
        (result * weights).sum().backward()
        found.append((result, inputs[0].grad, inputs[1].grad))
    (result, v_image, v_curve), (expected, wanted, wanted_curve) = found
    assert (
        result - expected
    ).abs().max() < 5e-5  # the curve rises by up to a hundred, and brightness is rounded to 1e-7
    smooth = torch.ones(height, dtype=torch.bool)
    smooth[:3] = False  # where the curve bends, the slope may be that of either side
    assert (v_image - wanted)[smooth].norm() < 2e-3 * wanted[smooth].norm()  # a pixel may round to the next level
    assert (v_image - wanted)[smooth].abs().median() < 1e-5
    assert (v_curve - wanted_curve).norm() < 1e-4 * wanted_curve.norm()


def test_a_pixel_that_is_no_number_stays_one_and_changes_no_other():
    image = torch.full((4, 5, 1), 0.5)
    image[1, 2] = torch.nan
    found = corrected(image, torch.full((256, 2), 0.25))
    assert found.isnan().sum() == 1
    assert found[~found.isnan()].eq(0.875).all()


def test_the_number_of_threads_changes_no_bit():
    image = torch.rand(200, 210, 1, generator=torch.Generator().manual_seed(0))
    before, found = thread_count(), []
    try:
        for threads in (1, 2):
            use_threads(threads)
            inputs = image.clone().requires_grad_(), torch.linspace(0, 0.1, 512).view(256, 2).requires_grad_()
            result = corrected(*inputs)
            result.square().sum().backward()
            found.append((result, *(tensor.grad for tensor in inputs)))
    finally:
        use_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
