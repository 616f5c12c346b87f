import logging
from dataclasses import replace

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.prepared_images import check_equals, image_notes, prepare
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


def test_a_mask_of_a_larger_photo_leaves_out_every_pixel_that_it_touches():
    mask = np.ones((15, 20), bool)
    mask[:5, :5] = False  # of 2.5 pixels a pixel
    found = prepared(np.zeros((6, 8), np.uint8), mask)
    assert np.argwhere(~found.mask).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]] and found.found["mask_resized"]
    assert not prepared(np.zeros((6, 8), np.uint8), np.eye(6, 8) == 0).found["mask_resized"]
    smaller = np.array([[False, True, True, True], [True] * 4, [True] * 4])
    assert np.argwhere(~prepared(np.zeros((6, 8), np.uint8), smaller).mask)[:, 0].max() <= 2


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(SceneError, match="mask of a.png is 4x6 but the image is 8x6"):
        prepared(np.zeros((6, 8), np.uint8), np.ones((6, 4), bool))


def test_a_smaller_image_brings_its_lens():
    found = prepared(np.zeros((6, 8), np.uint8), downscale=2.0)
    assert found.thermal.shape == (3, 4) and (found.lens.width, found.lens.height) == (4, 3)
    assert found.mask is None


def shaped(width, height, lens=LENS):
    frame = RawFrame("a.png", np.eye(4), lens, lambda: np.zeros((height, width), np.uint8))
    return prepare(frame, SceneOptions(SplitRule("every_8th")))


@pytest.mark.parametrize(("downscale", "size"), [(1.0, (52, 66)), (4.0, (12, 16)), (1.1, (48, 60)), (50.0, (4, 4))])
def test_images_that_shrink_can_be_divided(downscale, size):
    lens = Lens(fx=60.0, fy=60.0, cx=33.0, cy=26.0, width=66, height=52)
    frame = RawFrame("a.png", np.eye(4), lens, lambda: np.zeros((52, 66), np.uint8))
    found = prepare(frame, SceneOptions(SplitRule("every_8th"), downscale, multiple=4))
    assert found.thermal.shape == size and (found.lens.height, found.lens.width) == size
    assert found.lens.fx == pytest.approx(60.0 * size[1] / 66) and found.lens.cy == pytest.approx(size[0] / 2)


@pytest.mark.parametrize(("width", "height"), [(512, 640), (320, 240), (640, 480)])
def test_an_image_of_another_shape_than_its_camera_is_refused(width, height):
    lens = Lens(fx=600.0, fy=600.0, cx=320.0, cy=256.0, width=640, height=512)
    with pytest.raises(
        SceneError, match=f"image a is {width}x{height}, but its camera is 640x512.*1 of 2 images .*w and h"
    ):
        check_equals({"a": shaped(width, height, lens), "b": shaped(640, 512, replace(lens, fx=500.0))})


def test_images_smaller_than_their_camera_are_told_in_the_log(caplog):
    lens = Lens(fx=600.0, fy=600.0, cx=320.0, cy=256.0, width=641, height=513)
    images = {"a": shaped(320, 256, lens), "b": shaped(320, 256, lens), "c": shaped(641, 513, replace(lens, fx=500.0))}
    check_equals(images)
    with caplog.at_level(logging.INFO):
        notes = image_notes(dict(enumerate(images.values())), 1.0)
    told = "2 images of 320x256 with a camera of 641x513: intrinsics follow the image"
    assert notes["intrinsics_rescaled"] == told and (told, "INFO") in [(r.message, r.levelname) for r in caplog.records]


def test_images_trimmed_by_a_few_pixels_are_warned_of(caplog):
    lens = Lens(fx=600.0, fy=600.0, cx=320.0, cy=256.0, width=640, height=512)
    image = shaped(640, 503, lens)
    check_equals({"a": image})
    notes = image_notes({0: image}, 1.0)
    assert "1 image of 640x503 with a camera of 640x512" in caplog.text and "cropped" in notes["intrinsics_rescaled"]
