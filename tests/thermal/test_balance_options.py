"""Options of the balance of heat: what is refused, and what others follow from."""

import math

import pytest

from heatsplat.thermal.energy_balance import EnergyBalance


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solution": "best"}, "solution must be one of auto, linear, corrected, got 'best'"),
        ({"sky": "blue"}, "sky must be one of auto, brutsaert"),
        ({"normals": "up"}, "normals must be one of seen, level, got 'up'"),
        ({"nodes": 3}, "nodes must be one of 1, 2, got '3'"),
        (
            {"semi_infinite": True, "solution": "corrected"},
            "semi_infinite works only with the linearised balance: give solution",
        ),
        ({"nodes": 2, "semi_infinite": True}, "semi_infinite and nodes=2 exclude each other"),
        ({"convection_error": 1.0}, "convection_error must lie in"),
        ({"exchange": "table"}, "exchange must be one of learned, iso_6946"),
        ({"exchange": "iso_6946", "sky": None}, "exchange=iso_6946 is that with sky and wind"),
        ({"exchange": [5.0, 2.5], "wind": False}, r"exchange=\[5.0, 2.5\] is that with sky and wind"),
        (
            {"exchange": 5.0},
            r"convection of still air in W/\(m² K\), above 0, with what each m/s of wind adds .* got 5.0",
        ),
        ({"exchange": [5.0]}, r"such as \[5.0,2.5\]; got \[5.0\]"),
        ({"exchange": [0.0, 4.0]}, "above 0"),
        ({"exchange": [5.0, -1.0]}, "exchange must be learned, iso_6946, or"),
        ({"exchange": [5.0, math.nan]}, "exchange must be learned, iso_6946, or"),
        ({"exchange": [5.0, 2500.0]}, "both up to 100"),
        ({"indoor_c": 20.0}, "indoor_c has no effect without heat from within: give inner=true"),
        ({"albedo": 1.0}, r"albedo must lie in \(0, 1\), or be null"),
        ({"shadows": True, "sun": False}, "give sun=true, normals=seen"),
        ({"clouds": True, "sky": None}, "clouds are of the sky: give sky=auto"),
        ({"rain": 0.0}, "rain must be above 0 mm, or null for surfaces that stay dry, got 0.0"),
        ({"rain": 0.3, "solution": "linear"}, "give solution=corrected and indoor_c=null, or rain=null"),
        ({"rain": 0.3, "inner": True, "indoor_c": 20.0}, "mean losses of walls leave them out"),
        ({"emissivity": 0.0}, r"emissivity must lie in \(0, 1\], got 0.0"),
    ],
)
def test_options_that_are_unknown_or_do_not_go_together_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        EnergyBalance(**options)


@pytest.mark.parametrize(
    ("options", "linear", "windy", "convection"),
    [
        ({}, False, True, None),
        ({"semi_infinite": True}, True, True, None),
        ({"solution": "linear", "wind": False}, True, False, None),
        ({"exchange": "iso_6946"}, False, True, (4.0, 4.0)),
        ({"exchange": [5, 0]}, False, False, (5.0, 0.0)),
        ({"exchange": [5, 0], "wind": False}, False, False, (5.0, 0.0)),
    ],
)
def test_solution_wind_and_convection_follow_from_what_is_given(options, linear, windy, convection):
    derived = EnergyBalance(**options).options
    assert (derived.linear, derived.windy, derived.convection) == (linear, windy, convection)
