"""The Sobel operator, against SciPy's and in its unit."""

import numpy as np
import torch
from scipy import ndimage

from heatsplat.losses.sobel import GAIN, sobel, sobel_magnitude


def test_the_operator_is_that_of_scipy():
    image = torch.rand(12, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x, y = sobel(image)
    for channel in range(2):
        plane = image[..., channel].numpy()
        assert np.allclose(x[..., channel].numpy(), ndimage.sobel(plane, axis=1, mode="nearest"))
        assert np.allclose(y[..., channel].numpy(), ndimage.sobel(plane, axis=0, mode="nearest"))


def test_a_slope_of_one_per_pixel_is_the_gain():
    v, u = torch.meshgrid(torch.arange(8.0), torch.arange(9.0), indexing="ij")
    slope = (0.6 * u + 0.8 * v)[..., None]
    assert torch.allclose(sobel_magnitude(slope)[1:-1, 1:-1], torch.tensor(GAIN), rtol=1e-5)
