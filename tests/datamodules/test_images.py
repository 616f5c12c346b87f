import os
import struct
import unicodedata

import cv2
import numpy as np
import pytest
import torch
from layouts import write_image
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from heatsplat.contracts import SceneError
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats.images import (
    ImageIndex,
    colour_levels,
    pages_of,
    read_grey,
    read_image,
    resized,
    resized_ends,
    resized_mask,
    split_alpha,
    tiff_text,
    to_grey,
)
from heatsplat.geometry.resampling import ends_on


@pytest.mark.parametrize("big", [False, True])
def test_a_tiff_says_what_it_is_in_words(tmp_path, big):
    tags = ImageFileDirectory_v2()
    tags[270], tags[42112] = "Units: deg F", "<GDALMetadata/>"
    Image.fromarray(np.zeros((4, 5), np.float32)).save(tmp_path / "a.tiff", tiffinfo=tags, big_tiff=big)
    assert tiff_text(tmp_path / "a.tiff") == "Units: deg F\n<GDALMetadata/>"
    (tmp_path / "b.tiff").write_bytes((tmp_path / "a.tiff").read_bytes()[:20])
    write_image(tmp_path / "c.png", np.zeros((4, 5), np.uint8))
    assert [tiff_text(tmp_path / name) for name in ("b.tiff", "c.png", "d.tiff")] == ["", "", ""]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [None, 3, 4])
def test_png_files_come_back_as_they_are_stored(tmp_path, dtype, channels):
    shape = (5, 7) if channels is None else (5, 7, channels)
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)
    write_image(tmp_path / "a.png", pixels)
    back = read_image(tmp_path / "a.png")
    assert back.dtype == dtype
    assert (back == pixels).all()


def test_float_files_keep_their_values_and_their_gaps(tmp_path):
    pixels = np.array([[1.25, np.nan], [-40.5, 1e4]], np.float32)
    write_image(tmp_path / "a.tiff", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tiff"), pixels)


def test_grey_with_alpha_has_alpha(tmp_path):
    pixels = np.stack([np.full((4, 4), 90), np.eye(4) * 255], axis=2).astype(np.uint8)
    Image.fromarray(pixels, "LA").save(tmp_path / "a.png")
    grey, alpha = split_alpha(read_image(tmp_path / "a.png"))
    assert (to_grey(grey) == 90).all()
    assert (alpha == np.eye(4, dtype=bool)).all()


def test_the_content_decides_not_the_extension(tmp_path):
    write_image(tmp_path / "a.png", np.full((4, 4), 7, np.uint8))
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    assert (read_image(tmp_path / "a.jpg") == 7).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_damaged_images_are_named(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_image(path, np.random.default_rng(0).integers(0, 255, (60, 60)).astype(np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(SceneError, match=rf"a\{suffix} is corrupt.*copy it again"):
        read_image(path)
    path.write_bytes(b"")
    with pytest.raises(SceneError, match=rf"a\{suffix} is empty \(0 bytes\)"):
        read_image(path)
    path.write_bytes(b"no image at all")
    with pytest.raises(SceneError, match="is corrupt or no image"):
        read_image(path)
    path.unlink()
    with pytest.raises(SceneError, match="cannot be read: No such file"):
        read_image(path)


@pytest.mark.parametrize("place", [19, 24, 25, 28, 32])
def test_a_png_whose_header_is_damaged_is_refused_before_its_pixels_are_sought(tmp_path, monkeypatch, place):
    """Size, type or their checksum: decoding would take seconds and gigabytes to find out."""
    data = bytearray(cv2.imencode(".png", np.zeros((20, 24), np.uint16))[1])
    (tmp_path / "whole.png").write_bytes(data)
    data[place] ^= 1
    (tmp_path / "damaged.png").write_bytes(data)
    assert read_image(tmp_path / "whole.png").shape == (20, 24)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(SceneError, match=r"damaged\.png is corrupt or no image"):
        read_image(tmp_path / "damaged.png")


def test_a_whole_jpeg_is_not_called_truncated(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, np.full((40, 40), 99, np.uint8))
    path.write_bytes(path.read_bytes() + b"\0trailing bytes of a second picture")
    assert abs(read_image(path).astype(int) - 99).max() <= 2


def test_other_pixel_types_are_refused(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.tiff"), np.zeros((4, 4), np.int32))
    with pytest.raises(SceneError, match="pixels of type int32; supported are uint8, uint16 and float32"):
        read_image(tmp_path / "a.tiff")


@pytest.mark.parametrize(("channels", "bits"), [(2, 16), (5, 16), (2, 32)])
def test_channels_that_are_not_decoded_are_refused(tmp_path, channels, bits):
    """Of grey with alpha in 16 bits OpenCV leaves the upper eight."""
    path = tmp_path / "a.tif"
    tags = {256: 4, 257: 2, 258: bits, 277: channels}  # width, height, bits and number of channels
    entries = b"".join(struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in tags.items())
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4))
    with pytest.raises(SceneError, match=f"has {channels} channels of more than 8 bits; supported are 1, 3 and 4"):
        read_image(path)


def test_hidden_files_are_no_images(tmp_path):
    for name in ("a.png", ".hidden/a.png"):
        write_image(tmp_path / name, np.zeros((2, 2), np.uint8))
    (tmp_path / "._a.png").write_bytes(b"\0\x05\x16\x07")
    assert ImageIndex(tmp_path).names == ["a.png"] and ImageIndex(tmp_path / ".hidden").names == ["a.png"]


def test_links_to_folders_are_followed_once(tmp_path):
    write_image(tmp_path / "disk" / "flight" / "a.png", np.zeros((2, 2), np.uint8))
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "thermal").symlink_to(tmp_path / "disk" / "flight")
    (scene / "again").symlink_to(tmp_path / "disk" / "flight")
    (tmp_path / "disk" / "flight" / "back").symlink_to(scene)
    (tmp_path / "disk" / "flight" / "itself").symlink_to(tmp_path / "disk")
    names = ImageIndex(scene).names
    assert {"thermal/a.png", "again/a.png"} <= set(names) and len(names) < 8


def test_names_with_umlauts_are_found_however_these_are_written(tmp_path):
    one, two = (unicodedata.normalize(form, "Köln_1.png") for form in ("NFC", "NFD"))
    write_image(tmp_path / "1.png", np.zeros((2, 2), np.uint8))
    (tmp_path / "1.png").rename(tmp_path / two)
    assert one != two and ImageIndex(tmp_path).find(one) == two
    assert same_files([one], [two]) == {one: [two]}


def test_names_are_found_up_to_case_and_extension(tmp_path):
    for name in ("a.PNG", "sub/b.jpg"):
        write_image(tmp_path / name.lower(), np.zeros((2, 2), np.uint8))
        (tmp_path / name.lower()).rename(tmp_path / name)
    index = ImageIndex(tmp_path)
    assert index.find("a.png") == "a.PNG"
    assert index.find("A.JPG") == "a.PNG"
    assert index.find("sub/b") == "sub/b.jpg"
    assert index.find("b.jpg") is None
    assert index.unused(["a.PNG"]) == ["sub/b.jpg"]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_stored_as_colour_is_exactly_that_grey(dtype):
    grey = np.arange(np.iinfo(np.uint8).max + 1, dtype=dtype).reshape(16, 16) * (np.iinfo(dtype).max // 255)
    stored = np.repeat(grey[..., None], 3, axis=2)
    assert (to_grey(stored) == grey).all()
    assert colour_levels(stored) == 0


def test_colour_maps_are_far_from_grey():
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    colours = cv2.applyColorMap(ramp, cv2.COLORMAP_INFERNO)
    assert colour_levels(colours) > 40


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_shrinking_averages_areas_in_the_stored_type(dtype):
    pixels = (np.array([[0, 10, 4, 4], [20, 30, 4, 5]]) * (np.iinfo(dtype).max // 255)).astype(dtype)
    small = resized(pixels, 2, 1)
    assert small.dtype == dtype
    blocks = pixels.reshape(2, 2, 2).astype(float).mean(axis=(0, 2))
    assert np.abs(small[0] - blocks).max() <= 0.5


def test_a_small_pixel_counts_only_where_all_of_it_does():
    mask = np.ones((4, 6), bool)
    mask[1, 1] = False
    assert resized_mask(mask, 3, 2).tolist() == [[False, True, True], [True, True, True]]


def test_a_tiff_of_several_images_is_refused_where_one_is_expected_and_its_images_are_counted(tmp_path):
    stack = np.random.default_rng(0).normal(20.0, 1.0, (3, 6, 8)).astype(np.float32)
    path = tmp_path / "a.tiff"
    assert cv2.imwritemulti(str(path), list(stack))
    assert pages_of(path) == [0, 1, 2]
    for page in pages_of(path):
        np.testing.assert_array_equal(read_image(path, page), stack[page])
    with pytest.raises(SceneError, match=r"a\.tiff is a TIFF of 3 images, and one is expected; write each into a file"):
        read_image(path)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(stack[2].tobytes()) + 4])  # its last images are cut off
    with pytest.raises(SceneError, match=r"a\.tiff is corrupt"):
        pages_of(path)
        read_image(path, 2)
    write_image(tmp_path / "b.png", np.zeros((4, 4), np.uint8))
    assert pages_of(tmp_path / "b.png") == [0]


@pytest.mark.parametrize("big", [False, True])
def test_previews_in_a_tiff_are_no_images(tmp_path, big):
    full, small = (Image.fromarray(np.full(shape, 7.0, np.float32)) for shape in ((8, 6), (4, 3)))
    full.save(tmp_path / "a.tiff", save_all=True, append_images=[small, full], big_tiff=big)
    assert pages_of(tmp_path / "a.tiff") == [0, 2]
    full.save(tmp_path / "a.tiff", save_all=True, append_images=[small], big_tiff=big)
    assert read_image(tmp_path / "a.tiff").shape == (8, 6)


@pytest.mark.parametrize("layout", ["plain", "big", "deflated"])
def test_a_later_page_of_a_tiff_is_read_without_a_walk_through_those_before(tmp_path, monkeypatch, layout):
    """OpenCV's walk is the longer the more pages there are: 800 small ones took 35 s, 200 of them 0.7 s."""
    pages = [np.full((4, 5), 300.25 + i, np.float32) for i in range(4)]
    how = {"plain": {}, "big": {"big_tiff": True}, "deflated": {"compression": "tiff_adobe_deflate"}}[layout]
    first, *others = [Image.fromarray(page) for page in pages]
    first.save(tmp_path / "a.tiff", save_all=True, append_images=others, **how)
    before = (tmp_path / "a.tiff").read_bytes()
    assert pages_of(tmp_path / "a.tiff") == [0, 1, 2, 3]
    np.testing.assert_array_equal(read_image(tmp_path / "a.tiff", 0), pages[0])
    monkeypatch.delattr("cv2.imreadmulti")
    for number in (3, 1, 2):
        np.testing.assert_array_equal(read_image(tmp_path / "a.tiff", number), pages[number])
    assert (tmp_path / "a.tiff").read_bytes() == before
    with pytest.raises(SceneError, match="a.tiff is corrupt or no image"):
        read_image(tmp_path / "a.tiff", 4)
    with pytest.raises(SceneError, match="b.tiff cannot be read: No such file"):
        read_image(tmp_path / "b.tiff", 1)


def test_files_whose_names_are_not_utf8_are_read(tmp_path):
    """OpenCV's own readers end Python at such a name."""
    for suffix in (".tiff", ".png"):
        path = tmp_path / (os.fsdecode(b"Geb\xe4ude") + suffix)
        pixels = np.arange(48, dtype=np.uint8).reshape(6, 8)
        path.write_bytes(cv2.imencode(suffix, pixels)[1].tobytes())
        for found in (read_image(path), read_image(path, 0), read_grey(path)):
            assert np.array_equal(found, pixels)
    assert read_grey(tmp_path / "none.png") is None


@pytest.mark.parametrize("size", [(32, 24), (13, 9), (7, 5)])
def test_where_an_image_was_cut_off_is_the_same_however_it_is_resized(size):
    """By the data module when it reads it, and by training on smaller ones."""
    width, height = size
    draws = np.random.default_rng(0)
    for share in (0.001, 0.02, 0.5):
        ends = np.where(draws.random((48, 64)) < share, draws.choice([-1, 1], (48, 64)), 0).astype(np.int8)
        read = resized_ends(ends, width, height)
        trained = ends_on(torch.from_numpy(ends), height, width).numpy()
        np.testing.assert_array_equal(read, trained)
        assert share > 0.02 or read.any()
