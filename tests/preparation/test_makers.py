"""Radiometric files of FLIR and DJI as frames."""

from datetime import UTC, datetime

import cv2
import numpy as np
import torch
from camera_files import fff, raw_for, temperatures, with_segment
from recordings import flir_frame, read_frames, write_flir, write_sequence

from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.makers import taken_at
from heatsplat.preparation.meaning import Meaning


def test_a_recording_that_was_cut_short_says_so(tmp_path):
    path = write_sequence(tmp_path / "flight.seq")
    path.write_bytes(path.read_bytes()[:-10])
    found = read_recording(tmp_path)
    assert len(found.frames) == 3 and any("after its last whole frame" in note for note in found.notes)


def test_constants_of_a_camera_that_are_given_go_before_those_of_its_files(tmp_path):
    own, path = read_frames(write_flir(tmp_path, 1))[0], tmp_path
    p = own.calibration.response
    (other,) = read_frames(path, Reading(Meaning(planck=[p.r1, p.b, p.f, p.o + 300, p.r2])))
    lower = other.calibration.response.kelvin(torch.tensor([15000.0])) - p.kelvin(torch.tensor([15000.0]))
    assert float(lower) > 0.5 and np.nanmedian(other.temperature() - own.temperature()) > 0.5


def test_the_photo_inside_a_file_is_offered(tmp_path):
    photo = cv2.imencode(".jpg", np.full((8, 8, 3), 90, np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(flir_frame(0, picture=photo))
    (tmp_path / "b.fff").write_bytes(fff(raw_for(temperatures())))
    frames = {frame.name: frame for frame in read_frames(tmp_path)}
    assert frames["a"].picture() == photo and frames["b"].picture is None


def test_photos_of_dji_have_the_clock_of_their_thermal_pictures(tmp_path):
    xmp = b'http://ns.adobe.com/xap/1.0/\0<x drone-dji:UTCAtExposure="2024-08-06T15:35:05.376048"/>'
    picture = with_segment(b"\xff\xd8\xff\xd9", 0xE1, xmp)
    assert taken_at(picture) == datetime(2024, 8, 6, 15, 35, 5, 376048, tzinfo=UTC)
