import io
import logging
import re
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from PIL import Image

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.palette import Palette, known, named
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader, palette_notes

SHAPE = (96, 128)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]


def scene(seed=0):
    """Levels in [0, 1]: slopes, and warm and cold discs with edges."""
    rng = np.random.default_rng(seed)
    levels = 0.25 + 0.5 * COLUMNS / SHAPE[1]
    for _ in range(12):
        x, y, r = rng.uniform(0, SHAPE[1]), rng.uniform(0, SHAPE[0]), rng.uniform(4, 18)
        levels = np.where((COLUMNS - x) ** 2 + (ROWS - y) ** 2 < r * r, rng.uniform(0, 1), levels)
    return np.clip(cv2.GaussianBlur(levels, (0, 0), 0.7), 0, 1)


def coloured(levels, palette, entries=256):
    """A picture of levels in a palette of so many entries, as a camera draws it."""
    return np.rint(palette.curve(entries)[np.rint(levels * (entries - 1)).astype(int)]).astype(np.uint8)


def jpeg(pixels, quality, subsampling):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=quality, subsampling=subsampling)
    return np.array(Image.open(file))


def errors(found, levels):
    """In per cent of the scale, of the pixels that are known."""
    return 100 * np.abs(found.levels / 255.0 - levels)[found.known]


def read(pixels, palette, counts=None, name="a.png"):
    return PaletteReader(palette).read(pixels, counts, name)


def test_every_palette_that_rises_gives_its_levels_back():
    several = 0
    ramp = np.tile(np.linspace(0, 1, 256), (4, 1))
    for palette in [*known()][::2]:
        steps = np.linalg.norm(np.diff(palette.curve(256), axis=0), axis=1)
        if len(palette.levels) < 200 or steps.max() > 20:
            continue  # bands
        try:
            reader = PaletteReader(palette)
        except SceneError:
            continue
        if reader.alike.any():
            continue
        several += 1
        found = reader.read(coloured(ramp, palette), None, "a.png")
        assert errors(found, ramp).max() < 2.0, palette.name
        assert found.known.mean() > 0.9, palette.name
    assert several > 25


@pytest.mark.parametrize("name", ["iron", "jet", "inferno", "turbo", "hot"])
@pytest.mark.parametrize(
    "quality, subsampling, median, most", [(95, 0, 0.5, 1.7), (95, 2, 0.6, 3.5), (75, 0, 0.9, 3.2), (75, 2, 1.0, 4.5)]
)
def test_jpeg_costs_a_hundredth_of_the_scale(name, quality, subsampling, median, most):
    levels = scene()
    found = read(jpeg(coloured(levels, named(name)), quality, subsampling), named(name))
    err = errors(found, levels)
    assert np.median(err) < median and np.percentile(err, 95) < most
    assert found.fit.off < 0.12 * levels.size


def test_levels_lie_between_the_entries_of_a_coarse_palette():
    palette = Palette("six", named("iron").curve(6), np.linspace(0, 1, 6))
    levels = np.tile(np.linspace(0, 1, 200), (4, 1))
    found = read(coloured(levels, palette, 1001), palette)
    assert errors(found, levels).max() < 0.5 and found.known.all()


def test_a_palette_whose_luma_falls_is_told_by_its_colours():
    levels = np.tile(np.linspace(0, 1, 256), (8, 1))
    pixels = coloured(levels, named("jet"))
    luma = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)[0].astype(int)
    assert np.diff(luma).min() < 0 < np.diff(luma).max()
    found = read(pixels, named("jet")).levels[0].astype(int)
    assert np.all(np.diff(found) >= 0) and found[0] <= 2 and found[-1] >= 253


@pytest.mark.parametrize("colour", [(0, 255, 0), (255, 255, 255), (128, 128, 128)])
@pytest.mark.parametrize("quality", [None, 95, 75])
def test_what_is_drawn_over_the_picture_is_left_out(colour, quality):
    levels = 0.2 + 0.5 * scene()
    pixels = coloured(levels, named("iron"))
    text = np.zeros(SHAPE, np.uint8)
    cv2.putText(text, "23.4", (20, 50), 0, 1.2, 255, 3)
    cv2.rectangle(text, (110, 10), (118, 80), 255, -1)
    pixels[text > 0] = colour
    found = read(pixels if quality is None else jpeg(pixels, quality, 2), named("iron"))
    drawn = text > 0
    assert found.known[drawn].mean() < (0.05 if quality == 75 else 0.02)
    apart = cv2.dilate(text, np.ones((9, 9))) == 0
    assert found.known[apart].mean() > 0.95
    assert np.mean(errors(found, levels) > 5) <= (0.0 if quality is None else 0.02)


def test_edges_that_jpeg_has_blurred_are_kept():
    levels = np.where((COLUMNS // 21 + ROWS // 19) % 2, 0.15, 0.8)  # sharp edges
    for name in ("iron", "jet"):
        pixels = jpeg(coloured(levels, named(name)), 90, 2)
        reader = PaletteReader(named(name))
        distance = reader._look_up(pixels)[1] / 4
        found = reader.read(pixels, None, "a.png")
        assert np.mean(distance > 14) > 0.02 and found.fit.off < 0.4 * np.sum(distance > 14)
        assert np.percentile(errors(found, levels), 95) < 8


def test_the_median_stands_where_nothing_is_known():
    pixels = coloured(np.full(SHAPE, 0.4), named("iron"))
    pixels[:10] = (0, 255, 0)
    found = read(pixels, named("iron"))
    assert not found.known[:10].any() and np.all(np.abs(found.levels[:10] - 0.4 * 255) <= 1)
    assert found.fit.off == 10 * SHAPE[1]


def test_another_palette_is_refused_with_the_file_and_the_one_that_fits():
    pixels = jpeg(coloured(scene(), named("inferno")), 90, 2)
    with pytest.raises(SceneError, match=r"image f7.jpg is not in the colours of jet: \d+ % .*inferno fits .*bar.png"):
        read(pixels, named("jet"), name="f7.jpg")
    photo = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
    with pytest.raises(SceneError, match=r"image f8.jpg is not in the colours of iron(?!.* fits)"):
        read(photo, named("iron"), name="f8.jpg")


def test_what_a_mask_leaves_out_judges_nothing():
    pixels = coloured(scene(), named("iron"))
    pixels[:70] = (0, 255, 0)
    with pytest.raises(SceneError, match="a.png is not in the colours of iron: 7. %"):
        read(pixels, named("iron"))
    counts = ROWS >= 70
    found = read(pixels, named("iron"), counts)
    assert found.fit.off == 0 and found.known[70:].all()
    assert not read(pixels, named("iron"), np.zeros(SHAPE, bool)).known[:70].any()  # nothing counts, nothing is judged


def test_greys_are_no_pseudo_colour():
    grey = np.rint(255 * scene()).astype(np.uint8)
    for pixels in (grey, np.repeat(grey[..., None], 3, axis=2), np.repeat(grey[..., None] // 8, 3, axis=2)):
        for name in ("iron", "jet"):
            with pytest.raises(SceneError, match=f"image a.png is grey, and {name} is not: leave data.palette out"):
                read(pixels, named(name))
    for pixels in (grey, np.repeat(grey[..., None], 3, axis=2)):
        found = read(pixels, named("gray"))
        assert found.known.all() and np.abs(found.levels.astype(int) - grey).max() <= 1


def test_a_picture_that_is_cold_all_over_is_no_grey():
    for name in ("iron", "inferno"):
        found = read(jpeg(coloured(np.full(SHAPE, 0.002), named(name)), 90, 2), named(name))
        assert found.known.all() and found.levels.max() < 12


def test_a_palette_with_greys_in_it_takes_greys():
    colours = np.concatenate(
        [np.repeat(np.linspace(20, 230, 200)[:, None], 3, 1), np.linspace([230, 230, 230], [255, 40, 0], 56)]
    )
    palette = Palette("grey with hot spots", colours, np.linspace(0, 1, 256))
    levels = 0.7 * scene()
    assert errors(read(coloured(levels, palette), palette), levels).max() < 0.7


@pytest.mark.parametrize("dtype, says", [(np.uint16, "16 bits"), (np.float32, "floating point")])
def test_more_than_eight_bits_are_refused(dtype, says):
    for shape in (SHAPE, (*SHAPE, 3)):
        with pytest.raises(
            SceneError, match=f"image a.png is of {says}, and pseudo-colour has 8 bits.*leave data.palette out"
        ):
            read(np.full(shape, 200, dtype), named("iron"))


# A palette that comes back to its first colours: blue, green, red, blue.
ROUND = Palette(
    "round", np.array([[0, 0, 200], [0, 200, 0], [200, 0, 0], [0, 0, 200]], float), np.array([0, 0.3, 0.7, 1.0])
)


def test_a_palette_that_passes_its_own_colours_says_so(caplog):
    reader = PaletteReader(ROUND)
    assert 0.02 < reader.alike.mean() < 0.2
    assert "% of its levels, between 0 and 100 % of the scale, have colours of other levels" in reader.note()
    levels = reader.read(coloured(0.4 + 0.2 * scene(), ROUND), None, "a.png")
    with caplog.at_level(logging.INFO):
        notes = palette_notes(reader, {"a.png": levels.fit})
    assert "have colours of other levels" in notes["palette"] and notes["palette"] in caplog.text
    assert PaletteReader(named("iron")).note() == "iron"


def test_neighbours_tell_which_of_two_levels_a_colour_is():
    levels = np.tile(np.linspace(0, 0.5, SHAPE[1]), (SHAPE[0], 1))  # cold at the left
    levels[:40] = np.linspace(1.0, 0.5, SHAPE[1])  # hot at the left, in the same blue
    found = read(coloured(levels, ROUND), ROUND)
    blue = (levels < 0.02) | (levels > 0.98)
    assert blue.mean() > 0.02 and found.known[blue].mean() > 0.9
    err = errors(found, levels)
    assert np.mean(err > 2) < 0.01


def test_where_neighbours_tell_nothing_nothing_is_known():
    levels = np.full(SHAPE, 0.5)
    levels[20:70, 30:90] = 0.0  # an island of blue, as far from the surroundings as hot blue is
    found = read(coloured(levels, ROUND), ROUND)
    assert not found.known[30:60, 40:80].any() and found.fit.undecided > 1500
    assert found.known[levels == 0.5].mean() > 0.99
    with pytest.raises(SceneError, match="image a.png: .* % of its pixels have colours that round has at two levels"):
        read(coloured(np.zeros(SHAPE), ROUND), ROUND)


def test_a_palette_of_repeated_colours_is_refused():
    with pytest.raises(SceneError, match="100 % of the levels of flag have colours of other levels"):
        PaletteReader(named("flag"))


def test_threads_share_what_is_known_of_colours():
    reader, pictures = PaletteReader(named("iron")), [jpeg(coloured(scene(i), named("iron")), 80, 2) for i in range(8)]
    with ThreadPoolExecutor(4) as pool:
        shared = list(pool.map(lambda pixels: reader.read(pixels, None, "a.png"), pictures))
    for pixels, found in zip(pictures, shared, strict=True):
        alone = read(pixels, named("iron"))
        np.testing.assert_array_equal(found.levels, alone.levels)
        np.testing.assert_array_equal(found.known, alone.known)


def test_notes_tell_what_is_left_out_and_where_most():
    reader = PaletteReader(named("iron"))
    pixels = coloured(scene(), named("iron"))
    drawn = pixels.copy()
    drawn[:8] = (0, 255, 0)
    pictures = {"a.png": pixels, "b.png": drawn}
    notes = palette_notes(reader, {name: reader.read(p, None, name).fit for name, p in pictures.items()})
    assert notes["palette"] == "iron" and notes["palette_distance"].startswith("0")
    share = 100 * 8 / SHAPE[0]
    assert notes["palette_left_out"].startswith(f"{share / 2:.2g} % of the pixels are in no colour of the palette")
    assert f"at most {share:.2g} % (b.png)" in notes["palette_left_out"]
    assert "palette_left_out" not in palette_notes(reader, {"a.png": reader.read(pixels, None, "a.png").fit})


@pytest.mark.parametrize("true, given", [("iron", "inferno"), ("hot", "jet"), ("gist_heat", "hot"), ("plasma", "iron")])
def test_another_palette_that_fits_much_better_is_told(true, given, caplog):
    levels = np.tile(np.linspace(0.05, 0.75 if given == "jet" else 0.95, 256), (60, 1))  # colours that both nearly have
    pixels = jpeg(coloured(levels, named(true)), 95, 2)
    reader = PaletteReader(named(given))
    found = reader.read(pixels, None, "a.png")
    assert np.median(errors(found, levels)) > 3 and found.known.mean() > 0.5  # wrong, and not seen by the picture alone
    notes = palette_notes(reader, {"a.png": found.fit})
    assert re.search(rf"the images fit the palette (opencv_)?{true} much better", notes["palette_doubted"])
    assert re.search(rf"give data.palette=(opencv_)?{true}, or (opencv_)?{true}_r", caplog.text)
    right = PaletteReader(named(true))
    assert "palette_doubted" not in palette_notes(right, {"a.png": right.read(pixels, None, "a.png").fit})
    assert PaletteReader(named(true)).doubt() == ""  # nothing was read
