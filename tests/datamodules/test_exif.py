import io
from datetime import UTC, datetime, timedelta

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from heatsplat.datamodules.formats.exif import exif_in

TAKEN = {0x9003: "2024:10:21 13:48:48", 0x9291: "876"}
GPS = {1: "S", 2: (46, 31, 9.84), 3: "E", 4: (6, 33, 58.92), 5: b"\x00", 6: IFDRational(3942, 10)}


def jpeg(taken, gps) -> bytes:
    exif = Image.Exif()
    exif[0x10F], exif[0x110] = "Maker", "Camera 1"
    exif.get_ifd(0x8769).update(taken)
    exif.get_ifd(0x8825).update(gps)
    buffer = io.BytesIO()
    Image.new("L", (8, 8)).save(buffer, "JPEG", exif=exif)
    return buffer.getvalue()


def test_camera_time_and_place_are_read():
    found = exif_in(jpeg(TAKEN | {0x9011: "+02:00", 0x920A: IFDRational(91, 10), 0xA431: "77"}, GPS))
    assert (found["make"], found["model"], found["serial"], found["focal_mm"]) == ("Maker", "Camera 1", "77", 9.1)
    assert found["time"] == datetime(2024, 10, 21, 11, 48, 48, 876000, tzinfo=UTC)
    assert found["latitude_deg"] == pytest.approx(-46.519400, abs=1e-6)
    assert found["longitude_deg"] == pytest.approx(6.566367, abs=1e-6)
    assert found["altitude_m"] == pytest.approx(394.2)


def test_the_clock_of_gps_tells_the_zone():
    clock = {7: (11, 48, 30), 29: "2024:10:21"}
    assert exif_in(jpeg(TAKEN, GPS | clock))["time"].utcoffset() == timedelta(hours=2)
    assert exif_in(jpeg(TAKEN, GPS | {7: (11, 25, 0), 29: "2024:10:21"}))["time"].tzinfo is None  # no whole quarter
    assert exif_in(jpeg(TAKEN, GPS))["time"].tzinfo is None


def test_what_is_damaged_says_nothing():
    whole = jpeg(TAKEN, GPS)
    assert exif_in(b"") == {} and exif_in(b"no picture") == {}
    for length in range(20, len(whole), 37):
        exif_in(whole[:length])
    assert "time" not in exif_in(jpeg({0x9003: "0000:00:00 00:00:00"}, {}))
    assert "latitude_deg" not in exif_in(jpeg(TAKEN, GPS | {2: (146, 0, 0)}))


@pytest.mark.parametrize("clock", [{0x9003: "0000:00:00 00:00:00"}, {0x9003: "    :  :     :  :  "}])
def test_a_clock_that_was_never_set_costs_nothing_else(clock):
    found = exif_in(jpeg(clock | {0x920A: IFDRational(91, 10)}, GPS))
    assert found.keys() == {"make", "model", "focal_mm", "latitude_deg", "longitude_deg", "altitude_m"}
    blank = exif_in(jpeg(TAKEN | {0x9011: "   :  "}, GPS))["time"]
    assert blank == datetime(2024, 10, 21, 13, 48, 48, 876000)


def test_numbers_that_cameras_do_not_know_say_nothing():
    """EXIF has 0/0 for what is unknown, and a focal length of 0 for a lens that is."""
    unknown = IFDRational(0, 0)
    found = exif_in(jpeg(TAKEN | {0x920A: unknown}, GPS | {6: unknown}))
    assert "focal_mm" not in found and "altitude_m" not in found and found["latitude_deg"] < 0
    assert "focal_mm" not in exif_in(jpeg(TAKEN | {0x920A: IFDRational(0, 10)}, {}))
    assert exif_in(jpeg(TAKEN, GPS | {5: b"\x01"}))["altitude_m"] == pytest.approx(-394.2)
