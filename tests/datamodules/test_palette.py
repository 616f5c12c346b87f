from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import fff, flir_jpeg, palette_record, raw_for, temperatures
from layouts import write_image

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.palette import PERCEIVED, bar_of, known, named, palette_of

FLIR = Path(__file__).parents[3] / "shared" / "data" / "flir"
needs_flir = pytest.mark.skipif(not FLIR.is_dir(), reason="real FLIR data is not at ../shared/data/flir")


def bar(name, length=240, width=20):
    """A vertical bar [length, width, 3], hottest at the top."""
    return np.repeat(np.rint(named(name).curve(length)[::-1]).astype(np.uint8)[:, None], width, axis=1)


def apart(palette, name):
    """Largest distance of a palette's colours from those of a name at the same levels."""
    return np.linalg.norm((palette.curve(256) - named(name).curve(256)) @ PERCEIVED, axis=1).max()


def test_names_are_those_of_matplotlib_opencv_and_iron():
    inferno = named("inferno")
    np.testing.assert_allclose(inferno.colours[0], [0.37, 0.12, 3.53], atol=0.1)
    np.testing.assert_allclose(named("inferno_r").colours, inferno.colours[::-1])
    np.testing.assert_array_equal(
        named("opencv_jet").colours[:, ::-1],
        cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_JET)[:, 0],
    )
    np.testing.assert_allclose(named("opencv_jet_r").colours, named("opencv_jet").colours[::-1])
    iron = named("iron").curve(256) @ [0.299, 0.587, 0.114]
    rises = np.diff(iron)
    assert np.mean(np.abs(rises - 219 / 255) < 0.01) > 0.9  # its luma rises evenly, but where colours are cut off at 0
    assert len({palette.name for palette in known()}) > 60


def test_banded_maps_stand_in_the_middle_of_their_bands():
    palette = named("tab10")
    np.testing.assert_allclose(palette.levels, np.arange(10) / 10 + 0.05, atol=2e-3)


def test_an_unknown_name_tells_similar_ones():
    with pytest.raises(SceneError, match=r"data.palette=infermo is no palette \(did you mean inferno.*bar.png"):
        palette_of("infermo", None, None)
    with pytest.raises(SceneError, match="data.palette=no.png: there is no file"):
        palette_of("no.png", None, None)


@pytest.mark.parametrize("turn, hot", [(0, None), (1, "left"), (2, "bottom"), (3, None), (0, "top"), (3, "right")])
def test_a_bar_is_read_along_the_side_on_which_colours_change(tmp_path, turn, hot):
    write_image(tmp_path / "bar.png", np.ascontiguousarray(np.rot90(bar("jet"), turn)))
    assert apart(palette_of("bar.png", hot, tmp_path), "jet") < 3.0


def test_the_other_end_of_a_bar_is_hot_where_that_is_said(tmp_path):
    write_image(tmp_path / "bar.png", bar("iron"))
    assert apart(palette_of("bar.png", "bottom", tmp_path), "iron_r") < 3.0


def test_frames_and_ticks_of_a_bar_are_left_out(tmp_path):
    pixels = bar("iron")
    pixels[::40, :4] = 255  # ticks
    framed = cv2.copyMakeBorder(pixels, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    write_image(tmp_path / "bar.png", framed)
    assert apart(bar_of(tmp_path / "bar.png"), "iron") < 3.0


def test_a_bar_out_of_a_jpeg_is_good_to_a_hundredth_of_the_scale(tmp_path):
    cv2.imwrite(str(tmp_path / "bar.jpg"), bar("iron")[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
    found, true = bar_of(tmp_path / "bar.jpg"), named("iron").curve(256)
    distances = np.linalg.norm((true[:, None] - found.curve(1024)) @ PERCEIVED, axis=2)
    error = distances.argmin(axis=1) / 1023 - np.linspace(0, 1, 256)
    assert np.abs(error).max() < 0.03 and np.abs(error).mean() < 0.01


def test_what_is_no_bar_is_refused_by_name(tmp_path):
    rng = np.random.default_rng(0)
    pictures = {
        "of several colours across": rng.integers(0, 256, (60, 30, 3)),
        "12 pixels long": bar("iron", 12, 4),
        "no colour picture of 8 bits": rng.integers(0, 256, (60, 20)),
        "shows one colour alone": np.full((60, 20, 3), 90),
    }
    for says, pixels in pictures.items():
        write_image(tmp_path / "bar.png", pixels.astype(np.uint8))
        with pytest.raises(SceneError, match=rf"data.palette: .*bar.png.*{says}"):
            palette_of("bar.png", "top", tmp_path)
    write_image(tmp_path / "bar.png", rng.integers(0, 256, (60, 60, 3)).astype(np.uint8))
    with pytest.raises(SceneError, match="does not tell along which side.*data.palette_hot=top"):
        palette_of("bar.png", None, tmp_path)


def test_a_side_is_said_of_bars_alone():
    with pytest.raises(SceneError, match="data.palette_hot=top is for the picture of a colour bar; of iron, _r"):
        palette_of("iron", "top", None)
    with pytest.raises(SceneError, match="data.palette_hot"):
        palette_of("iron", "up", None)


# Levels of iron by FLIR's order of luma, red and blue chroma
RECORD = np.array([[16, 101, 140], [71, 179, 179], [126, 198, 96], [181, 173, 33], [235, 121, 130]])


def test_the_palette_in_a_flir_file_serves_its_siblings(tmp_path):
    data = flir_jpeg(raw_for(temperatures()), palette=palette_record(RECORD))
    (tmp_path / "FLIR1.jpg").write_bytes(data)
    for setting in ("FLIR1.jpg", "embedded"):
        found = palette_of(setting, None, tmp_path)
        assert "FLIR1.jpg" in found.name and len(found.colours) == 5
        np.testing.assert_allclose(found.colours, named("iron").curve(5), atol=3.0)
    (tmp_path / "FLIR2.jpg").write_bytes(data)
    (tmp_path / "FLIR0.jpg").write_bytes(flir_jpeg(raw_for(temperatures())))  # one without
    assert "FLIR1.jpg" in palette_of("embedded", None, tmp_path).name
    other = flir_jpeg(raw_for(temperatures()), palette=palette_record(RECORD[::-1]))
    (tmp_path / "FLIR2.jpg").write_bytes(other)
    with pytest.raises(SceneError, match=r"FLIR1.jpg and .*FLIR2.jpg hold different palettes.*data.palette=FLIR1.jpg"):
        palette_of("embedded", None, tmp_path)


def test_flir_files_without_a_palette_are_named(tmp_path):
    (tmp_path / "a.jpg").write_bytes(flir_jpeg(raw_for(temperatures())))
    with pytest.raises(SceneError, match="data.palette=embedded: no FLIR file in .* holds a palette"):
        palette_of("embedded", None, tmp_path)
    with pytest.raises(SceneError, match="a.jpg is a FLIR file without a palette"):
        palette_of("a.jpg", None, tmp_path)
    (tmp_path / "a.fff").write_bytes(fff(raw_for(temperatures()), palette=palette_record(RECORD)[:-4]))  # cut short
    with pytest.raises(SceneError, match="a.fff is a FLIR file without a palette"):
        palette_of("a.fff", None, tmp_path)


@needs_flir
def test_iron_is_that_of_a_real_camera():
    found = palette_of(str(FLIR / "IMG_0620.JPG"), None, None)
    assert len(found.colours) == 224
    assert np.abs(found.curve(224) - named("iron").curve(224)).max() < 1.5
