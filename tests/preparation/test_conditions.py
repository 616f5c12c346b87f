from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.physics.radiometry import Conditions
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.frame import ThermalFrame

FROM_FILE = Conditions(emissivity=0.95, reflected_k=280.0, distance_m=5.0)
FRAME = ThermalFrame(
    "a", Path("a.tiff"), 0, lambda: np.zeros((1, 1), np.float32), conditions=FROM_FILE, sources={"emissivity": "file"}
)


def test_what_is_given_goes_before_what_the_file_says():
    settled = GivenConditions(distance_m=75.0, air_c=10.0, humidity_percent=80.0).settled(FRAME)
    c = settled.conditions
    assert (c.distance_m, c.air_k, c.humidity, c.emissivity, c.reflected_k) == (75.0, 283.15, 0.8, 0.95, 280.0)
    assert settled.sources == {"emissivity": "file", "distance_m": "given", "air_k": "given", "humidity": "given"}
    assert GivenConditions().settled(FRAME).conditions == FROM_FILE


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"emissivity": 0.0}, "conditions.emissivity=0.0 must lie between 0.001 and 1"),
        ({"emissivity": 95}, "conditions.emissivity=95"),
        ({"humidity_percent": 120}, "conditions.humidity_percent=120 must lie between 0 and 100"),
        ({"air_c": -300}, "conditions.air_c"),
        ({"emissivity": "shiny"}, "conditions.emissivity must be a number, got shiny"),
        ({"distance_m": [1, 2]}, r"conditions.distance_m must be a number, got \[1, 2\]"),
    ],
)
def test_what_cannot_be_is_refused(wrong, said):
    with pytest.raises(SceneError, match=said):
        GivenConditions(**wrong)


def test_what_can_be_and_is_hardly_meant_is_doubted():
    assert GivenConditions(reflected_c=-40.0, air_c=35.0, humidity_percent=1.0, window_c=100.0).doubts() == []
    kelvin, share = GivenConditions(reflected_c=293, humidity_percent=0.5).doubts()
    assert "conditions.reflected_c=293 is in °C" in kelvin and "give 19.85" in kelvin
    assert "conditions.humidity_percent=0.5 is in per cent" in share and "give 50" in share


def test_air_for_which_the_formula_has_no_answer_is_refused():
    with pytest.raises(SceneError, match="a.tiff: at 90000 m of air with 90 % humidity .*conditions.distance_m"):
        GivenConditions(distance_m=90_000, humidity_percent=90, air_c=30).settled(FRAME)


def test_uncertainties_come_in_the_units_of_the_conditions():
    found = InputUncertainty(distance_percent=20.0, humidity_percent=5.0).standard(FROM_FILE)
    assert found["distance_m"] == 1.0 and found["humidity"] == 0.05 and found["camera"] == 1.0
    assert found["window_transmission"] == found["window_k"] == 0  # there is none
    assert InputUncertainty().standard(Conditions(window_transmission=0.9))["window_k"] == 3.0
    for wrong in (-1.0, "little", float("nan")):
        with pytest.raises(SceneError, match="uncertainty.air_c"):
            InputUncertainty(air_c=wrong)


@pytest.mark.parametrize(
    ("idle", "needed"),
    [
        (
            {"reflected_c": 5.0},
            "reflected_c=5.0 changes nothing while emissivity is 1, .* give conditions.emissivity, too",
        ),
        ({"window_c": 5.0}, "window_c=5.0 changes nothing while window_transmission is 1"),
        ({"air_c": 5.0, "humidity_percent": 50}, "air_c=5.0 changes nothing while distance_m is 0"),
        ({"humidity_percent": 50, "distance_m": 0.0}, "humidity_percent=50 changes nothing while distance_m is 0"),
    ],
)
def test_conditions_that_change_nothing_are_refused_with_what_they_need(idle, needed):
    plain = replace(FRAME, conditions=Conditions(), sources={})
    with pytest.raises(SceneError, match=needed):
        GivenConditions(**idle).check_use([GivenConditions(**idle).settled(plain)])
    useful = GivenConditions(**idle | {"emissivity": 0.9, "distance_m": 9.0, "window_transmission": 0.9})
    useful.check_use([useful.settled(plain)])
    some = GivenConditions(reflected_c=5.0)
    some.check_use([some.settled(plain), some.settled(FRAME)])  # it counts for one of them
    neutral = GivenConditions(emissivity=1.0, distance_m=0.0, window_transmission=1.0)
    neutral.check_use([neutral.settled(plain)])  # goes before what files say
    with pytest.raises(
        SceneError, match=r"conditions.emissivity changes nothing for greys, .* give bounds_c=\[min,max\]"
    ):
        GivenConditions(emissivity=0.9).check_use([replace(plain, calibration=None)])
