"""A span of its own for every image: known temperatures, drawn by it, are read back to half a step of it."""

import logging

import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, names, opengl, viewmats, write_colmap, write_image, write_json

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.assemble import build_scene
from heatsplat.datamodules.bounds import BOUNDS_FILE, BOUNDS_TABLE, Spans, bounds_in, ends_of
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.nerfstudio import Nerfstudio
from heatsplat.datamodules.raw_scene import CELSIUS, RawFrame, RawScene, SceneOptions
from heatsplat.datamodules.rgbt_scenes import RGBTScenes
from heatsplat.datamodules.splits import SplitRule
from heatsplat.datamodules.thermoscenes import ThermoScenes
from heatsplat.doctor.base import material_of
from heatsplat.effects.observations import observe

COUNT = 9
FILES = names(COUNT)


def truth(index):
    """°C [H, W]: a slope, and a warm spot that wanders from image to image."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    spot = np.exp(-((x - 8 - 2 * index) ** 2 + (y - 14) ** 2) / 30.0)
    return 12.0 + 0.2 * x + 0.1 * y + (5.0 + 2.0 * index) * spot


def span(index, cut=0.0):
    """What an automatic range of the camera takes: all of the image but the quantiles ``cut`` at both ends, to a tenth of a
    degree as it writes them."""
    low, high = np.quantile(truth(index), [cut, 1 - cut])
    return round(float(low), 1), round(float(high), 1)


def drawn(index, ends, dtype=np.uint8):
    """The greys that a camera draws of the truth."""
    full = np.iinfo(dtype).max
    return np.rint(np.clip((truth(index) - ends[0]) / (ends[1] - ends[0]), 0, 1) * full).astype(dtype)


def coloured(index, ends, palette="iron"):
    return np.rint(named(palette).curve(256)[drawn(index, ends)]).astype(np.uint8)


def write_spans(folder, spans, files=FILES, head="file,min_c,max_c"):
    rows = [f"{file},{low},{high}" for file, (low, high) in zip(files, spans, strict=True)]
    (folder / BOUNDS_TABLE).write_text("\n".join([head, *rows]) + "\n")


def layout(kind, folder, images):
    """A scene with these thermal images on disk and its loader."""
    if kind == "colmap":
        write_colmap(folder, FILES, pixels=images)
        return Colmap
    if kind == "rgbt_scenes":
        write_colmap(folder, FILES, images=None)
        for i, (file, image) in enumerate(zip(FILES, images, strict=True)):
            write_image(folder / "thermal" / ("train", "test")[i % 4 == 0] / file, image)
        return RGBTScenes
    for file, image in zip(FILES, images, strict=True):
        write_image(folder / "thermal" / file, image)
    frames = [
        {"file_path": f"thermal/{file}", "transform_matrix": opengl(pose)}
        for file, pose in zip(FILES, viewmats(COUNT), strict=True)
    ]
    lens = {"fl_x": 38.0, "fl_y": 40.0, "cx": 20.5, "cy": 15.0, "w": WIDTH, "h": HEIGHT}
    name = "transforms_thermal.json" if kind == "thermoscenes" else "transforms.json"
    write_json(folder / name, {**lens, "frames": frames})
    return ThermoScenes if kind == "thermoscenes" else Nerfstudio


def index_of(view):
    return FILES.index(view.frame.name.rpartition("/")[2])


def check_truth(scene, spans, full, slack=0.0):
    """What is a value is within half a step of the image's own span of the truth, and all that lies within the span is one."""
    for view in [*scene.train, *scene.test]:
        i = index_of(view)
        low, high = spans[i]
        half = 0.5 * (high - low) / full * (1 + slack) + 1e-4
        assert view.mask is None
        counts = np.ones((HEIGHT, WIDTH), bool) if view.known is None else view.known.numpy()
        celsius = scene.thermal_range.to_celsius(view.thermal[..., 0].double().numpy())
        assert np.abs(celsius - truth(i))[counts].max() <= half
        within = (truth(i) > low + 4 * half) & (truth(i) < high - 4 * half)
        assert counts[within].all()
        assert counts.mean() > 0.9


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio", "thermoscenes"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_greys_of_a_span_each_are_the_truth_to_half_a_step(tmp_path, kind, dtype):
    spans = [span(i) for i in range(COUNT)]
    loader = layout(kind, tmp_path, [drawn(i, ends, dtype) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans)
    scene = loader(root=str(tmp_path), **({"random_points": 50} if kind != "colmap" else {})).scene
    full = np.iinfo(dtype).max
    # What rounding the ends to tenths cuts off is less than 0.05 °C, and left out where other images reach farther.
    check_truth(scene, spans, full)
    lows, highs = zip(*spans, strict=True)
    assert scene.thermal_range == ThermalRange(min(lows), max(highs))
    assert scene.notes["bounds_source"].startswith(f"{BOUNDS_TABLE}: each image has a span of its own, ")


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio", "rgbt_scenes"])
def test_false_colours_of_a_span_each_are_the_truth_to_a_step(tmp_path, kind):
    spans = [span(i) for i in range(COUNT)]
    loader = layout(kind, tmp_path, [coloured(i, ends) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans)
    scene = loader(root=str(tmp_path), palette="iron", **({"random_points": 50} if kind == "nerfstudio" else {})).scene
    check_truth(scene, spans, 255, slack=2.0)  # rounded colours tell a level but for one


def test_one_span_in_every_row_is_one_span_for_all(tmp_path):
    """The same bits as bounds for all images: no image reaches beyond what they cut off."""
    images = [drawn(i, (14.0, 25.0)) for i in range(COUNT)]
    write_colmap(tmp_path, FILES, pixels=images)
    bounded = Colmap(root=str(tmp_path), bounds_c=[14.0, 25.0]).scene
    write_spans(tmp_path, [(14.0, 25.0)] * COUNT)
    own = Colmap(root=str(tmp_path)).scene
    assert own.thermal_range == bounded.thermal_range
    for a, b in zip(own.train, bounded.train, strict=True):
        assert torch.equal(a.thermal, b.thermal) and a.mask is None and b.mask is None and a.ends is None


def test_what_the_end_of_a_span_cuts_off_is_a_bound_where_others_reach_farther(tmp_path):
    spans = [span(i, cut=0.02) for i in range(COUNT)]
    write_colmap(tmp_path, FILES, pixels=[drawn(i, ends) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans)
    scene = Colmap(root=str(tmp_path)).scene
    lows, highs = zip(*spans, strict=True)
    for view in [*scene.train, *scene.test]:
        i = index_of(view)
        low, high = spans[i]
        step = (high - low) / 255
        ends = np.zeros((HEIGHT, WIDTH), np.int8) if view.ends is None else view.ends.numpy()
        widest = low == min(lows), high == max(highs)
        for beyond, sign, least in ((truth(i) < low, -1, widest[0]), (truth(i) > high, 1, widest[1])):
            assert beyond.any() and (ends[beyond] == (0 if least else sign)).all()
        assert (ends[(truth(i) > low + 2 * step) & (truth(i) < high - 2 * step)] == 0).all()
        assert view.ends is None or torch.equal(view.known, view.ends == 0)
    assert "lie at an end of their image's span beyond which other images reach" in scene.notes["span_ends"]
    small = Colmap(root=str(tmp_path), downscale=2).scene
    cut = [(truth(index_of(v)) > spans[index_of(v)][1]).reshape(16, 2, 20, 2).any((1, 3)) for v in small.train]
    top = max(highs)
    for view, beyond in zip(small.train, cut, strict=True):
        assert view.ends is None or view.ends.shape == beyond.shape
        assert spans[index_of(view)][1] == top or (view.ends.numpy()[beyond] == 1).all()


def test_noise_is_judged_by_the_steps_of_many_images(tmp_path):
    """The first image has a span ten times as wide as the others, whose steps say how finely noise can be known."""
    spans = [(0.0, 300.0), *[(10.0, 40.0)] * (COUNT - 1)]
    write_colmap(tmp_path, FILES, pixels=[drawn(i, ends) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans)
    scene = Colmap(root=str(tmp_path), split="list", split_file=_listed(tmp_path)).scene
    assert scene.train.frames[0].name == FILES[0]
    step = 30.0 / 255 / 300.0
    for noise in (material_of(scene).noise, observe(scene).noise):
        assert noise < 2.5 * step, noise / step  # by the steps of the first image it would be at least 2.9 of these


def _listed(folder):
    (folder / "test.txt").write_text(FILES[4] + "\n")
    return "test.txt"


def test_other_spellings_of_a_table(tmp_path):
    path = tmp_path / BOUNDS_TABLE
    path.write_text("# of the app\nimage;emissivity;max_c;min_c\na.jpg;0,95;21,5;10,25\nb;0,95;30;-4\n")
    spans = Spans.read(path)
    assert spans.of(["images/A/a.png", "b.png"]) == {
        "images/A/a.png": ThermalRange(10.25, 21.5),
        "b.png": ThermalRange(-4.0, 30.0),
    }
    assert spans.whole() == ThermalRange(-4.0, 30.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,min_c,max_c\na.png,10,10\n", r"line 2: minimum and maximum are both 10.0 °C; bounds must differ"),
        (
            "file,min_c,max_c\na.png,20,10\n",
            r"line 2: the minimum 20.0 °C lies above the maximum 10.0 °C; swap the two",
        ),
        (
            "file,min_c,max_c\na.png,warm,30\n",
            r"line 2: the minimum 'warm' is no number; give the °C of black and white",
        ),
        ("file,min_c,max_c\na.png,10,\n", r"line 2: the maximum '' is no number"),
        ("file,min_c,max_c\na.png,10,nan\n", r"line 2: the maximum 'nan' is nan, a number in °C is needed"),
        ("file,min_c,max_c\na.png,-300,30\n", r"line 2: the minimum '-300' is -300 °C; temperatures lie between"),
        ("file,min_c,max_c\na.png,10,20\na.png,11,20\n", r"line 3: a.png has another span in a line above; keep one"),
        ("file,min_c,max_c\n", r"has no rows; give one for each image, or take the file away"),
        (
            "file,min_f,max_f\na.png,10,20\n",
            r"has no column min_c, max_c; it has file, min_f, max_f. A row for each image",
        ),
        ("frame,min_c,max_c\na.png,10,20\n", r"has no column file with names of images; it has frame, min_c, max_c"),
    ],
)
def test_what_is_no_span_is_refused_by_file_and_line(tmp_path, text, message):
    (tmp_path / BOUNDS_TABLE).write_text(text)
    with pytest.raises(SceneError, match=rf"{BOUNDS_TABLE}.*{message}"):
        Spans.read(tmp_path / BOUNDS_TABLE)


def test_images_without_a_row_and_rows_without_an_image(tmp_path, caplog):
    spans = [span(i) for i in range(COUNT)]
    write_colmap(tmp_path, FILES, pixels=[drawn(i, ends) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans[:-2], FILES[:-2])
    with pytest.raises(
        SceneError, match=f"{BOUNDS_TABLE} has no row for 2 images of 9, such as {FILES[-2]}, {FILES[-1]}; "
    ):
        Colmap(root=str(tmp_path)).setup()
    write_spans(tmp_path, [*spans, (1.0, 900.0)], [*FILES, "frame_100.png"])
    with caplog.at_level(logging.INFO):
        scene = Colmap(root=str(tmp_path)).scene
    assert "1 row of no image that is used, such as frame_100.png" in caplog.text
    assert scene.thermal_range.max_c < 900.0  # a row of no image widens no range
    (tmp_path / BOUNDS_TABLE).write_text("file,min_c,max_c\n" + "".join(f"{n},1,2\nx/{n},1,3\n" for n in FILES))
    with pytest.raises(
        SceneError, match=f"{FILES[0]} and x/{FILES[0]} have different spans and may both be {FILES[0]}"
    ):
        Colmap(root=str(tmp_path)).setup()


def test_what_spans_change_nothing_of(tmp_path):
    write_colmap(tmp_path, FILES, images=None)
    write_spans(tmp_path, [span(i) for i in range(COUNT)])
    for i, name in enumerate(FILES):
        write_image(tmp_path / "raw16" / name, drawn(i, span(i), np.uint16))
    with pytest.raises(
        SceneError, match=f"have a map to °C, of which {BOUNDS_TABLE} changes nothing: take that file away"
    ):
        Colmap(root=str(tmp_path), images="raw16", raw="raw16").setup()
    # A setting goes before, as it does before the other file.
    scene = Colmap(root=str(tmp_path), images="raw16", bounds_c=[0.0, 90.0]).scene
    assert scene.thermal_range == ThermalRange(0.0, 90.0) and scene.notes["bounds_source"] == "data.bounds_c"
    write_json(tmp_path / BOUNDS_FILE, {"absolute_min_temperature": 1, "absolute_max_temperature": 2})
    with pytest.raises(
        SceneError, match=f"has {BOUNDS_FILE}, one span for all images, and {BOUNDS_TABLE}, one for each"
    ):
        Colmap(root=str(tmp_path), images="raw16").setup()


def test_colours_without_a_palette_have_no_spans(tmp_path):
    spans = [span(i) for i in range(COUNT)]
    layout("rgbt_scenes", tmp_path, [coloured(i, ends) for i, ends in enumerate(spans)])
    write_spans(tmp_path, spans)
    scene = RGBTScenes(root=str(tmp_path)).scene
    assert scene.thermal_range is None and scene.train[0].mask is None and scene.train[0].thermal.shape[2] == 3
    assert "each image has" not in scene.notes["bounds_source"]


def test_frames_with_and_without_a_span_are_no_scene():
    lens = Lens(38.0, 40.0, 20.5, 15.0, WIDTH, HEIGHT)
    frames = [
        RawFrame(name, pose, lens, lambda: drawn(0, (0, 50)), span=ThermalRange(0, 50) if i else None)
        for i, (name, pose) in enumerate(zip(FILES, viewmats(COUNT), strict=True))
    ]
    options = SceneOptions(SplitRule("every_8th"))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    with pytest.raises(SceneError, match=f"{FILES[0]} has no span of temperatures, and 8 other images have one"):
        build_scene(RawScene("a", frames, points), options)
    with pytest.raises(SceneError, match="have a map to °C"):
        build_scene(RawScene("a", frames[1:], points, counts=CELSIUS), options)


def test_ends_of_a_span():
    """In 8 bits the last two levels at an end are it, if another image reaches beyond by more than a level."""
    shares = np.array([0, 1, 2, 128, 253, 254, 255]) / np.float32(255)
    one = ThermalRange(10, 20)
    assert ends_of(shares, one, ThermalRange(0, 30)).tolist() == [-1, -1, 0, 0, 0, 1, 1]
    assert ends_of(shares, one, ThermalRange(0, 20)).tolist() == [-1, -1, 0, 0, 0, 0, 0]
    assert ends_of(shares, one, ThermalRange(10, 30)).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert ends_of(shares, one, ThermalRange(9.97, 20.03)).tolist() == [0] * 7


def test_temperatures_that_were_made_of_a_span_each_are_bounds_at_its_ends(tmp_path):
    """As a preparation writes them: °C in floating point, and between which of them the camera drew."""
    spans = [span(i, cut=0.02) for i in range(COUNT)]
    files = names(COUNT, "frame_{:03d}.tiff")
    drawn_c = [np.clip(truth(i), *ends).astype(np.float32) for i, ends in enumerate(spans)]
    write_colmap(tmp_path, files, pixels=drawn_c)
    write_spans(tmp_path, spans, files)
    scene = Colmap(root=str(tmp_path)).scene
    view = next(view for view in scene.train if view.frame.name == files[3])
    assert (view.ends.numpy()[truth(3) > spans[3][1]] == 1).all() and (view.ends == 0).float().mean() > 0.9
    np.testing.assert_allclose(scene.thermal_range.to_celsius(view.thermal[..., 0]), drawn_c[3], atol=1e-4)


def test_no_file_says_nothing(tmp_path):
    assert bounds_in(tmp_path) == (None, None, {})
