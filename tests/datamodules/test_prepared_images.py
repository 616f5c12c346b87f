import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.prepared_images import prepare
from heatsplat.datamodules.raw_scene import RawFrame, SceneOptions
from heatsplat.datamodules.splits import SplitRule

LENS = Lens(fx=30.0, fy=30.0, cx=4.0, cy=3.0, width=8, height=6)


def prepared(pixels, mask=None, **options):
    read_mask = None if mask is None else lambda: mask
    frame = RawFrame("a.png", np.eye(4), LENS, lambda: pixels, read_mask=read_mask)
    return prepare(frame, SceneOptions(SplitRule("every_8th"), **options))


def test_pixels_without_a_temperature_are_masked_and_filled_beside_the_given_mask():
    pixels = np.full((6, 8), 20.0, np.float32)
    pixels[0, 0], pixels[1, 1] = np.nan, -400.0
    mask = np.ones((6, 8), bool)
    mask[2, 2] = False
    found = prepared(pixels, mask)
    assert np.argwhere(~found.mask).tolist() == [[0, 0], [1, 1], [2, 2]]
    assert (found.thermal == 20.0).all() and found.found["nan"] == 2


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(SceneError, match="mask of a.png is 4x6 but the image is 8x6"):
        prepared(np.zeros((6, 8), np.uint8), np.ones((6, 4), bool))


def test_a_smaller_image_brings_its_lens():
    found = prepared(np.zeros((6, 8), np.uint8), downscale=2.0)
    assert found.thermal.shape == (3, 4) and (found.lens.width, found.lens.height) == (4, 3)
    assert found.mask is None
