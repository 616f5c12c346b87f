import struct
from pathlib import Path

import numpy as np
import pytest
from camera_files import dji_jpeg, with_segment

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.dji import array_of, is_thermal, parameters_in, temperatures, xmp_in

M3T = Path(__file__).parents[3] / "shared" / "data" / "m3t_heath"
needs_m3t = pytest.mark.skipif(not M3T.is_dir(), reason="real DJI data is not at ../shared/data/m3t_heath")
RAW = (np.arange(512 * 640).reshape(512, 640) % 1000 * 4 + 19000).astype(np.uint16)


def test_the_array_is_read_and_is_temperatures_where_it_holds_sixteenths_of_a_kelvin():
    found = array_of(dji_jpeg(RAW))
    np.testing.assert_array_equal(found, RAW)
    np.testing.assert_allclose(temperatures(found, Path("a.jpg")), RAW / 64 - 273.15, atol=1e-4)
    assert array_of(b"no jpeg") is None and array_of(dji_jpeg(RAW[:100])) is None


def test_counts_are_refused_with_the_command_that_converts_them():
    with pytest.raises(SceneError, match="b.jpg: .*dji_irp -s IMAGE.JPG -a measure --measurefmt float32"):
        temperatures(RAW + 1, Path("b.jpg"))


def test_a_thermal_picture_is_known_without_its_array():
    plain = dji_jpeg(RAW[:100])
    assert not is_thermal(plain)  # of another maker
    xmp = b"http://ns.adobe.com/xap/1.0/\0<x drone-dji:%s/>"
    assert is_thermal(with_segment(plain, 0xE1, xmp % b'Version="1.6"'))
    picture = with_segment(b"\xff\xd8\xff\xd9", 0xE1, xmp % b'ImageSource="InfraredCamera"')
    assert is_thermal(picture) and not is_thermal(picture.replace(b"InfraredCamera", b"WideCamera____"))


@pytest.mark.parametrize("start", [0, 32])
def test_object_parameters_are_read(start):
    block = bytearray(start + 64)
    struct.pack_into("<5f", block, start, 18.0, 75.0, 0.9, 0.35, -20.0)
    block[start + 32 : start + 36] = b"\x2c\x01\x20\x00"
    found = parameters_in(with_segment(dji_jpeg(RAW), 0xE4, bytes(block)))
    wanted = {"air_k": 291.15, "distance_m": 75.0, "emissivity": 0.9, "humidity": 0.35, "reflected_k": 253.15}
    assert found == pytest.approx(wanted, rel=1e-6)
    struct.pack_into("<f", block, start + 8, -3.0)
    assert "emissivity" not in parameters_in(with_segment(dji_jpeg(RAW), 0xE4, bytes(block)))
    assert parameters_in(dji_jpeg(RAW)) == {}
    assert parameters_in(with_segment(dji_jpeg(RAW), 0xE4, bytes(block)[: start + 10])) == {}


@needs_m3t
def test_a_real_flight_says_where_it_was_and_what_was_set():
    data = (M3T / "raw_rjpeg" / "DJI_20240806173449_0008_T.JPG").read_bytes()
    xmp = xmp_in(data)
    assert (xmp["RelativeAltitude"], xmp["GimbalPitchDegree"]) == ("+75.002", "-89.90")
    assert xmp["UTCAtExposure"] == "2024-08-06T15:35:05.376048"  # as in meta.csv
    wanted = {"air_k": 298.15, "distance_m": 5.0, "emissivity": 0.95, "humidity": 0.5, "reflected_k": 298.15}
    assert parameters_in(data) == pytest.approx(wanted, rel=1e-6)
