import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import PLANCK, dji_jpeg, fff, flir_jpeg, raw_for, temperatures
from layouts import FOCAL, HEIGHT, WIDTH, names, opengl, viewmats, write_colmap, write_image, write_json
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import write_model
from heatsplat.datamodules.formats.flir import Record
from heatsplat.datamodules.formats.images import read_image
from heatsplat.datamodules.formats.radiometric import (
    Calibration,
    has_temperatures,
    read_celsius,
    read_thermal,
    surface_celsius,
)
from heatsplat.datamodules.nerfstudio import Nerfstudio

DATA = Path(__file__).parents[3] / "shared" / "data"
FLIR, M3T = DATA / "flir", DATA / "m3t_heath"
needs_flir = pytest.mark.skipif(not FLIR.is_dir(), reason="real FLIR data is not at ../shared/data/flir")
needs_m3t = pytest.mark.skipif(not M3T.is_dir(), reason="real DJI data is not at ../shared/data/m3t_heath")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("png", [False, True])
def test_flir_temperatures_come_back(tmp_path, order, png):
    path = tmp_path / "a.jpg"
    path.write_bytes(flir_jpeg(raw_for(temperatures()), order=order, png=png))
    assert has_temperatures(path)
    celsius = read_celsius(path)
    assert celsius.dtype == np.float32
    np.testing.assert_allclose(celsius, temperatures(), atol=0.02)  # one raw step is 0.02 K


def test_fff_files_are_read_like_jpegs(tmp_path):
    (tmp_path / "a.fff").write_bytes(fff(raw_for(temperatures())))
    np.testing.assert_allclose(read_celsius(tmp_path / "a.fff"), temperatures(), atol=0.02)


def test_values_outside_the_calibration_are_gaps():
    assert np.isnan(surface_celsius(np.array([0, 7000], np.uint16), Calibration(PLANCK))).all()


def test_dji_arrays_of_sixteenths_of_a_kelvin_are_temperatures(tmp_path):
    celsius = np.round(temperatures(height=512, width=640) % 50 * 16) / 16 - 0.15  # raw counts are multiples of 4
    raw = np.rint((celsius + 273.15) * 64).astype(np.uint16)
    (tmp_path / "a.jpg").write_bytes(dji_jpeg(raw))
    np.testing.assert_allclose(read_celsius(tmp_path / "a.jpg"), celsius, atol=1e-4)


@pytest.mark.parametrize("raw", [np.arange(512 * 640) % 3000 + 18000, np.full((512, 640), 4)])
def test_dji_arrays_of_counts_are_refused(tmp_path, raw):
    path = tmp_path / "a.jpg"
    path.write_bytes(dji_jpeg(np.reshape(raw, (512, 640))))
    with pytest.raises(
        SceneError, match="a.jpg: .*only DJI's Thermal SDK converts them: dji_irp .*data.radiometric=never"
    ):
        read_celsius(path)


def test_plain_pictures_carry_no_temperatures(tmp_path):
    write_image(tmp_path / "a.jpg", np.zeros((8, 8), np.uint8))
    assert not has_temperatures(tmp_path / "a.jpg")
    with pytest.raises(SceneError, match="carries no raw data of FLIR or DJI"):
        read_celsius(tmp_path / "a.jpg")


def test_damaged_flir_data_is_named(tmp_path):
    whole = fff(raw_for(temperatures()))
    (tmp_path / "short.fff").write_bytes(whole[:300])
    with pytest.raises(SceneError, match="short.fff: the FLIR data"):
        read_celsius(tmp_path / "short.fff")
    (tmp_path / "head.fff").write_bytes(whole[:100])
    with pytest.raises(SceneError, match="head.fff: the FLIR data is damaged"):
        read_celsius(tmp_path / "head.fff")
    (tmp_path / "ls.fff").write_bytes(fff(raw_for(temperatures()), pixels=b"\xff\xd8\xff\xf7"))
    with pytest.raises(SceneError, match="ls.fff: its JPEG-LS image cannot be decoded"):
        read_celsius(tmp_path / "ls.fff")


def test_constants_that_cannot_be_are_refused(tmp_path):
    data = bytearray(fff(raw_for(temperatures())))
    at = data.index(struct.pack("<f", PLANCK.b))
    data[at : at + 4] = struct.pack("<f", -1.0)
    (tmp_path / "a.fff").write_bytes(bytes(data))
    with pytest.raises(SceneError, match="no plausible Planck constants"):
        read_celsius(tmp_path / "a.fff")


def test_a_scene_of_radiometric_jpegs_is_in_celsius(tmp_path):
    files = names(9, "f_{}.jpg")
    write_colmap(tmp_path, files, images=None)
    (tmp_path / "images").mkdir()
    for i, name in enumerate(files):
        (tmp_path / "images" / name).write_bytes(flir_jpeg(raw_for(temperatures(i))))
    module = Colmap(root=str(tmp_path), bounds_c=[5.0, 50.0])
    module.setup()
    celsius = module.scene.thermal_range.to_celsius(module.scene.train[0].thermal[..., 0])
    np.testing.assert_allclose(celsius, temperatures(1), atol=0.03)
    assert module.scene.notes["encoding"].startswith("temperatures of radiometric JPEGs")

    plain = Colmap(root=str(tmp_path), radiometric="never")
    plain.setup()
    assert plain.scene.thermal_range is None
    assert abs(plain.scene.train[0].thermal * 255 - 90).max() < 3

    write_image(tmp_path / "images" / files[4], np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(SceneError, match="8 of 9 images are radiometric JPEGs, f_4.jpg is not"):
        Colmap(root=str(tmp_path)).setup()


@needs_flir
def test_a_real_flir_frame_agrees_with_its_printed_metadata():
    path = FLIR / "frame_000000.fff"
    record = Record(path.read_bytes(), str(path))
    raw, planck = record.counts(), record.measured().response
    assert raw.shape == (512, 640)
    assert (planck.r1, planck.b, planck.f, planck.o, planck.r2) == (364058.0, 1428.0, 1.0, -228, 1.0)
    assert int(raw.max()) - int(raw.min()) == 116  # "Raw Value Range"
    celsius = read_celsius(path)
    assert 5 < np.median(celsius) < 20


@needs_flir
def test_a_real_flir_jpeg_holds_a_plausible_outdoor_scene():
    celsius = read_celsius(FLIR / "IMG_0620.JPG")
    assert celsius.shape == (640, 480)
    assert -12 < celsius.min() < -8 and 25 < celsius.max() < 28
    # Wrong byte order makes noise of a picture: neighbours must agree.
    assert np.abs(np.diff(celsius, axis=1)).mean() < 0.5


@needs_m3t
def test_real_dji_jpegs_give_the_counts_in_the_table():
    rows = io.StringIO((M3T / "meta.csv").read_text()).readlines()
    columns = rows[0].strip().split(",")
    table = {(v := dict(zip(columns, r.strip().split(","), strict=True)))["file"]: v for r in rows[1:]}
    for path in sorted((M3T / "raw_rjpeg").glob("*.JPG")):
        celsius = read_celsius(path)
        raw = (celsius.astype(np.float64) + 273.15) * 64
        row = table[path.stem]
        assert raw.min() == pytest.approx(float(row["raw_min"]), abs=0.05)
        assert raw.max() == pytest.approx(float(row["raw_max"]), abs=0.05)
        assert raw.mean() == pytest.approx(float(row["raw_mean"]), abs=0.05)


@needs_m3t
def test_undistorting_real_rjpegs_gives_the_published_undistorted_counts(tmp_path):
    """Original JPEGs and the solved RADIAL camera against the undistorted counts that another program made of them."""
    files = [p.name for p in sorted((M3T / "raw_rjpeg").glob("*.JPG"))]
    (tmp_path / "images").symlink_to(M3T / "raw_rjpeg")
    camera = ("RADIAL", (758.33, 317.96, 261.74, -0.343, 0.0825), 640, 512)
    poses = dict(zip(files, viewmats(len(files)), strict=True))
    write_model(
        tmp_path / "sparse" / "0", poses, [camera], np.random.default_rng(0).normal(size=(9, 3)), np.zeros((9, 3))
    )
    (tmp_path / "test.txt").write_text(files[1])
    module = Colmap(root=str(tmp_path), bounds_c=[20.0, 55.0], split="list", split_file=str(tmp_path / "test.txt"))
    module.setup()
    view = module.scene.train[0]
    celsius = module.scene.thermal_range.to_celsius(view.thermal[..., 0]).numpy()
    published = read_image(M3T / "colmap_scene" / "raw16" / f"{Path(files[0]).stem}.png") / 64 - 273.15
    # The published image has f = 745.5 and a centred principal point; ours keeps the camera's.
    v, u = np.mgrid[:512, :640].astype(np.float32)
    x = (u + 0.5 - 317.96) / 758.33 * 745.5 + 320 - 0.5
    y = (v + 0.5 - 261.74) / 758.33 * 745.5 + 256 - 0.5
    expected = cv2.remap(published.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    inside = (x > 2) & (x < 637) & (y > 2) & (y < 509)
    error = np.abs(celsius - expected)[inside]
    shifted = np.abs(np.roll(celsius, 1, axis=1) - expected)[inside]
    assert np.median(error) < 0.1  # two interpolations of a textured scene
    assert error.mean() < 0.5 * shifted.mean()


def float_tiff(path, pixels, says):
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = ImageFileDirectory_v2()
    tags[270] = says
    Image.fromarray(pixels).save(path, tiffinfo=tags)


def test_floats_whose_file_says_fahrenheit_are_refused_and_others_are_read(tmp_path):
    pixels = np.full((4, 5), 70.0, np.float32)
    float_tiff(tmp_path / "f.tiff", pixels, '{"unit": "F"}')
    float_tiff(tmp_path / "c.tiff", pixels, '{"unit": "C"}')
    np.testing.assert_array_equal(read_thermal(tmp_path / "c.tiff"), pixels)
    said = r"f.tiff says that its numbers are °F, .*counts.scale=0.555556 counts.offset_c=-17.7778 poses=given"
    with pytest.raises(SceneError, match=said):
        read_thermal(tmp_path / "f.tiff")


def test_floats_whose_file_says_kelvin_are_refused_unless_they_are_too_small(tmp_path):
    room, furnace = np.full((4, 5), 295.0, np.float32), np.full((4, 5), 1100.0, np.float32)
    for pixels in (room, furnace):
        float_tiff(tmp_path / "k.tiff", pixels, '{"unit": "K"}')
        with pytest.raises(
            SceneError, match=r"k.tiff says that its numbers are kelvin, .* counts.offset_c=-273.15 poses=given"
        ):
            read_thermal(tmp_path / "k.tiff")
    float_tiff(tmp_path / "c.tiff", room - 273.15, "NETD: 0.05 Kelvin")
    np.testing.assert_array_equal(read_thermal(tmp_path / "c.tiff"), room - 273.15)
    float_tiff(tmp_path / "hot.tiff", furnace, "unit=C")
    np.testing.assert_array_equal(read_thermal(tmp_path / "hot.tiff"), furnace)


@pytest.mark.parametrize("loader", ["colmap", "nerfstudio"])
@pytest.mark.parametrize(("low", "says", "unit"), [(60, "unit=F", "°F"), (280, "unit: K", "kelvin")])
def test_a_scene_of_another_unit_is_not_trained_as_celsius(tmp_path, loader, low, says, unit):
    files = names(9, "frame_{:03d}.tiff")
    for i, name in enumerate(files):
        float_tiff(
            tmp_path / "images" / name,
            np.linspace(low, low + 20 + i, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH),
            says,
        )
    if loader == "colmap":
        write_colmap(tmp_path, files, images=None)
        module = Colmap(root=str(tmp_path))
    else:
        frames = [
            {"thermal_file_path": f"images/{name}", "file_path": f"images/{name}", "transform_matrix": opengl(pose)}
            for name, pose in zip(files, viewmats(9), strict=True)
        ]
        lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 20.0, "cy": 16.0, "w": WIDTH, "h": HEIGHT}
        write_json(tmp_path / "transforms.json", {**lens, "frames": frames})
        module = Nerfstudio(root=str(tmp_path), random_points=50)
    with pytest.raises(SceneError, match=f"says that its numbers are {unit}"):
        module.setup()
