"""Names of quantities as people read them."""

from dataclasses import replace

import numpy as np
from weathered import make_scene

from heatsplat.io.quantities import Clock, clock_of, impossible, moment, words_and_unit
from heatsplat.thermal.land_cover import ATTRIBUTES


def test_the_longest_suffix_is_the_unit():
    assert words_and_unit("time_constant_s") == ("time constant", "s")
    assert words_and_unit("source_c_per_h") == ("source", "°C/h")
    assert words_and_unit("heat_loss_w_m2_k") == ("heat loss", "W/(m² K)")
    assert words_and_unit("u_value_w_m2_k") == ("U-value", "W/(m² K)")
    assert words_and_unit("emissivity") == ("emissivity", "")
    assert words_and_unit("wind_m_s") == ("wind", "m/s") and words_and_unit("height_m") == ("height", "m")
    assert words_and_unit("heat_capacity_j_m3_k") == ("heat capacity", "J/(m³ K)")


def test_what_thermogs_learns_has_units_too():
    assert [words_and_unit(name) for name in ATTRIBUTES] == [
        ("emissivity", ""),
        ("absorptivity", ""),
        ("convection", "W/(m² K)"),
        ("heat capacity", "J/(m³ K)"),
    ]


def test_times_are_told_in_the_unit_that_suits_them():
    assert (moment(90.04), moment(-5.0), moment(-3600.0)) == ("90.0 s", "-5.0 s", "-60.0 min")
    assert (moment(39743.4), moment(86902.0), moment(6 * 86400.0)) == ("11.04 h", "24.14 h", "6.00 d")


def test_the_clock_stands_beside_a_time_where_it_is_known():
    assert moment(39743.4, Clock(1722965689.0)) == "11.04 h (2024-08-07 04:37 UTC)"
    assert Clock(1722965689.0, zone="").at(0.0, "seconds") == "2024-08-06 17:34:49"


def test_times_that_no_calendar_has_are_told_without_a_date():
    assert moment(1.72e12, Clock(1722965689.0)) == "19907407.41 d"  # milliseconds that were taken for seconds
    assert moment(-1e18, Clock(1722965689.0)) == "-11574074074074.07 d"


def test_the_clock_is_that_of_the_weather_or_of_the_camera():
    scene = replace(make_scene(), notes={"clock_at_zero_s": 5.0})
    assert clock_of(scene) is None  # whose weather counts from some zero of its own
    assert clock_of(replace(scene, weather=None)) == Clock(5.0, zone="")
    assert clock_of(replace(scene, weather=replace(scene.weather, notes={"utc_at_zero_s": 7.0}))) == Clock(7.0)


def test_shares_beyond_what_is_possible_are_told():
    values = np.array([0.5, 1.5, 2.0, np.nan])
    assert impossible("absorptivity", values) == "67 % above 1, which is impossible"
    assert impossible("absorptivity", values, np.array([98.0, 1.0, 1.0, 9.0])) == ""
    assert impossible("u_value_w_m2_k", -values) == "100 % below 0, which is impossible"
    assert impossible("core_coupling", values) == ""


def test_suffixes_of_massive_walls():
    assert words_and_unit("effusivity_j_m2_k_s05") == ("effusivity", "J/(m² K √s)")
