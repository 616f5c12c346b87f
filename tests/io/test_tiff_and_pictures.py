"""Temperature files are bit-exact; pictures show the right colours at the right places."""

import os
import sys
from dataclasses import replace

import cv2
import matplotlib
import numpy as np
import pytest
import torch
from PIL import Image

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.io import pictures
from heatsplat.io.pictures import (
    BAR,
    GAP,
    MARKED,
    UNKNOWN,
    Bar,
    Panel,
    _ticks,
    checked_contours,
    checked_isotherm,
    colorize,
    comparison_panels,
    compose,
    error_limit_of,
    fitted,
    image_panel,
    visible,
    write_figure,
    write_png,
)
from heatsplat.io.tiff import read_temperature, write_temperature
from heatsplat.io.video import encoder, video

RANGE = ThermalRange(10.0, 50.0)


def picture_of(values, low, high, title="", unit="°C"):
    return compose([Panel(colorize(values, low, high), title, Bar(low, high, unit))])


def test_temperatures_survive_bit_by_bit(tmp_path):
    celsius = torch.linspace(-40, 1200, 35 * 21).reshape(35, 21, 1).sin() * 300
    celsius[3, 4] = float("nan")
    path = tmp_path / "new" / "t.tiff"
    write_temperature(path, celsius)
    assert np.array_equal(read_temperature(path), celsius[..., 0].numpy(), equal_nan=True)
    theirs = np.asarray(Image.open(path))  # another library reads it too
    assert np.array_equal(theirs, celsius[..., 0].numpy(), equal_nan=True)


def test_temperature_files_are_checked(tmp_path):
    with pytest.raises(ValueError, match=r"is \[H, W\] or \[H, W, 1\], got \[3, 4, 2\]"):
        write_temperature(tmp_path / "t.tiff", np.zeros((3, 4, 2)))
    with pytest.raises(ValueError, match=r"name the file \.tiff"):
        write_temperature(tmp_path / "t.png", np.zeros((3, 4)))
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        read_temperature(tmp_path / "missing.tiff")
    for content in (b"", b"no picture"):
        (tmp_path / "none.tiff").write_bytes(content)
        with pytest.raises(ValueError, match="cannot be read as an image"):
            read_temperature(tmp_path / "none.tiff")
    cv2.imwrite(str(tmp_path / "grey.tiff"), np.zeros((3, 4), dtype=np.uint8))
    with pytest.raises(ValueError, match="holds uint8"):
        read_temperature(tmp_path / "grey.tiff")


@pytest.mark.parametrize("name", [b"M\xfcller", "Müller".encode(), b"a b'%04d"])
def test_folders_of_temperatures_may_have_any_name(tmp_path, name):
    folder = tmp_path / os.fsdecode(name)
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system has names in UTF-8 only")
    write_temperature(folder / "t.tiff", np.arange(6.0).reshape(2, 3))
    assert (read_temperature(folder / "t.tiff") == np.arange(6.0).reshape(2, 3)).all()


def test_colours_are_those_of_matplotlib():
    values = np.linspace(10, 50, 256).reshape(16, 16)
    expected = matplotlib.colormaps["inferno"](np.arange(256), bytes=True)[:, :3].reshape(16, 16, 3)
    assert np.abs(colorize(values, 10, 50).astype(int) - expected).max() == 0
    ends = colorize(np.array([[-99.0, 99.0, np.nan]]), 10, 50)[0]
    assert (ends[0] == expected[0, 0]).all()
    assert (ends[1] == expected[-1, -1]).all()
    assert tuple(ends[2]) in UNKNOWN
    flat = colorize(np.full((2, 2), 7.0), 7.0, 7.0)
    assert (flat == flat[0, 0]).all()


def test_ticks_lie_at_round_numbers_within_the_bar():
    assert _ticks(Bar(10, 50, "°C"))[-1] == (50.0, "50 °C")
    assert [text for _, text in _ticks(Bar(-0.2, 0.2, "°C"))] == ["−0.2", "−0.1", "0.0", "0.1", "0.2 °C"]
    assert [text for _, text in _ticks(Bar(17.1, 31.0, "°C"))] == ["17.5", "20.0", "22.5", "25.0", "27.5", "30.0 °C"]
    for low, high in ((0, 1e-3), (-40, 900), (21.34, 21.41), (0, 3e4)):
        values = [value for value, _ in _ticks(Bar(low, high, ""))]
        assert 3 <= len(values) <= 8
        assert low - 1e-9 <= min(values) and max(values) <= high + 1e-9
        labels = [float(text.replace("−", "-")) for _, text in _ticks(Bar(low, high, ""))]
        assert labels == pytest.approx(values, rel=1e-6, abs=1e-9)
    assert _ticks(Bar(5, 5, "°C")) == [(5, "5 °C")]
    # Of values that are alike but for rounding there is no number between the ends.
    assert _ticks(Bar(26.826345443725586, 26.826345443725586 + 2.2e-13, "°C")) == [(26.826345443725586, "26.8263 °C")]


def test_the_picture_holds_the_image_and_the_bar():
    celsius = np.full((65, 80), 10.0)
    celsius[:, 40:] = 50.0
    picture = picture_of(celsius, 10, 50, "t = 5 s")
    assert picture.dtype == np.uint8 and picture.shape[0] % 2 == 0 and picture.shape[1] % 2 == 0
    cold, warm = colorize(np.array([[10.0, 50.0]]), 10, 50)[0]
    row = picture[picture.shape[0] // 2]  # 65 rows enlarged 4 times
    assert (row[GAP : GAP + 160] == cold).all()
    assert (row[GAP + 160 : GAP + 320] == warm).all()
    longer = picture_of(celsius, 10, 50, "a title that is far too long " * 9)
    assert longer.shape == picture.shape  # frames of a video must not change their size with their title


def test_bars_of_thermal_images_say_whether_they_are_temperatures():
    grey, colour = torch.full((8, 8, 1), 0.5), torch.full((8, 8, 3), 0.5)

    def units(image, bounds):
        return [panel.bar and panel.bar.unit for panel in comparison_panels(image, image, bounds)]

    assert units(grey, RANGE) == [None, "°C", "°C"] and units(grey, None) == [None, "image value", "image value"]
    assert units(colour, RANGE) == units(colour, None) == [None, None, ""]


def test_wide_images_are_enlarged_to_a_width_that_a_page_can_have():
    assert compose([Panel(np.zeros((4, 5000, 3), np.uint8), "scan")]).shape[1] == 5000 + 2 * GAP
    assert compose([Panel(np.zeros((16, 100, 3), np.uint8), "scan")]).shape[1] == 1000 + 2 * GAP


def test_comparison_shows_signed_errors_in_celsius():
    target = torch.full((65, 40, 1), 0.25)
    target[:, :20] = 0.5
    prediction = target.clone()
    prediction[:32] += 0.05  # 2 °C too warm above
    prediction[33:] -= 0.05
    mask = torch.ones(65, 40, dtype=torch.bool)
    mask[:, 30:] = False
    picture = compose(comparison_panels(target, prediction, RANGE, mask), "frame")
    step = 160 + GAP
    middle = picture.shape[0] // 2
    red, blue = colorize(np.array([[2.0, -2.0]]), -2, 2, "RdBu_r")[0]
    columns = {tuple(c) for c in picture[middle - 60].tolist()}
    assert tuple(red) in columns and tuple(blue) not in columns
    assert tuple(blue) in {tuple(c) for c in picture[middle + 80].tolist()}
    assert tuple(picture[middle, GAP + 155]) in UNKNOWN  # masked in the ground truth
    assert tuple(picture[middle, step + GAP + 155]) not in UNKNOWN  # and shown in the render


def test_a_bar_has_arrows_where_values_lie_beyond_its_ends():
    bar = Bar(-5.0, 5.0, "°C")
    values = np.linspace(7.0, 12.0, 600).reshape(20, 30)
    told = image_panel(torch.from_numpy(values)[..., None], "after 17.55 h", bar)
    assert (told.bar.below, told.bar.above, told.title) == (False, True, "after 17.55 h · 100 % above 5 °C")
    inside = image_panel(torch.from_numpy(values - 10)[..., None], "x", bar)
    assert inside.bar == bar and inside.title == "x"
    assert bar.of(values - 12, np.array([-5.2, np.nan])) == replace(bar, above=False, below=True)
    plain, arrowed = (compose([Panel(told.image, "x", one)]) for one in (bar, told.bar))
    assert plain.shape == arrowed.shape and (plain != arrowed).any()  # frames of a video keep their size
    middle = len(plain) // 2
    assert (plain[middle:] == arrowed[middle:]).all()  # the lower end is as it was


def test_an_isotherm_is_green_in_the_picture_and_at_the_bar_and_its_share_is_told():
    values = np.linspace(0.0, 10.0, 200).reshape(10, 20)
    values[0, 0] = np.nan
    for given, words, share in (
        ([8.0, None], "above 8 °C", (values >= 8).sum() / 199),
        ([None, -2.5], "below −2.5 °C", 0.0),
        ([2, 3], "between 2 and 3 °C", ((values >= 2) & (values <= 3)).sum() / 199),
    ):
        bar = Bar(0.0, 10.0, "°C", isotherm=checked_isotherm("isotherm", given))
        panel = image_panel(torch.from_numpy(values)[..., None], "x", bar)
        assert panel.title == f"green: {100 * share:.1f} % {words} · x"
        green = (panel.image == MARKED).all(-1)
        assert green.sum() == round(199 * share)
        plain = image_panel(torch.from_numpy(values)[..., None], "x", Bar(0.0, 10.0, "°C"))
        assert (panel.image[~green] == plain.image[~green]).all()
        barred = (compose([Panel(plain.image, "", bar)]) == MARKED).all(-1)
        assert set(barred.sum(1)) == ({0, BAR} if share else {0})  # the bar alone


def test_a_picture_of_320_pixels_has_the_whole_share_of_an_isotherm_in_its_title(monkeypatch):
    written = []
    cut = pictures._fit
    monkeypatch.setattr(pictures, "_fit", lambda text, width: written.append(cut(text, width)) or written[-1])
    bar = Bar(0.0, 10.0, "°C", isotherm=(-12.25, 30.75))
    panel = image_panel(torch.full((256, 320, 1), 5.0), "temperature as recorded by the camera", bar)
    compose([panel], "90.0 s   DJI_20240806173449_0008_T")
    assert any("green: 100.0 % between −12.25 and 30.75 °C" in text for text in written)


def test_contour_lines_run_where_the_value_is_and_end_where_none_is_known(tmp_path):
    values = np.add.outer(np.zeros(20), np.linspace(0.0, 11.6, 30))  # 0.4 a column
    values[15:] = np.nan
    bar = Bar(1.0, 9.0, "°C", contours=4.0)
    panel = image_panel(torch.from_numpy(values)[..., None], "x", bar)
    assert bar.levels() == [4.0, 8.0] and [level for level, _ in panel.lines] == [4.0, 8.0]
    for level, line in panel.lines:
        np.testing.assert_allclose(line[:, 0], level / 0.4)
        assert line[:, 1].min() == 0 and line[:, 1].max() == 14
    picture, plain = compose([panel]), compose([replace(panel, lines=[], bar=replace(bar, contours=None))])
    changed = np.nonzero((picture != plain).any(-1)[GAP + 60])[0]
    factor = 13  # of 20 x 30 pixels
    middles = {round(GAP + (level / 0.4 + 0.5) * factor - 0.5) for level in bar.levels()}
    assert middles <= set(changed[changed < GAP + 30 * factor].tolist()) and len(changed) < 2 * 6 + 10
    write_figure(tmp_path / "p.svg", [panel])
    assert (tmp_path / "p.svg").read_text().count("#ffffff") > 4
    few = replace(bar, contours=[20.0, 5.0, 5.0])
    assert few.levels() == [5.0, 20.0]
    assert [level for level, _ in image_panel(torch.from_numpy(values)[..., None], "x", few).lines] == [5.0]
    assert image_panel(torch.full((5, 5, 1), torch.nan), "x", few).lines == []
    with pytest.raises(SceneError, match="contours=0.1 draws more than 50 lines between 1 and 9 °C: give 0.2 or more"):
        replace(bar, contours=0.1).levels()


def test_isotherms_and_contours_that_are_none_are_refused_with_the_option():
    for wrong in (30, [30], [30, 20], [20, 20], [None, None], ["20", 30], [float("nan"), 3], "ab", {}):
        with pytest.raises(
            SceneError, match=r"isotherm must be \[low, high\] of rising numbers, \[low, null\] for all above"
        ):
            checked_isotherm("isotherm", wrong)
    with pytest.raises(SceneError, match=r"got \[null, null\]$"):
        checked_isotherm("isotherm", [None, None])
    for wrong in (0, -1, "5", [], [20, None], True, float("inf")):
        with pytest.raises(SceneError, match="contours must be a distance above 0, such as 5, or a list of values"):
            checked_contours("contours", wrong)
    assert checked_isotherm("isotherm", None) is checked_contours("contours", None) is None
    assert checked_contours("contours", [20, 25.5]) == [20, 25.5]


def test_panels_are_laid_out_in_rows():
    panel = Panel(np.zeros((65, 40, 3), np.uint8), "x")
    one, rows = compose([panel] * 4), compose([panel] * 13, columns=4)
    assert rows.shape[1] == one.shape[1] and rows.shape[0] > 3.5 * (one.shape[0] - GAP)


@pytest.mark.parametrize("channels", [1, 3])
def test_comparison_without_range_or_pixels(channels):
    image = torch.rand(20, 30, channels, generator=torch.Generator().manual_seed(1))
    same = compose(comparison_panels(image, image))
    assert same.ndim == 3 and (same < 255).any()
    empty = compose(comparison_panels(torch.full_like(image, float("nan")), image, RANGE))
    assert empty.shape[0] == same.shape[0]
    with pytest.raises(ValueError, match="of one shape"):
        comparison_panels(image, image[:-1])


def test_png_round_trip(tmp_path):
    picture = picture_of(np.linspace(0, 1, 600).reshape(20, 30), 0, 1, unit="")
    content = write_png(tmp_path / "a" / "p.png", picture)
    assert content == (tmp_path / "a" / "p.png").read_bytes()
    assert (cv2.imread(str(tmp_path / "a" / "p.png"))[..., ::-1] == picture).all()


def test_edges_that_no_camera_saw_do_not_set_the_error_bar():
    errors = np.abs(np.random.default_rng(0).normal(0, 0.3, 10_000))
    assert error_limit_of(errors) == 1.0  # 99 in 100 stay below 0.77
    errors[:1500] = 20.0
    assert error_limit_of(errors) == 2.0
    assert error_limit_of(np.zeros(0)) == error_limit_of(np.zeros(9)) == 1e-3
    assert error_limit_of(np.array([0.0] * 90 + [3.0] * 10)) == 5.0  # nothing but a corner of a background is wrong


def test_figures_hold_text_and_pixels(tmp_path):
    image = torch.linspace(0, 1, 600).reshape(20, 30, 1)
    shown = comparison_panels(image, image + 0.01, RANGE, bounds=(10, 50), error_limit=2.0)
    for ending in ("svg", "pdf"):
        write_figure(tmp_path / "a" / f"p.{ending}", shown, "frame 1")
        content = (tmp_path / "a" / f"p.{ending}").read_bytes()
        write_figure(tmp_path / f"p.{ending}", shown, "frame 1")
        assert (tmp_path / f"p.{ending}").read_bytes() == content  # no date, no random names
    svg = (tmp_path / "a" / "p.svg").read_text()
    assert ">ground truth</text>" in svg and ">frame 1</text>" in svg and "<image" in svg


def test_a_figure_shows_names_with_dollar_signs_as_they_are(tmp_path):
    write_figure(tmp_path / "p.svg", [Panel(np.zeros((4, 6, 3), np.uint8), "$5 and $6")], "a$^$b")
    svg = (tmp_path / "p.svg").read_text()
    assert ">$5 and $6</text>" in svg and ">a$^$b</text>" in svg


def read_video(path):
    film, read = cv2.VideoCapture(str(path)), []
    while (got := film.read())[0]:
        read.append(got[1][..., ::-1])
    return film.get(cv2.CAP_PROP_FPS), int(film.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode(), read


@pytest.mark.parametrize("codec", ["mpeg4", "h264"])
def test_video_round_trip(tmp_path, codec):
    if codec == "h264":
        pytest.importorskip("imageio_ffmpeg")
    y = np.linspace(0, 1, 64)[:, None] * np.ones((1, 48))
    frames = [picture_of(y * (0.2 + 0.1 * i), 0, 1, f"t = {i} s") for i in range(5)]
    path = tmp_path / "v" / "time.mp4"
    with video(path, 10, codec) as add:
        for frame in frames:
            add(frame)
    fps, name, read = read_video(path)
    assert fps == pytest.approx(10)
    assert name == {"mpeg4": "FMP4", "h264": "h264"}[codec]
    assert len(read) == 5 and read[0].shape == frames[0].shape
    assert np.abs(read[3].astype(int) - frames[3]).mean() < 6  # lossy, yet the same picture
    assert np.abs(read[0].astype(int) - frames[4]).mean() > 6


@pytest.mark.parametrize("codec", ["mpeg4", "h264"])
def test_a_video_that_the_disk_cut_off_is_told(tmp_path, monkeypatch, codec):
    if codec == "h264":
        pytest.importorskip("imageio_ffmpeg")
    whole, left = encoder(codec), 0

    def on_a_full_disk(path, *arguments):
        add, close = whole(path, *arguments)
        return add, lambda: (close(), os.truncate(path, path.stat().st_size * left // 100))

    monkeypatch.setattr("heatsplat.io.video.encoder", lambda _: on_a_full_disk)
    noise = np.random.default_rng(0).integers(0, 255, (64, 48, 3), np.uint8)
    for left in (0, 30, 99):  # noqa: B007
        with (
            pytest.raises(OSError, match=r"not all of the video was written: '.*v\.mp4"),
            video(tmp_path / "v.mp4", 10, codec) as add,
        ):
            for _ in range(5):
                add(noise)


def test_videos_are_checked(tmp_path, monkeypatch):
    frame = np.zeros((16, 16, 3), dtype=np.uint8)

    def write(name, frames, codec="mpeg4"):
        with video(tmp_path / name, codec=codec) as add:
            for one in frames:
                add(one)

    with pytest.raises(ValueError, match="at least one frame"):
        write("v.mp4", [])
    with pytest.raises(ValueError, match="the name is not UTF-8, which OpenCV cannot write to"):
        write(os.fsdecode(b"M\xfcller.mp4"), [frame])
    with pytest.raises(ValueError, match=r"video frame 1 is uint8 \[16, 18, 3\], the first was uint8 \[16, 16, 3\]"):
        write("v.mp4", [frame, np.zeros((16, 18, 3), dtype=np.uint8)])
    with pytest.raises(ValueError, match=r"name the file \.mp4"):
        write("v.avi", [frame])
    with pytest.raises(ValueError, match="even sides"):
        write("v.mp4", [frame[:15]])
    with pytest.raises(ValueError, match="codec must be one of auto, h264, mpeg4"):
        write("v.mp4", [frame], "av1")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"pip install 'heatsplat\[video\]'"):
        write("v.mp4", [frame], "h264")
    write("v.mp4", [frame], "auto")
    assert read_video(tmp_path / "v.mp4")[1] == "FMP4"


def test_what_is_not_known_is_hatched_so_that_no_colour_bar_has_it():
    colors = colorize(np.full((12, 12), np.nan), 10, 50).reshape(-1, 3)
    assert {tuple(color) for color in np.unique(colors, axis=0)} == set(UNKNOWN)


def test_visible_light_that_nobody_has_seen_is_hatched_like_temperatures():
    image = torch.full((32, 48, 3), 0.5)
    image[4:20, 8:30] = torch.nan
    found = visible(image)
    unseen = torch.full((32, 48), 20.0)
    unseen[4:20, 8:30] = torch.nan
    hatched = colorize(unseen, 0.0, 40.0)
    assert (found[4:20, 8:30] == hatched[4:20, 8:30]).all() and len(np.unique(found[4:20, 8:30])) > 1
    assert (found[:4] == 128).all()


def test_a_picture_of_another_size_lies_in_the_middle_of_the_paper_and_is_made_smaller_where_it_is_larger():
    ink = np.zeros((10, 20, 3), dtype=np.uint8)
    padded, smaller = fitted(ink, 14, 20), fitted(ink, 10, 10)
    assert (
        padded.shape == (14, 20, 3)
        and (padded[2:12] == 0).all()
        and (padded[:2] == 255).all()
        and (padded[12:] == 255).all()
    )
    assert (
        smaller.shape == (10, 10, 3)
        and (smaller[2:7] == 0).all()
        and (smaller[:2] == 255).all()
        and (smaller[7:] == 255).all()
    )
