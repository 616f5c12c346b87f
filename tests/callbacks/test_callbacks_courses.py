"""What a run found to change for the whole scene: numbers with their units, and a picture where there is something to see."""

from types import SimpleNamespace

import cv2
import pytest
import torch
from fake_run import FakeModule, wall

from heatsplat.callbacks.courses import COURSES_FILE, COURSES_PICTURE, LearnedCourses
from heatsplat.contracts import Course
from heatsplat.io.tables import read_csv
from heatsplat.sensors.base import SensorChain
from heatsplat.sensors.frame_offset import FrameOffset
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.newton_harmonic import NewtonHarmonic

LAMP = Course("power of the heat source", [0.0, 300.0, 600.0], [0.0, 1.0, 0.0], "of its largest")


def drawn(tmp_path, scene, courses=(), parts=None):
    module = FakeModule(scene, tmp_path)
    module.thermal.courses = lambda: list(courses)
    module.sensor = SensorChain(parts)
    LearnedCourses().on_test_epoch_end(SimpleNamespace(global_step=9), module)
    return module


def drift(scene):
    part = FrameOffset()
    part.prepare(scene)
    part.raw_offset.data.copy_(torch.linspace(-0.2, 0.2, len(part.raw_offset)))
    return part


def test_each_course_has_its_axis_and_its_numbers(tmp_path):
    scene = wall()
    part = drift(scene)
    drawn(tmp_path, scene, [LAMP], {"frame_offset": part})
    rows = read_csv(tmp_path / COURSES_FILE)
    assert [(row["time_s"], row["value"]) for row in rows[:3]] == [(0.0, 0.0), (300.0, 1.0), (600.0, 0.0)]
    assert {row["course"] for row in rows[3:]} == {"drift of the camera: offset"}
    assert {row["unit"] for row in rows[3:]} == {"°C"}  # the image's range is 40 °C wide
    assert [row["value"] for row in rows[3:]] == pytest.approx([40 * o for o in part.offsets().tolist()], abs=1e-4)
    two, one = cv2.imread(str(tmp_path / COURSES_PICTURE)), tmp_path / "one"
    drawn(one, scene, [LAMP])
    assert two.shape[0] > 1.5 * cv2.imread(str(one / COURSES_PICTURE)).shape[0]


def test_without_a_range_a_drift_stays_in_image_units(tmp_path):
    scene = wall(thermal_range=None)
    drawn(tmp_path, scene, parts={"frame_offset": drift(scene)})
    assert {row["unit"] for row in read_csv(tmp_path / COURSES_FILE)} == {"share of the image's range"}


def test_where_nothing_is_shared_there_is_no_picture(tmp_path):
    drawn(tmp_path, wall(), [Course("one moment", [0.0], [1.0], "")])
    assert not (tmp_path / "renders").exists()


def test_a_composed_model_tells_those_of_its_parts():
    model = Composed(
        NewtonHarmonic(frequencies=0, clip="none"), {"attenuation": Attenuation(depth=[0.1, 0.4, 0.2], moments=3)}
    )
    model.prepare(wall())
    (air,) = model.courses()
    assert air.name == "extinction of the air" and (air.times_s[0], air.times_s[-1]) == (0.0, 600.0)
    assert max(air.values) / min(air.values) > 3.9
    assert Attenuation(moments=0).courses() == []
