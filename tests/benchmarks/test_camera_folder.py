"""What a camera leaves is what the preparation reads."""

import numpy as np
import pytest

from benchmarks.camera_folder import Field, dead_pixels, flight, sawtooth, write_camera
from heatsplat.datamodules.formats.geodesy import east_north_up
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.preparation.frames import Reading, read_recording


@pytest.fixture(scope="module")
def recording():
    return film(Scene(PRESETS["cooling"]), Size(32, 24, 5, 40))


def test_temperatures_times_places_and_photos_come_back(recording, tmp_path):
    field = Field(origin=(47.0, 9.0, 500.0), drift_k=0.5, frames_per_shutter=3, dead_pixels=4, rgb=True)
    write_camera(recording, tmp_path, field)
    frames = read_recording(tmp_path, Reading()).frames
    assert len(frames) == 5 and all(frame.rgb is not None for frame in frames)
    dead = np.zeros((24, 32), dtype=bool)
    dead[tuple(dead_pixels(24, 32, 4, 0).T)] = True
    for i, frame in enumerate(frames):
        expected = recording.celsius[i] + sawtooth(5, field)[i]
        np.testing.assert_allclose(frame.temperature()[~dead], expected[~dead], atol=0.006)
        assert (frame.temperature()[dead] > expected.max()).all()
        assert (frame.time - field.start).total_seconds() == pytest.approx(recording.times_s[i], abs=2e-3)
    places = np.array([[f.position.latitude_deg, f.position.longitude_deg, f.position.altitude_m] for f in frames])
    metres = east_north_up(places, np.array(field.origin))
    np.testing.assert_allclose(metres, np.linalg.inv(recording.viewmats)[:, :3, 3], atol=1e-3)


def test_a_flight_goes_around_the_yard():
    flown = flight(Size(16, 12, 6, 20), duration_s=60.0)
    centers = np.linalg.inv(flown.viewmats)[:, :3, 3]
    assert flown.times_s[0] == 14 * 3600 and flown.times_s[-1] == 14 * 3600 + 60
    assert np.ptp(centers[:, 0]) > 20 and (centers[:, 2] > 8).all()
