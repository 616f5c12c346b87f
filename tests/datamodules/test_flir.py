import json
import random
import shutil
import struct
import subprocess
from datetime import datetime, timedelta, timezone
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
from camera_files import PLANCK, STATED, camera_record, fff, flir_jpeg, gps_record, raw_for, temperatures

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.flir import Record, frames_in, payload_of, read_part
from heatsplat.datamodules.formats.radiometric import read_celsius

FLIR = Path(__file__).parents[3] / "shared" / "data" / "flir"
needs_flir = pytest.mark.skipif(not FLIR.is_dir(), reason="real FLIR data is not at ../shared/data/flir")
needs_exiftool = pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
TAKEN = datetime(2024, 10, 21, 13, 48, 48, 876000, tzinfo=timezone(timedelta(hours=2)))
WANTED = {name: value for name, (_, value) in STATED.items()}


@pytest.mark.parametrize("order", ["<", ">"])
def test_object_parameters_camera_time_and_place_are_read(order):
    camera = camera_record(order, WANTED, TAKEN)
    found = Record(
        fff(raw_for(temperatures()), order, camera=camera, gps=gps_record(46.5, -6.25, 394.0)), "a"
    ).measured()
    assert {name: getattr(found.conditions, name) for name in WANTED} == pytest.approx(WANTED, rel=1e-6)
    assert set(found.given) == set(WANTED)
    assert found.response == pytest.approx(PLANCK) or found.response.r1 == PLANCK.r1
    assert (found.model, found.serial, found.frame_rate_hz) == ("Test Cam 640", "S123", 30.0)
    assert found.time == TAKEN and found.time.utcoffset() == timedelta(hours=2)
    assert (found.latitude_deg, found.longitude_deg, found.altitude_m) == (46.5, -6.25, 394.0)


def test_what_is_implausible_counts_as_not_stated():
    stated = {"emissivity": 1.7, "distance_m": float("nan"), "reflected_k": -5.0, "humidity": 40.0}
    found = Record(fff(raw_for(temperatures()), camera=camera_record("<", stated)), "a").measured()
    assert "emissivity" not in found.given and found.conditions.emissivity == 1.0
    assert "distance_m" not in found.given and "reflected_k" not in found.given
    assert found.conditions.humidity == pytest.approx(0.4)  # written in per cent by some cameras


def test_a_recording_is_read_frame_by_frame(tmp_path):
    frames = [fff(raw_for(temperatures(i))) for i in range(4)]
    path = tmp_path / "a.seq"
    path.write_bytes(b"junk FFF\0 by chance" + b"".join(frames) + frames[0][:-9])
    places = frames_in(path)
    assert [length for _, length in places] == [len(frame) for frame in frames]  # the cut one at the end is none
    for i, place in enumerate(places):
        np.testing.assert_array_equal(Record(read_part(path, *place), "a").counts(), raw_for(temperatures(i)))


def test_jpeg_ls_of_csq_recordings_is_decoded(tmp_path):
    raw = raw_for(temperatures())
    path = tmp_path / "a.csq"
    path.write_bytes(fff(raw, pixels=imagecodecs.jpegls_encode(raw)) * 2)
    assert len(frames_in(path)) == 2
    for place in frames_in(path):
        np.testing.assert_array_equal(Record(read_part(path, *place), "a").counts(), raw)


def test_the_photo_inside_is_found():
    photo = cv2.imencode(".jpg", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
    assert Record(fff(raw_for(temperatures()), picture=photo), "a").picture() == photo
    assert Record(fff(raw_for(temperatures())), "a").picture() is None


@pytest.mark.parametrize("content", [b"", b"nothing of FLIR in here", b"FFF\0" + bytes(200)])
def test_what_is_no_recording_is_refused(tmp_path, content):
    (tmp_path / "a.seq").write_bytes(content)
    with pytest.raises(SceneError, match=r"a\.seq"):
        frames_in(tmp_path / "a.seq")


def test_damaged_files_are_read_sanely_or_refused_by_name(tmp_path):
    """Cut anywhere, and with bytes changed by chance: an image of the right size, or an error that names the file."""
    raw, rng = raw_for(temperatures()), random.Random(0)
    wholes = [fff(raw, png=True), fff(raw, ">"), flir_jpeg(raw, camera=camera_record("<", WANTED, TAKEN))]
    refused = 0
    for number in range(600):
        data = bytearray(rng.choice(wholes))
        if rng.random() < 0.4:
            data = data[: rng.randrange(4, len(data))]
        for _ in range(rng.choice([0, 1, 3, 30])):
            at = rng.randrange(min(len(data), rng.choice([128, 300, len(data)])))
            data[at] = rng.choice([0, 255, rng.randrange(256)])
        path = tmp_path / f"damaged_{number}.fff"
        path.write_bytes(data)
        try:
            celsius = read_celsius(path)
            if payload := payload_of(bytes(data)):
                Record(payload, str(path)).measured()
            assert celsius.dtype == np.float32 and celsius.ndim == 2 and celsius.size < 1 << 26
        except SceneError as error:
            assert path.name in str(error)
            refused += 1
        try:
            for place in frames_in(path):
                Record(read_part(path, *place), str(path)).size()
        except SceneError as error:
            assert path.name in str(error)
    assert 100 < refused < 600


@needs_flir
@needs_exiftool
@pytest.mark.parametrize("name", ["frame_000000.fff", "IMG_0620.JPG"])
def test_metadata_agrees_with_exiftool(name):
    """Emissivity, reflected temperature, distance, humidity, window, Planck constants, time, place and camera."""
    done = subprocess.run(["exiftool", "-j", "-n", str(FLIR / name)], capture_output=True, check=True, text=True)
    theirs = json.loads(done.stdout)[0]
    ours = Record(payload_of((FLIR / name).read_bytes()), name).measured()
    c, r, a = ours.conditions, ours.response, ours.conditions.atmosphere
    for mine, tag in (
        (c.emissivity, "Emissivity"),
        (c.distance_m, "ObjectDistance"),
        (c.reflected_k - 273.15, "ReflectedApparentTemperature"),
        (c.air_k - 273.15, "AtmosphericTemperature"),
        (c.window_k - 273.15, "IRWindowTemperature"),
        (c.window_transmission, "IRWindowTransmission"),
        (c.humidity, "RelativeHumidity"),
        (r.r1, "PlanckR1"),
        (r.b, "PlanckB"),
        (r.f, "PlanckF"),
        (r.o, "PlanckO"),
        (r.r2, "PlanckR2"),
        (a.alpha_1, "AtmosphericTransAlpha1"),
        (a.alpha_2, "AtmosphericTransAlpha2"),
        (a.beta_1, "AtmosphericTransBeta1"),
        (a.beta_2, "AtmosphericTransBeta2"),
        (a.x, "AtmosphericTransX"),
        (ours.frame_rate_hz, "FrameRate"),
    ):
        assert mine == pytest.approx(float(theirs[tag]), rel=1e-6, abs=1e-6), tag
    assert ours.time == datetime.strptime(theirs["DateTimeOriginal"], "%Y:%m:%d %H:%M:%S.%f%z")
    assert ours.model == theirs["CameraModel"] and ours.serial == str(theirs["CameraSerialNumber"])
    if name.endswith("fff"):
        assert ours.latitude_deg == pytest.approx(theirs["GPSLatitude"])
        assert ours.longitude_deg == pytest.approx(theirs["GPSLongitude"])
        assert ours.altitude_m == pytest.approx(theirs["GPSAltitude"])


def test_a_record_that_claims_too_much_is_refused():
    data = bytearray(fff(raw_for(temperatures())))
    struct.pack_into(">I", data, 28, 1 << 30)
    with pytest.raises(SceneError, match="a: the FLIR data is damaged .it claims"):
        Record(bytes(data), "a")
