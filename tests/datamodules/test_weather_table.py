"""Tables of the weather as people and programs write them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from heatsplat.datamodules.sun import Site, clear_sky
from heatsplat.datamodules.weather import make_weather, read_weather
from heatsplat.datamodules.weather_table import utc_seconds, write_weather

SITE = Site(47.0, 9.0, 500.0)
# 11 July 2024, midnight UTC.
MIDNIGHT_S = 1720656000.0


def test_columns_are_known_by_name_and_unit(table):
    path = table(
        "# from the station on the roof",
        "Time;Air temperature [K];Wind (km/h);RH %;GHI (W/m²);Pressure Pa;Remark",
        "2024-07-11T06:00:00Z;290,15;36,0;55;120;95500;fine",
        "2024-07-11T09:00:00+02:00;291,15;18,0;50;200;95400;",
    )
    weather = read_weather(path)
    assert weather.times_s.tolist() == [MIDNIGHT_S + 6 * 3600, MIDNIGHT_S + 7 * 3600]
    assert weather.air_c.tolist() == pytest.approx([17.0, 18.0])
    assert weather.wind_m_s.tolist() == pytest.approx([10.0, 5.0])
    assert weather.humidity_percent.tolist() == [55.0, 50.0]
    assert weather.irradiance_w_m2.tolist() == [120.0, 200.0]
    assert weather.pressure_hpa.tolist() == pytest.approx([955.0, 954.0])
    assert weather.notes["unused_columns"] == "Remark"
    assert "latitude and longitude are not known" in weather.notes["sun"] and weather.sun is None


@pytest.mark.parametrize(
    ("header", "value", "name", "expected"),
    [
        ("air_f", "50", "air_c", 10.0),
        ("temperature_2m (°C)", "12.5", "air_c", 12.5),
        ("wind_speed_kn", "10", "wind_m_s", 5.14444),
        ("wind_mph", "10", "wind_m_s", 4.4704),
        ("relative_humidity_fraction", "0.4", "humidity_percent", 40.0),
        ("shortwave_radiation (W m-2)", "7", "irradiance_w_m2", 7.0),
        ("solar_kw_m2", "0.5", "irradiance_w_m2", 500.0),
        ("pressure_kpa", "101.3", "pressure_hpa", 1013.0),
        ("wind m s-1", "3", "wind_m_s", 3.0),
        ("Air temperature [degC]", "12.5", "air_c", 12.5),
        ("air_temperature_celsius", "12.5", "air_c", 12.5),
        ("T_air (deg F)", "50", "air_c", 10.0),
        ("Wind speed [kt]", "10", "wind_m_s", 5.14444),
        ("GHI (W/m^2)", "7", "irradiance_w_m2", 7.0),
        ("ghi_Wm-2", "7", "irradiance_w_m2", 7.0),
        ("Pressure (mb)", "1013", "pressure_hpa", 1013.0),
        ("GHI [W m⁻²]", "7", "irradiance_w_m2", 7.0),
        ("wind [m s⁻¹]", "3", "wind_m_s", 3.0),
    ],
)
def test_units_become_ours(table, header, value, name, expected):
    path = table(f"time_s,{header}", f"0,{value}", f"60,{value}")
    assert getattr(read_weather(path), name).tolist() == pytest.approx([expected] * 2)


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
def test_columns_are_separated_in_four_ways(table, delimiter):
    rows = (["utc", "air_c"], ["2024-07-11 00:00:00", "10.5"], ["2024-07-11 01:00:00", "11.5"])
    weather = read_weather(table(*(delimiter.join(row) for row in rows)))
    assert weather.times_s[0] == MIDNIGHT_S  # a column called utc needs no zone
    assert weather.air_c.tolist() == [10.5, 11.5]


def test_what_stands_before_the_names_of_columns_is_skipped(table):
    path = table(
        "latitude,longitude,elevation,timezone",  # as Open-Meteo writes it
        "50.1,8.7,110.0,GMT",
        "",
        "time,temperature_2m (°C),cloud_cover (%)",
        "2024-07-11T00:00,10.5,0",
        "2024-07-11T01:00,11.5,0",
    )
    assert read_weather(path, zone="UTC").air_c.tolist() == [10.5, 11.5]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_tables_that_excel_saves_are_read(tmp_path, encoding):
    path = tmp_path / "weather.csv"
    lines = ("sep=;", "Time_s;Air temperature (°C);GHI (W/m²)", "0,5;-3,25;120", '60,5;"4,75";130,5')
    path.write_text("\r\n".join(lines), encoding=encoding)
    weather = read_weather(path)
    assert weather.times_s.tolist() == [0.5, 60.5]
    assert weather.air_c.tolist() == [-3.25, 4.75] and weather.irradiance_w_m2.tolist() == [120.0, 130.5]


@pytest.mark.parametrize(
    ("text", "zone", "hour"),
    [
        ("2024-07-11T02:00:00+02:00", None, 0.0),
        ("2024-07-11T02:00", "Europe/Zurich", 0.0),
        ("2024-07-11T02:00", "+02:00", 0.0),
        ("2024-07-11 02:00:00", "UTC", 2.0),
        ("2024-07-10T21:30-04:00", "Europe/Zurich", 1.5),
        (str(MIDNIGHT_S), None, 0.0),
    ],
)
def test_time_zones(text, zone, hour):
    assert utc_seconds(text, zone, "here") == MIDNIGHT_S + 3600 * hour


@pytest.mark.parametrize("lit", [True, False])
def test_recorded_clouds_are_written_and_read_back(tmp_path, lit):
    """By night, too, and where no light tells of them; those that light tells of are no column."""
    times = MIDNIGHT_S + 3600.0 * np.arange(25)
    light = {"irradiance_w_m2": 0.8 * clear_sky(SITE, times)} if lit else {}
    columns = {"air_c": np.full(25, 15.0), "cloud_cover": np.linspace(0.0, 1.0, 25), **light}
    for site in (SITE, None):
        weather = make_weather(times, columns, site=site)
        write_weather(tmp_path / "weather.csv", weather)
        again = read_weather(tmp_path / "weather.csv", site=site)
        assert (
            torch.allclose(again.clouds, weather.clouds, atol=1e-9) and again.notes["clouds"] == weather.notes["clouds"]
        )
    if lit:
        write_weather(tmp_path / "weather.csv", make_weather(times, {"air_c": columns["air_c"], **light}, site=SITE))
        assert "cloud" not in (tmp_path / "weather.csv").read_text()


def test_a_change_to_winter_time_does_not_move_the_record():
    """An hour apart by the clock of Zurich, two hours apart on the sun's."""
    first, last = (utc_seconds(f"2024-10-27T0{h}:30", "Europe/Zurich", "here") for h in (1, 3))
    assert last - first == 3 * 3600.0


def test_a_column_that_may_be_one_in_another_unit_is_told(table, caplog):
    """Wind has a direction, too; but a GHI in units that are not known must not become a cloudless sky without a word."""
    rows = ["time_s,air_c,wind_m_s,wind_direction,ghi_mj_m2", "0,1,2,3,4", "60,1,2,3,4"]
    weather = read_weather(table(*rows))
    assert weather.irradiance_w_m2 is None and weather.notes["unused_columns"] == "wind_direction, ghi_mj_m2"
    assert "column 'ghi_mj_m2' is not used; if it is irradiance_w_m2 in another unit, call it that" in caplog.text
    assert "wind_direction" not in caplog.text


def test_a_written_record_is_read_back(tmp_path):
    times = MIDNIGHT_S + 3600.0 * np.arange(25)
    columns = {name: np.full(25, value) for name, value in (("air_c", 15.0), ("wind_m_s", 2.0), ("rain_mm_h", 0.5))}
    columns["irradiance_w_m2"] = 0.8 * clear_sky(SITE, times)
    weather = make_weather(times, columns, site=SITE)
    write_weather(tmp_path / "weather.csv", weather)
    again = read_weather(tmp_path / "weather.csv", site=SITE)
    assert torch.equal(again.times_s, weather.times_s)
    for name in ("air_c", "wind_m_s", "irradiance_w_m2", "rain_mm_h", "direct_w_m2", "diffuse_w_m2", "sun"):
        assert torch.allclose(getattr(again, name), getattr(weather, name), atol=1e-6)
