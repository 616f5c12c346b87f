"""The spectrum of a picture that is one wave."""

import math

import numpy as np
import torch

from heatsplat.geometry.spectrum import RINGS, held, spectrum


def test_a_spectrum_is_that_of_the_wave_that_an_image_is():
    k = 96  # half waves down 256 rows
    wave = torch.cos(math.pi * k * (torch.arange(256, dtype=torch.float64) + 0.5) / 256)
    found = spectrum([(0.5 + 0.2 * wave)[:, None, None].expand(256, 200, 1)])
    assert found.argmax() == RINGS * k // 256
    assert (np.delete(found, found.argmax()) < 1e-6 * found.max()).all()


def test_shares_rise_from_nothing_to_all_and_nothing_has_none():
    assert held(np.array([1.0, 0.0, 3.0])).tolist() == [0.0, 0.25, 0.25, 1.0]
    assert held(np.zeros(3)).tolist() == [0.0] * 4
