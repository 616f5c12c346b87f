"""Damaged and impossible files: each is refused by name, and none is believed."""

import json

import cv2
import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, grey, names, viewmats, write_colmap, write_image, write_json, write_thermoscenes

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.formats.colmap_records import check_records
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.poses import checked_pose
from heatsplat.datamodules.raw_scene import Counts, RawFrame
from heatsplat.datamodules.splits import by_list
from heatsplat.datamodules.thermoscenes import ThermoScenes
from heatsplat.datamodules.timestamps import dji_time, times_from_csv
from heatsplat.datamodules.weather import read_weather

STEMS = [f"frame_train_{i:05d}" for i in range(1, 7)] + [f"frame_eval_{i:05d}" for i in range(1, 3)]


def colmap(root, **options):
    return Colmap(root=str(root), **options).scene


# Sparse models --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["cameras", "images", "points3D", "rigs", "frames"])
def test_no_cut_of_a_binary_model_is_believed(tmp_path, part):
    """At every length: COLMAP's own reader goes on behind the end, for ever or with numbers from memory."""
    file = find_model(write_colmap(tmp_path, names(9))) / f"{part}.bin"
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(SceneError, match=rf"{part}.bin is (cut short|empty)"):
            check_records(file.parent, "bin")
    file.write_bytes(whole + b"\0")
    with pytest.raises(
        SceneError, match=rf"{part}.bin is damaged: .* are {len(whole)} bytes, the file has {len(whole) + 1}"
    ):
        read_model(tmp_path)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D", "rigs", "frames"])
def test_no_cut_of_a_text_model_is_believed(tmp_path, part):
    file = find_model(write_colmap(tmp_path, names(9), text=True)) / f"{part}.txt"
    whole = file.read_bytes()
    first = whole.index(b"\n", whole.rindex(b"# Number of"))
    # The last line of images.txt is an empty one, whose absence changes nothing.
    for length in range(first, len(whole) - (part == "images")):
        file.write_bytes(whole[:length])
        with pytest.raises(SceneError, match=rf"{part}.txt(, line \d+:| announces \d+ records and has)"):
            check_records(file.parent, "txt")


@pytest.mark.parametrize(
    ("part", "old", "new", "message"),
    [
        ("cameras", "15\n", "\n", "line 4: camera model PINHOLE with 3 parameters"),
        ("images", " frame_003.png", "", "line 11: an image is IMAGE_ID QW"),
        (
            "images",
            "frame_003.png\n\n",
            "frame_003.png\n1.5 2.5\n",
            "line 12: points of an image are numbers X Y POINT3D_ID",
        ),
        ("points3D", " 128 128 128 -1 \n2 ", " 128 128 \n2 ", "line 4: a point is POINT3D_ID X Y Z"),
        ("points3D", "0.0118", "nan0.0", "line 4: a point is"),
    ],
)
def test_a_damaged_line_is_named(tmp_path, part, old, new, message):
    file = find_model(write_colmap(tmp_path, names(9), text=True)) / f"{part}.txt"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(SceneError, match=rf"{part}.txt, {message}"):
        read_model(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_names_that_are_no_text_and_unknown_cameras_are_refused(tmp_path, text):
    folder = find_model(write_colmap(tmp_path, names(9), text=text))
    images, cameras = (folder / f"{part}.{'txt' if text else 'bin'}" for part in ("images", "cameras"))
    whole = images.read_bytes()
    images.write_bytes(whole.replace(b"frame_003", b"frame\xff003"))
    with pytest.raises(SceneError, match="sparse model, images: .* is no file name in UTF-8"):
        read_model(tmp_path)
    images.write_bytes(whole)
    if not text:
        cameras.write_bytes(cameras.read_bytes()[:12] + b"\x63" + cameras.read_bytes()[13:])
        with pytest.raises(SceneError, match="cameras.bin: number 99 is no camera model that COLMAP knows"):
            read_model(tmp_path)


# Poses, lenses, temperatures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors the world"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "scaled or sheared"),
        (np.eye(4) + 0.01 * np.eye(4, k=1), "scaled or sheared"),
        (np.full((4, 4), np.nan), "NaN, infinite"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
    ],
)
def test_what_is_no_pose_is_refused_with_its_frame(tmp_path, change, message):
    write_thermoscenes(tmp_path, STEMS)
    path = tmp_path / "transforms_thermal.json"
    values = json.loads(path.read_text())
    values["frames"][2]["transform_matrix"] = (np.array(values["frames"][2]["transform_matrix"]) @ change).tolist()
    write_json(path, values)
    with pytest.raises(
        SceneError, match=f"transforms_thermal.json: transform_matrix of images/{STEMS[2]}.JPG .*{message}"
    ):
        ThermoScenes(root=str(tmp_path)).setup()
    with pytest.raises(SceneError, match=f"viewmat of frame a .*{message}"):
        RawFrame("a", viewmats(1)[0] @ change, None, None)


def test_a_transposed_pose_is_said_to_be_one():
    with pytest.raises(SceneError, match="frame 7 is no pose: its last row is .*, not 0 0 0 1; it is transposed"):
        checked_pose(viewmats(1)[0].T, "frame 7")


def test_poses_may_be_tensors():
    frame = RawFrame("a", torch.from_numpy(viewmats(1)[0]), None, None)
    assert isinstance(frame.viewmat, np.ndarray) and np.array_equal(frame.viewmat, viewmats(1)[0])


@pytest.mark.parametrize("pose", [[[1, 0], [0]], "pose", None, [[1.0] * 4] * 2, {"a": 1}])
def test_ragged_poses_are_refused(pose):
    with pytest.raises(SceneError, match="frame 7 is no pose"):
        checked_pose(pose, "frame 7")


def test_rotations_of_four_digits_are_poses():
    pose = np.round(viewmats(5)[1], 4)
    assert np.array_equal(checked_pose(pose, "frame"), pose)


@pytest.mark.parametrize("key", ["fl_x", "cx", "k1", "w", "camera_angle_x"])
@pytest.mark.parametrize("value", ["wide", None, [1], float("nan"), 1e300])
def test_impossible_lenses_are_refused(tmp_path, key, value):
    write_thermoscenes(tmp_path, STEMS)
    path = tmp_path / "transforms_thermal.json"
    values = json.loads(path.read_text())
    if key == "camera_angle_x":
        del values["fl_x"]
    write_json(path, {**values, key: value})
    if (key, value) == ("k1", 1e300):
        return  # a polynomial has no bound; all its pixels fall outside the image
    with pytest.raises(
        SceneError, match=rf"transforms_thermal.json, .*: {key} is|camera .* (must lie between|impossible)"
    ):
        ThermoScenes(root=str(tmp_path)).setup()


@pytest.mark.parametrize("numbers", [(1e9, 30, 20, 16), (30, 1e-9, 20, 16), (30, 30, 1e9, 16), (30, 30, 20, -1e9)])
def test_focal_lengths_and_centres_far_out_of_the_image_are_refused(numbers):
    with pytest.raises(SceneError, match="impossible parameters"):
        Lens(*numbers, WIDTH, HEIGHT)


@pytest.mark.parametrize("low", [-300.0, float("nan"), 1e9, True, [1], None])
def test_bounds_that_are_no_temperatures_are_refused(tmp_path, low):
    write_colmap(tmp_path, names(9))
    write_json(tmp_path / "temperature_bounds.json", {"absolute_min_temperature": low, "absolute_max_temperature": 1e3})
    with pytest.raises(SceneError, match="temperature_bounds.json: 'absolute_min_temperature' is"):
        colmap(tmp_path)
    (tmp_path / "temperature_bounds.json").write_text("[1, 2]")
    with pytest.raises(
        SceneError, match=r"temperature_bounds.json must hold keys and values in braces .* it holds \[1, 2\]"
    ):
        colmap(tmp_path)


def test_options_that_are_no_temperatures_are_refused(tmp_path):
    write_colmap(tmp_path, names(9))
    with pytest.raises(SceneError, match="data.bounds_c: the minimum is -300 °C"):
        colmap(tmp_path, bounds_c=[-300, 20])
    with pytest.raises(SceneError, match="data.min_c and data.max_c: the minimum is -300 °C"):
        NTR(min_c=-300)
    for ambient in (-500.0, float("nan")):
        with pytest.raises(SceneError, match="ambient_c of scene .* is"):
            colmap(tmp_path, ambient_c=ambient)
    with pytest.raises(SceneError, match="metres_per_unit of scene .* is nan"):
        colmap(tmp_path, metres_per_unit=float("nan"))
    with pytest.raises(SceneError, match="data.raw_offset_c finite, got nan"):
        Counts(1.0, float("nan"))


def test_points_that_float32_cannot_hold_are_dropped(tmp_path):
    write_colmap(tmp_path, names(9), text=True)
    file = find_model(tmp_path) / "points3D.txt"
    file.write_text(file.read_text().replace("0.0118", "1e308", 1).replace("1e30821624700256717", "1e308"))
    scene = colmap(tmp_path)
    assert len(scene.points) == 29 and scene.points.isfinite().all()
    assert scene.notes["points_dropped"].startswith("1 point ")


# Images ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (grey(0, width=20, height=16), "frame_004.png is 20x16, but 8 others of the same camera are 40x32"),
        (grey(0, np.uint16), "frame_004.png is uint16, 8 others are uint8: the scene mixes bit depths"),
    ],
)
def test_one_image_unlike_its_equals_is_refused(tmp_path, pixels, message):
    write_colmap(tmp_path, names(9))
    write_image(tmp_path / "images" / "frame_004.png", pixels)
    with pytest.raises(SceneError, match=message):
        colmap(tmp_path)


def test_temperatures_below_absolute_zero_are_masked(tmp_path):
    pixels = [20 + grey(i) / np.float32(16) for i in range(9)]
    pixels[3][:2, :3] = -400
    write_colmap(tmp_path, names(9, "f_{}.tiff"), pixels=pixels)
    scene = colmap(tmp_path)
    view = next(v for v in scene.train if v.frame.name == "f_3.tiff")
    assert (~view.mask).sum() == 6 and scene.notes["nan_pixels"].startswith("6 pixels")


def test_visible_images_of_floats_are_refused(tmp_path):
    write_colmap(tmp_path, names(9, "f_{}.png"))
    for name in names(9, "f_{}.tiff"):
        write_image(tmp_path / "rgb" / name, np.ones((HEIGHT, WIDTH, 3), np.float32))
    with pytest.raises(SceneError, match="the visible image of f_0.png is float32; save it with 8 or 16 bits"):
        colmap(tmp_path, rgb="rgb")


# Tables, as Excel writes them -----------------------------------------------------------------------------------------

ROWS = [["file", "time_s"], ["a.png", "0,5"], ["b.png", "1,25"], ["", ""]]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("first", ["", "sep=;\n", "# Wärmebild\n"])
def test_tables_of_excel_are_read(tmp_path, encoding, first):
    path = tmp_path / "t.csv"
    path.write_bytes((first + "\r\n".join(map(";".join, ROWS))).encode(encoding))
    assert times_from_csv(path, "file", "time_s") == {"a.png": 0.5, "b.png": 1.25}
    path.write_bytes((first + "time_s;Temperatur;air_°C\r\n0,5;x;20,5\r\n1,5;x;21,5\r\n;;\r\n").encode(encoding))
    weather = read_weather(path)
    assert weather.air_c.tolist() == [20.5, 21.5] and weather.times_s.tolist() == [0.5, 1.5]
    path.write_bytes('"a.png";\r\nb.png\r\n;\r\n'.encode(encoding))
    assert by_list(["a.png", "b.png", "c.png"], path) == ([2], [0, 1])


def test_json_with_a_byte_order_mark_and_decimal_commas_is_read(tmp_path):
    write_colmap(tmp_path, names(9))
    values = '{"absolute_min_temperature": "10,5", "absolute_max_temperature": 40}'
    (tmp_path / "temperature_bounds.json").write_bytes(values.encode("utf-8-sig"))
    assert colmap(tmp_path).thermal_range.min_c == 10.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,time_s\na,1\na,2\n", "t.csv, line 3: a has another time in a line above"),
        ("file,time_s\na\n", "t.csv, line 2: 1 cells for 2 columns"),
        ("", "t.csv is empty"),
        ("\0\xff", "no such column|no text file"),
        ("file,time_s\na,1,5\nb,2,5\n", "t.csv, line 2: 3 cells for 2 columns; separate columns by semicolons"),
        ("file,time_s\na,1e999\nframe_001,0\n", "t.csv, line 2: '1e999' in column time_s is neither"),
        ("file,time_s\na,nan\n", "t.csv, line 2: 'nan' in column time_s is neither"),
    ],
)
def test_damaged_tables_of_times_are_refused(tmp_path, text, message):
    write_colmap(tmp_path, names(9))
    (tmp_path / "t.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(SceneError, match=message):
        colmap(tmp_path, time_csv="t.csv")


def test_a_split_file_that_lists_no_names_is_refused(tmp_path):
    path = tmp_path / "split.json"
    for values in ({"test": 3}, {"test": ["a"], "train": {"b": 1}}, {"test": [1]}):
        path.write_text(json.dumps(values))
        with pytest.raises(SceneError, match="split.json is .*, a list of names is needed"):
            by_list(["a", "b"], path)


def test_a_dji_name_without_a_date_has_no_time():
    assert dji_time("DJI_20241399999999_0008_T.JPG") is None


def test_cv2_reads_what_the_tests_write(tmp_path):
    """Guards the float cases above: a TIFF that came back as integers would pass them for the wrong reason."""
    write_image(tmp_path / "f.tiff", np.ones((4, 4), np.float32))
    assert cv2.imread(str(tmp_path / "f.tiff"), cv2.IMREAD_UNCHANGED).dtype == np.float32
