"""Options of the network of ThermoGS: what is refused, and what others follow from."""

import pytest

from heatsplat.thermal.energy_network import EnergyNetwork
from heatsplat.thermal.land_cover import CLASSES


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": "year"}, "time must be one of scene, record, day, none"),
        ({"features": "rgb"}, "features must be one of"),
        ({"sky": "blue"}, "sky must be one of"),
        ({"projected_area": "shadow"}, "projected_area must be one of"),
        ({"width": 0}, "at least 1"),
        ({"interval_s": (600.0, 60.0)}, "interval_s must be"),
        ({"interval_s": []}, r"interval_s must be a list of 2 numbers, got \[\]"),
        ({"weights": {"edges": 1.0}}, "weights are those of smooth"),
        ({"feature_size": 0}, "feature_size must be at least 1 where features are learned, got 0"),
        ({"depth_m": -1}, "depth_m, smallest_axis_m and past_h must be above 0, got -1"),
        ({"past_h": [1.0, -1.0]}, r"past_h must be above 0, .*\[1.0, -1.0\]"),
        ({"past_h": ["a"]}, "past_h must be a list of 1 numbers"),
        ({"smallest_axis_m": 0.0}, "smallest_axis_m and past_h must be above 0, got 0.05, 0.0"),
        ({"position_frequencies": 0, "features": "none"}, "all Gaussians are alike"),
    ],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        EnergyNetwork(**options)


def test_of_materials_from_the_table_none_are_compared_with_it():
    weights = {"smooth": 1.0, "physical": 0.01, "pinn": 0.0}
    assert EnergyNetwork(weights=weights).options.penalties == {"smooth": 1.0, "physical": 0.01}
    assert EnergyNetwork(weights=weights, attributes="table").options.penalties == {"smooth": 1.0}


@pytest.mark.parametrize(
    ("options", "labelled"),
    [
        ({}, False),
        ({"features": "labels"}, True),
        ({"attributes": "table"}, True),
        ({"weights": {"physical": 1.0}}, True),
    ],
)
def test_classes_are_asked_for_where_they_are_used(options, labelled):
    assert ("labels" in EnergyNetwork(**options).needs) == labelled


def test_only_what_the_balance_is_asked_for_needs_metres():
    assert "metres" not in EnergyNetwork(weights={"smooth": 1.0}).needs
    assert "metres" in EnergyNetwork(weights={"ode": 1.0}).needs


def test_inputs_of_a_gaussian_are_its_place_and_its_features():
    assert EnergyNetwork(position_frequencies=2, features="labels").options.own_inputs == 12 + len(CLASSES)
    assert EnergyNetwork(position_frequencies=2, features="none", feature_size=5).options.own_inputs == 12
