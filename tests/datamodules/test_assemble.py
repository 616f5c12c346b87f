import logging

import numpy as np
import pytest
import torch
from layouts import FOCAL, HEIGHT, WIDTH, grey, points, viewmats

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.base import CELSIUS, Counts, RawFrame, RawScene, SceneDataModule, SceneOptions, build_scene
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader
from heatsplat.datamodules.prepared_images import prepare
from heatsplat.datamodules.splits import SplitRule

LENS = Lens(fx=FOCAL, fy=FOCAL + 2, cx=20.5, cy=15.0, width=WIDTH, height=HEIGHT)
EVERY_8TH = SplitRule("every_8th")


def frames_of(images, times=None, lens=LENS, center=(0, 0, 0), **fields):
    return [
        RawFrame(
            name=f"{i:03d}.png",
            viewmat=viewmat,
            lens=lens,
            read=lambda image=image: image,
            time_s=None if times is None else times[i],
            **{key: value[i] for key, value in fields.items()},
        )
        for i, (image, viewmat) in enumerate(zip(images, viewmats(len(images), center), strict=True))
    ]


def assembled(frames, xyz, split=EVERY_8TH, **given):
    options = {
        key: given.pop(key) for key in ("downscale", "thermal_channels", "alpha_mask", "palette") if key in given
    }
    return build_scene(RawScene("s", frames, xyz, **given), SceneOptions(split, **options))


def scene_of(images, frames=None, center=(0, 0, 0), times=None, **given):
    return assembled(frames or frames_of(images, times, center=center), points(center=center), **given)


def test_time_starts_at_the_first_training_frame_and_frames_are_in_time_order():
    images = [grey(i) for i in range(10)]
    times = [1.7e9 + 0.125 * (10 - i) for i in range(10)]  # recorded backwards with respect to names
    scene = scene_of(images, times=times)
    # string order holds out 000 and 008; 009 is the earliest and a training frame
    assert [f.name for f in scene.train.frames][:2] == ["009.png", "007.png"]
    assert scene.train.times_s == [0.0, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0]
    assert scene.test.times_s == [0.125, 1.125]
    assert [f.frame_id for f in scene.test.frames] == [1, 9]
    assert scene.notes["duration_s"] == 1.125 and scene.notes["clock_at_zero_s"] == times[9]
    assert "time" in scene.metadata


def test_a_test_frame_before_the_first_training_frame_has_negative_time():
    scene = scene_of([grey(i) for i in range(9)], times=[10.0 + i for i in range(9)])
    assert scene.test.times_s == [-1.0, 7.0]
    assert scene.train.times_s[0] == 0.0 and "clock_at_zero_s" not in scene.notes  # no seconds since 1970


def test_without_times_there_are_none():
    scene = scene_of([grey(i) for i in range(9)])
    assert set(scene.train.times_s) == {None}
    assert "time" not in scene.metadata
    assert scene.notes["time"].startswith("none")


def test_times_of_some_frames_only_are_not_used(caplog):
    scene = scene_of([grey(i) for i in range(9)], times=[0.0, None, *range(2, 9)])
    assert set(scene.train.times_s) == {None}
    assert "8 of 9 frames have a time, 001.png has not, so none is used" in scene.notes["time"]
    assert scene.notes["time"] in caplog.text


def test_duplicate_times_are_kept_and_noted(caplog):
    with caplog.at_level(logging.WARNING):
        scene = scene_of([grey(i) for i in range(9)], times=[0, 0, 0, 1, 2, 3, 4, 5, 6])
    assert len(scene.train) + len(scene.test) == 9
    assert scene.notes["duplicate_times"].startswith("2 frames with the time")
    assert "2 frames with the time" in caplog.text


def test_a_time_that_is_not_finite_names_its_frame():
    with pytest.raises(SceneError, match=r"frame 003.png has a time that is no finite number"):
        scene_of([grey(i) for i in range(9)], times=[0, 1, 2, float("inf"), 4, 5, 6, 7, 8])


@pytest.mark.parametrize(
    ("count", "told"),
    [
        (1e3, "; divide milliseconds since 1970 by 1,000$"),
        (1e6, "; divide microseconds since 1970 by 1,000,000$"),
        (1e9, "; divide nanoseconds since 1970 by 1,000,000,000$"),
        (1e12, r"\d$"),
    ],
)
def test_times_that_count_less_than_seconds_are_refused(count, told):
    """A flight of ten minutes would take a week, and surfaces would relax as slowly."""
    with pytest.raises(SceneError, match=rf"000.png has a time that .* absurdly large: .*{told}"):
        scene_of([grey(i) for i in range(9)], times=[count * (1.72e9 + i) for i in range(9)])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_span_their_type(dtype):
    images = [grey(i, dtype) for i in range(9)]
    scene = scene_of(images, thermal_range=ThermalRange(10, 40))
    view = scene.train[0]
    assert view.thermal.shape == (HEIGHT, WIDTH, 1) and view.thermal.dtype == torch.float32
    expected = images[1].astype(np.float64) / np.iinfo(dtype).max
    np.testing.assert_allclose(view.thermal[..., 0], expected, atol=1e-7)
    np.testing.assert_allclose(scene.thermal_range.to_celsius(view.thermal[..., 0]), 10 + 30 * expected, atol=1e-5)
    assert view.mask is None and view.rgb is None


def test_counts_become_celsius_exactly():
    counts = [np.random.default_rng(i).integers(19000, 20500, (HEIGHT, WIDTH)).astype(np.uint16) for i in range(9)]
    scene = scene_of(counts, counts=Counts(1 / 64, -273.15), thermal_range=ThermalRange(20, 50))
    celsius = scene.thermal_range.to_celsius(scene.train[3].thermal[..., 0].double())
    np.testing.assert_allclose(celsius, counts[4] / 64 - 273.15, atol=5e-6)
    assert scene.notes["clipped_fraction"] == 0


def test_counts_without_bounds_take_those_of_the_training_images():
    counts = [np.linspace(1000, 2000, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint16) for _ in range(9)]
    counts[0][:] = 60000  # a test frame, which must not set the range
    scene = scene_of(counts, counts=Counts(0.1, -50.0))
    assert scene.thermal_range.min_c == pytest.approx(49.0) and scene.thermal_range.max_c == pytest.approx(151.0)
    assert scene.notes["bounds_source"].startswith("minimum and maximum of the training images")
    assert scene.notes["training_images_c"] == pytest.approx([50.0, 150.0])
    assert scene.notes["clipped_fraction"] == pytest.approx(1 / 9)
    assert scene.test[0].thermal.max() == 1


def test_a_few_hot_pixels_are_within_the_bounds_of_training_images(caplog):
    rng = np.random.default_rng(0)
    images = [rng.uniform(12.0, 30.0, (HEIGHT, WIDTH)).astype(np.float32) for _ in range(9)]
    images[3][10, 12] = 90.0  # one pixel of one image
    with caplog.at_level(logging.WARNING):
        scene = scene_of(images)
    shown = scene.thermal_range.to_celsius(scene.train[2].thermal[..., 0])
    np.testing.assert_allclose(shown, images[3], atol=1e-4)
    assert 90.0 < scene.thermal_range.max_c < 91.0 and scene.notes["clipped_fraction"] == 0
    assert "cut off" not in caplog.text


def test_what_masks_leave_out_is_not_cut_off():
    """A sky far colder than all that counts, beyond the bounds that this sets."""
    images = [20 + grey(i).astype(np.float32) / 10 for i in range(9)]
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[: HEIGHT // 2] = True
    for image in images:
        image[sky] = -40.0
    scene = scene_of(images, frames_of(images, read_mask=[lambda: ~sky] * 9))
    assert scene.thermal_range.min_c > 15 and scene.notes["clipped_fraction"] < 0.01  # held-out images go on a little


def test_dead_pixels_and_counts_of_absolute_zero_set_no_bounds_and_are_warned_of(caplog):
    rng = np.random.default_rng(0)
    images = [(rng.uniform(19000, 19500, (HEIGHT, WIDTH))).astype(np.uint16) for _ in range(9)]
    for image in images:
        image[10, 12] = 40000
    images[4][3, 4] = 0
    with caplog.at_level(logging.WARNING):
        scene = scene_of(images, counts=Counts(1 / 64, -273.15))
    low, high = 19000 / 64 - 273.15, 19500 / 64 - 273.15
    assert low - 0.2 < scene.thermal_range.min_c < low + 0.2 and high - 0.2 < scene.thermal_range.max_c < high + 0.2
    assert scene.notes["training_images_c"] == pytest.approx([-273.15, 40000 / 64 - 273.15])
    assert "10 pixels of -273.1 .. 351.9 °C are cut off" in caplog.text and "data.bounds_c" in caplog.text


def test_bounds_that_leave_next_to_nothing_of_the_images_are_refused():
    images = [12 + grey(i).astype(np.float32) / 10 for i in range(9)]
    said = r"100 % of the pixels .* beyond the bounds 293 .. 323 °C; the images show 12\b.* °C.*data.bounds_c"
    with pytest.raises(SceneError, match=said):
        scene_of(images, thermal_range=ThermalRange(293, 323))
    assert scene_of(images, thermal_range=ThermalRange(20, 22)).notes["clipped_fraction"] > 0.8


def test_constant_images_have_no_range_of_their_own():
    with pytest.raises(SceneError, match=r"training images are constant \(7 °C\).* Else give data.bounds_c"):
        scene_of([np.full((HEIGHT, WIDTH), 7, np.uint16)] * 9, counts=Counts(1.0, 0.0))


def test_float_images_are_celsius_and_gaps_are_masked(caplog):
    images = [20 + grey(i).astype(np.float32) / 20 for i in range(9)]
    images[2][4, 5] = np.nan
    with caplog.at_level(logging.WARNING):
        scene = scene_of(images, thermal_range=ThermalRange(20, 40))
    view = scene.train[1]
    assert not view.mask[4, 5] and int((~view.mask).sum()) == 1
    assert torch.isfinite(view.thermal).all()
    expected = np.delete(images[2].ravel(), 4 * WIDTH + 5)
    got = scene.thermal_range.to_celsius(view.thermal[..., 0][view.mask])
    np.testing.assert_allclose(got, expected, atol=1e-5)
    assert scene.notes["nan_pixels"].startswith("1 pixel masked")
    assert "1 pixel masked: NaN" in caplog.text


def test_a_gap_does_not_spread_when_images_shrink():
    images = [20 + grey(i).astype(np.float32) / 20 for i in range(9)]
    images[2][4, 5] = np.nan
    view = scene_of(images, thermal_range=ThermalRange(20, 40), downscale=2).train[1]
    assert torch.isfinite(view.thermal).all()
    assert (~view.mask).nonzero().tolist() == [[2, 2]]


def test_an_image_of_gaps_only_is_refused():
    images = [20 + grey(i).astype(np.float32) for i in range(9)]
    images[5][:] = np.nan
    with pytest.raises(SceneError, match="005.png holds no finite pixel"):
        scene_of(images)


def test_float_and_integer_images_do_not_mix():
    with pytest.raises(SceneError, match="mixes float images"):
        scene_of([grey(0).astype(np.float32), *(grey(i) for i in range(1, 9))], counts=CELSIUS)


@pytest.mark.parametrize("downscale", [1.5, 2, 3])
def test_intrinsics_follow_the_pixels_that_are_there(downscale):
    """A linear picture keeps its values at the same viewing directions, to the rounding of the pixel count."""
    y, x = np.mgrid[:33, :41]
    image = (300 * (x + 0.5) + 200 * (y + 0.5)).astype(np.uint16)
    lens = Lens(fx=80, fy=90, cx=42, cy=30, width=82, height=66)  # written down for an image of twice the size
    scene = scene_of(None, frames=frames_of([image] * 9, lens=lens), downscale=downscale)
    view = scene.train[0]
    width, height = round(41 / downscale), round(33 / downscale)
    assert view.thermal.shape == (height, width, 1)
    assert (view.camera.width, view.camera.height) == (width, height)
    v, u = np.mgrid[:height, :width] + 0.5
    K = view.camera.K.numpy()
    ray_x, ray_y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    stored_x, stored_y = (ray_x * 80 + 42) / 2, (ray_y * 90 + 30) / 2
    expected = 300 * stored_x + 200 * stored_y
    inner = (slice(1, -1), slice(1, -1))
    # 0.1 stored pixels: an area filter shifts by so much where it cuts through pixels; half a pixel would be 250
    np.testing.assert_allclose(view.thermal[..., 0].numpy()[inner] * 65535, expected[inner], atol=50)
    assert "intrinsics_rescaled" in scene.notes
    assert scene.notes["grid"] == f"{width}x{height}"


def test_images_of_which_next_to_nothing_is_left_are_warned_of(caplog):
    scene_of([grey(i) for i in range(9)], downscale=2)
    assert not caplog.text
    scene_of([grey(i) for i in range(9)], downscale=100)
    assert "data.downscale=100 leaves images of 1x1 pixels" in caplog.text


def test_enlarging_is_refused():
    with pytest.raises(SceneError, match="data.downscale must be 1 or larger, got 0.5"):
        scene_of([grey(i) for i in range(9)], downscale=0.5)


def test_distorted_frames_are_undistorted_once_and_masked():
    lens = Lens(FOCAL, FOCAL, 20.0, 16.0, WIDTH, HEIGHT, (0.3, 0, 0, 0, 0, 0, 0, 0), model="RADIAL")
    scene = scene_of(None, frames=frames_of([grey(i, np.uint16) for i in range(9)], lens=lens))
    view = scene.train[0]
    assert scene.notes["distortion"].startswith("9 images undistorted")
    assert view.mask is not None and not view.mask[0, 0]
    assert scene.notes["masked_fraction"] > 0
    # The centre does not move, and a point right of it is drawn from further right.
    expected = grey(1, np.uint16)[16, 30:33].astype(float).mean() / 65535
    assert view.thermal[16, 30, 0] > grey(1, np.uint16)[16, 30] / 65535
    assert view.thermal[16, 30, 0] < expected * 1.2
    assert view.thermal[16, 20, 0] == pytest.approx(grey(1, np.uint16)[16, 20] / 65535, rel=1e-2)


def project(camera, xyz):
    cam = camera.viewmat[:3, :3] @ xyz.double().T + camera.viewmat[:3, 3:]
    pix = camera.K @ cam
    return (pix[:2] / pix[2]).T


def test_utm_coordinates_are_recentred_before_float32():
    utm = np.array([651234.25, 5683456.5, 30.0])
    images = [grey(i) for i in range(9)]
    seen = []
    small = scene_of(images, probes=points()[:3], truth=lambda where, when: where[:, :1].double() + when)
    large = scene_of(
        images,
        center=utm,
        probes=points(center=utm)[:3],
        truth=lambda where, when: seen.append(where) or where[:, :1].double() + when,
    )
    origin = torch.tensor(large.notes["origin"], dtype=torch.float64)
    assert (origin - torch.from_numpy(utm)).norm() < 10
    assert "recentred" in large.notes and "recentred" not in small.notes
    assert large.points.dtype == torch.float32 and large.points.norm(dim=1).max() < 20
    for a, b in zip(small.train.frames, large.train.frames, strict=True):
        # float64 holds UTM to 1e-9; the pixel positions would be off by tens of pixels in float32
        assert (project(a.camera, small.points) - project(b.camera, large.points)).abs().max() < 1e-4
    assert large.extent == pytest.approx(small.extent, rel=1e-6)
    assert (large.probes.double() + origin - torch.from_numpy(points(center=utm)[:3])).abs().max() < 1e-5
    large.truth(large.probes.double(), torch.zeros(2))
    assert (seen[0] - torch.from_numpy(points(center=utm)[:3])).abs().max() < 1e-5


def test_truth_is_asked_in_the_scene_s_own_clock_and_world():
    images = [grey(i) for i in range(9)]
    scene = scene_of(images, times=[100.0 + i for i in range(9)], truth=lambda where, when: when[None].expand(2, -1))
    result = scene.truth(torch.zeros(2, 3), torch.tensor([0.0, 5.0], dtype=torch.float64))
    assert result.tolist() == [[101.0, 106.0]] * 2  # 100 is the first test frame, 101 the first training frame


@pytest.mark.parametrize("count", [0, 3])
def test_fewer_than_four_points_are_refused(count):
    with pytest.raises(SceneError, match=f"scene s has {count} finite points, at least 4"):
        assembled(frames_of([grey(i) for i in range(9)]), points()[:count])


def test_points_that_are_not_finite_are_dropped():
    xyz, colors = points(10), np.linspace(0, 1, 30).reshape(10, 3)
    xyz[2, 1], xyz[5, 0] = np.nan, np.inf
    scene = assembled(frames_of([grey(i) for i in range(9)]), xyz, point_colors=colors)
    assert scene.points.shape == (8, 3) and scene.point_colors.shape == (8, 3)
    np.testing.assert_allclose(scene.point_colors[2], colors[3], atol=1e-6)
    assert scene.notes["points_dropped"].startswith("2 points")


def test_val_views_are_some_test_views():
    images = [grey(i) for i in range(160)]
    scene = scene_of(images)
    assert len(scene.test) == 20 and len(scene.val) == 8
    assert {f.frame_id for f in scene.val.frames} < {f.frame_id for f in scene.test.frames}
    assert scene.val.frames[0] is scene.test.frames[0] and scene.val.frames[-1] is scene.test.frames[-1]
    assert "select nothing" in scene.notes["val_views"]


def test_grey_stored_as_rgb_or_rgba_is_grey():
    images = [grey(i) for i in range(9)]
    rgb = [np.repeat(i[..., None], 3, axis=2) for i in images]
    rgba = [np.dstack([i, np.full(i.shape[:2], 255, np.uint8)]) for i in rgb]
    bounds = ThermalRange(0, 1)
    views = [scene_of(stored, thermal_range=bounds).train[4].thermal for stored in (images, rgb, rgba)]
    assert torch.equal(views[0], views[1]) and torch.equal(views[0], views[2])


def test_alpha_masks_only_when_asked():
    images = [np.dstack([np.repeat(grey(i)[..., None], 3, axis=2), np.full((HEIGHT, WIDTH), 255)]) for i in range(9)]
    images = [i.astype(np.uint8) for i in images]
    images[1][:5, :, 3] = 0
    assert scene_of(images).train[0].mask is None
    masked = scene_of(images, alpha_mask=True)
    assert not masked.train[0].mask[:5].any() and masked.train[0].mask[5:].all()
    assert masked.train[1].mask is None


def pseudo_colour(index):
    import cv2

    return np.ascontiguousarray(cv2.applyColorMap(grey(index), cv2.COLORMAP_INFERNO)[..., ::-1])


def test_pseudo_colour_is_no_temperature(caplog):
    images = [pseudo_colour(i) for i in range(9)]
    with pytest.raises(
        SceneError, match=r"image 0\d\d.png of scene s is pseudo-colour.*data.palette=iron.*data.thermal_channels=3"
    ):
        scene_of(images, thermal_range=ThermalRange(0, 1))
    colour = scene_of(images, thermal_range=ThermalRange(0, 1), thermal_channels=3)
    assert colour.thermal_range is None and "bounds_ignored" in colour.notes
    np.testing.assert_allclose(colour.train[0].thermal, images[1] / 255.0, atol=1e-6)
    assert "pseudo-colour" not in caplog.text
    luma = scene_of(images)
    assert luma.train[0].thermal.shape == (HEIGHT, WIDTH, 1)
    assert "luma" in luma.notes["pseudo_colour"]
    assert "9 images in pseudo-colour" in caplog.text and "data.thermal_channels=3" in caplog.text
    assert "data.palette=iron" in caplog.text


def palette_reader(name="opencv_inferno"):
    return PaletteReader(named(name))


def test_a_palette_makes_of_colours_the_temperatures_that_greys_have(caplog):
    bounds = ThermalRange(-10, 41)
    greys = scene_of([grey(i) for i in range(9)], thermal_range=bounds)
    with caplog.at_level(logging.WARNING):
        scene = scene_of([pseudo_colour(i) for i in range(9)], thermal_range=bounds, palette=palette_reader())
    assert not caplog.records
    assert scene.thermal_range == bounds and scene.notes["thermal_range_c"] == greys.notes["thermal_range_c"]
    assert scene.notes["palette"] == "opencv_inferno" and "palette_left_out" not in scene.notes
    assert "pseudo_colour" not in scene.notes
    for views, others in ((scene.train, greys.train), (scene.test, greys.test)):
        for i in range(len(views)):
            assert views[i].mask is None and views[i].thermal.shape == (HEIGHT, WIDTH, 1)
            assert torch.abs(views[i].thermal - others[i].thermal).max() <= 1.01 / 255
    assert scene_of([pseudo_colour(i) for i in range(9)], palette=palette_reader()).thermal_range is None


def test_levels_are_kept_as_eight_bit_greys_are():
    frame = frames_of([pseudo_colour(3)])[0]
    found = prepare(frame, SceneOptions(EVERY_8TH, palette=palette_reader()))
    assert found.thermal.dtype == np.uint8 and found.thermal.shape == (HEIGHT, WIDTH)
    assert found.thermal.flags["C_CONTIGUOUS"] and found.colour == 0.0


def test_levels_are_averaged_and_not_colours():
    levels = np.tile(np.uint8([[40, 220], [220, 40]]), (HEIGHT // 2, WIDTH // 2))
    colours = np.rint(named("jet").curve(256)[levels]).astype(np.uint8)
    images = [colours if i == 1 else np.rint(named("jet").curve(256)[grey(i)]).astype(np.uint8) for i in range(9)]
    view = scene_of(images, palette=palette_reader("jet"), downscale=2).train[0]
    assert view.mask is None
    np.testing.assert_allclose(255 * view.thermal, 130, atol=1.5)
    averaged = colours.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert averaged[0, 0, 2] > 100 and averaged[0, 0, 0] > 100  # a violet that the palette has not


def drawn_over(index):
    pixels = pseudo_colour(index)
    pixels[4:12, 6:30] = (0, 255, 0)
    return pixels


def test_what_is_drawn_over_pictures_is_masked_beside_masks_of_ones_own(caplog):
    own = np.ones((HEIGHT, WIDTH), bool)
    own[:, 30:] = False
    frames = frames_of([drawn_over(i) for i in range(9)], read_mask=[lambda: own] * 9)
    with caplog.at_level(logging.INFO):
        scene = scene_of(None, frames=frames, palette=palette_reader(), thermal_range=ThermalRange(0, 10))
    expected = own.copy()
    expected[4:12, 6:30] = False
    for view in (scene.train[2], scene.test[0]):
        np.testing.assert_array_equal(view.mask, expected)
    share = 100 * (8 * 24) / (HEIGHT * WIDTH)
    assert f"{share:.2g} % of the pixels are in no colour of the palette" in scene.notes["palette_left_out"]
    assert scene.notes["palette_left_out"] in caplog.text
    assert scene.notes["masked_fraction"] == pytest.approx(1 - expected.mean())
    small = scene_of(None, frames=frames, palette=palette_reader(), downscale=4).train[0]
    assert not small.mask[1:3, 2:7].any() and not small.mask[:, 7].any() and small.mask[3:, :7].all()


def test_transparency_and_palettes_go_together():
    images = [np.dstack([pseudo_colour(i), np.full((HEIGHT, WIDTH), 255, np.uint8)]) for i in range(9)]
    for image in images:
        image[:5, :, 3] = 0
    assert scene_of(images, palette=palette_reader()).train[0].mask is None
    for image in images:
        image[:5, :, :3] = (0, 255, 0)  # of what is transparent colours tell nothing
    mask = scene_of(images, palette=palette_reader(), alpha_mask=True).train[0].mask
    assert not mask[:5].any() and mask[5:].all()


def test_palettes_are_refused_where_there_is_no_pseudo_colour():
    for images, says in (
        ([grey(i) for i in range(9)], r"image 00.\.png is grey"),
        ([np.repeat(grey(i)[..., None], 3, axis=2) for i in range(9)], r"image 00.\.png is grey"),
        ([grey(i, np.uint16) for i in range(9)], r"image 00.\.png is of 16 bits"),
        ([grey(i).astype(np.float32) for i in range(9)], r"image 00.\.png is of floating point"),
    ):
        with pytest.raises(SceneError, match=says):
            scene_of(images, palette=palette_reader())
    with pytest.raises(SceneError, match="data.palette makes one channel .* data.thermal_channels=3 keeps them"):
        scene_of([pseudo_colour(i) for i in range(9)], palette=palette_reader(), thermal_channels=3)
    photos = [
        RawFrame(f"{i}.png", viewmat, LENS, read=None, read_rgb=lambda: pseudo_colour(0))
        for i, viewmat in enumerate(viewmats(9))
    ]
    with pytest.raises(SceneError, match="data.palette is of thermal images, and the scene has photos alone"):
        assembled(photos, points(), palette=palette_reader())


def test_one_picture_in_another_palette_is_named():
    images = [pseudo_colour(i) for i in range(9)]
    images[5] = np.rint(named("jet").curve(256)[grey(5)]).astype(np.uint8)
    with pytest.raises(SceneError, match="image 005.png is not in the colours of opencv_inferno: .* jet fits"):
        scene_of(images, palette=palette_reader())


def test_grey_images_fill_three_channels():
    view = scene_of([grey(i) for i in range(9)], thermal_channels=3).train[0]
    assert view.thermal.shape == (HEIGHT, WIDTH, 3)
    assert torch.equal(view.thermal[..., 0], view.thermal[..., 2])


def test_visible_images_share_the_thermal_grid():
    rgb = [np.full((HEIGHT * 2, WIDTH * 2, 3), (10 * i, 20, 30), np.uint8) for i in range(9)]
    frames = frames_of([grey(i) for i in range(9)], read_rgb=[lambda image=image: image for image in rgb])
    scene = scene_of(None, frames=frames, downscale=2)
    view = scene.train[2]
    assert view.rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
    np.testing.assert_allclose(view.rgb[0, 0] * 255, [30, 20, 30], atol=1e-4)
    assert scene.notes["rgb_resized"].startswith("9 visible")


@pytest.mark.parametrize(
    ("sides", "told"), [((WIDTH * 2, HEIGHT * 2), False), ((HEIGHT, WIDTH), True), ((48, 32), True)]
)
def test_visible_images_of_another_shape_are_told(caplog, sides, told):
    rgb = np.zeros((sides[1], sides[0], 3), np.uint8)
    frames = frames_of([grey(i) for i in range(9)], read_rgb=[lambda: rgb] * 9)
    scene = scene_of(None, frames=frames)
    assert ("9 visible images have another shape than the thermal ones" in caplog.text) is told
    assert ("9 of which have another shape" in scene.notes["rgb_resized"]) is told


@pytest.mark.parametrize("image", [grey(0), grey(0).astype(np.float32)])
def test_masks_that_are_the_wrong_way_round_are_told(caplog, image):
    few, none = np.zeros((2, HEIGHT, WIDTH), bool)
    few[3:6, 3:9] = True
    scene_of(None, frames_of([image] * 9, read_mask=[lambda: ~few] * 9))
    assert not caplog.text
    scene_of(None, frames_of([image] * 9, read_mask=[lambda: few] * 9))
    assert "masks or transparency leave out 98.59 % of all pixels; data.mask_keep is white where" in caplog.text
    with pytest.raises(SceneError, match="leave out all pixels of all images; data.mask_keep"):
        scene_of(None, frames_of([image] * 9, read_mask=[lambda: none] * 9))


def test_masks_must_fit_the_image():
    frames = frames_of([grey(i) for i in range(9)], read_mask=[lambda: np.ones((3, 3), bool)] * 9)
    with pytest.raises(SceneError, match=f"mask of 0...png is 3x3 but the image is {WIDTH}x{HEIGHT}"):
        scene_of(None, frames=frames)


def test_pixels_stay_in_their_stored_type():
    scene = scene_of([grey(i, np.uint16) for i in range(9)], downscale=2)
    assert scene.notes["pixel_type"] == "uint16" and scene.notes["channels"] == "L"
    first, again = scene.train[0], scene.train[0]
    assert first.thermal.data_ptr() != again.thermal.data_ptr()  # decoded when asked for, not kept
    assert torch.equal(first.thermal, again.thermal)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 5), np.int32), np.zeros((4, 5, 2), np.uint8), np.zeros((0, 5), np.uint8)]
)
def test_other_pixels_name_their_image(image):
    with pytest.raises(SceneError, match=r"image 0\d\d.png is .*; images are \[H, W\]"):
        scene_of([image] * 9)


def test_doubles_are_celsius_too():
    scene = scene_of([20.0 + grey(i) / 20 for i in range(9)], thermal_range=ThermalRange(20, 40))
    assert scene.notes["pixel_type"] == "float32"
    celsius = scene.thermal_range.to_celsius(scene.train[0].thermal[..., 0])
    np.testing.assert_allclose(celsius, 20 + grey(1) / 20, atol=1e-5)


def test_an_empty_scene_and_unknown_channels_are_refused():
    with pytest.raises(SceneError, match="scene s has no frames"):
        assembled([], points())
    with pytest.raises(SceneError, match="data.thermal_channels must be 1 or 3, got 2"):
        scene_of([grey(i) for i in range(9)], thermal_channels=2)


def test_the_package_of_a_scene_from_memory_needs_no_file():
    scene = scene_of([grey(i) for i in range(9)], ambient_c=20.0, metres_per_unit=1.0, notes={"made": "up"})
    assert scene.notes["made"] == "up"
    assert {"ambient", "metres"} <= scene.metadata
    assert scene.point_colors is None


@pytest.mark.parametrize(
    ("xyz", "told"),
    [
        (points().T, r"points of scene s must be \[P, 3\], got \[3, \d+\]"),
        (points().ravel(), r"points of scene s must be \[P, 3\], got \[\d+\]"),
        (None, "scene s has no points: give points"),
    ],
)
def test_points_that_are_no_rows_of_three_are_refused(xyz, told):
    with pytest.raises(SceneError, match=told):
        assembled(frames_of([grey(i) for i in range(9)]), xyz)


def test_a_loader_that_returns_no_scene_is_named():
    class Forgetful(SceneDataModule):
        def load(self):
            assembled(frames_of([grey(i) for i in range(9)]), points())

    with pytest.raises(SceneError, match="Forgetful.load returned NoneType; it must return a SceneData"):
        Forgetful().setup()
