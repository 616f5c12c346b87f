import re
from datetime import datetime, timedelta

import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.timestamps import (
    dji_time,
    seconds_of_day,
    time_by_pattern,
    times_from_csv,
    unrolled_midnight,
    zone_of,
)


def test_nine_digits_are_hours_minutes_seconds_and_thousandths():
    assert seconds_of_day("153824825") == 15 * 3600 + 38 * 60 + 24 + 0.825
    assert seconds_of_day("000000001") == 0.001


@pytest.mark.parametrize("digits", ["240000000", "126000000", "12345678", "1234567890", "12345678x"])
def test_digits_that_are_no_time_of_day_are_refused(digits):
    with pytest.raises(ValueError, match="is no"):
        seconds_of_day(digits)


@pytest.mark.parametrize("name", ["+02:00", "+0200", "Africa/Maputo"])
def test_zones_are_offsets_or_names(name):
    assert datetime(2024, 1, 11, 12, tzinfo=zone_of(name, "zone")).utcoffset() == timedelta(hours=2)


@pytest.mark.parametrize("name", ["", "+99:00", "Mars/Crater", "../zone"])
def test_what_is_no_zone_is_refused_with_its_setting(name):
    with pytest.raises(SceneError, match=f"weather_zone={re.escape(name)} is no time zone"):
        zone_of(name, "weather_zone")


def test_a_recording_over_midnight_continues():
    times, passed = unrolled_midnight([60.0, 86340.0, 0.5, 86370.0])
    assert passed
    assert times == [86460.0, 86340.0, 86400.5, 86370.0]


@pytest.mark.parametrize("times", [[3600.0, 3700.0, 90.0], [50000.0], [], [9 * 3600.0, 23 * 3600.0]])
def test_a_recording_within_a_day_is_left_alone(times):
    assert unrolled_midnight(times) == (times, False)


def test_dji_names_hold_the_time_to_the_second():
    first = dji_time("images/DJI_20240806173449_0008_T.png")
    assert dji_time("DJI_20240807000003_0009_T.JPG") - first == 6 * 3600 + 25 * 60 + 14
    assert dji_time("frame_001.png") is None


def test_a_pattern_picks_seconds_and_formats():
    assert time_by_pattern("s/t_12.5_x.png", r"t_([\d.]+)_", None) == 12.5
    assert time_by_pattern("000001500.png", r"\d{9}", "HHMMSSmmm") == 1.5
    a = time_by_pattern("2024-01-01T00-00-01.png", r"(.*)\.png", "%Y-%m-%dT%H-%M-%S")
    b = time_by_pattern("2024-01-01T00-01-00.png", r"(.*)\.png", "%Y-%m-%dT%H-%M-%S")
    assert b - a == 59


def test_a_pattern_that_fails_names_the_image():
    with pytest.raises(SceneError, match=r"data.time_regex 'x\(\\\\d\+\)' does not match the image name a.png"):
        time_by_pattern("a.png", r"x(\d+)", None)
    with pytest.raises(SceneError, match="a.png: 'a' is no time of the form seconds"):
        time_by_pattern("a.png", r"(a)", None)


def test_a_table_gives_seconds_or_dates(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("file,utc,s\nA_1,2024-08-06T15:35:05.376048,1.5\nA_2.png,2024-08-06T15:35:06.376048,2\n")
    assert times_from_csv(table, "file", "s") == {"A_1": 1.5, "A_2.png": 2.0}
    dates = times_from_csv(table, "file", "utc")
    assert dates["A_2.png"] - dates["A_1"] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("cells", "told"),
    [
        (
            ("2024-08-06T15:35:05Z", "2024-08-06T15:36:05"),
            "line 3: .*36:05' in column t is a date-time without a time zone, and",
        ),
        (
            ("2024-08-06T15:35:05", "2024-08-06T15:36:05+02:00"),
            "line 3: .* with a time zone, and .* line 2 is .* without",
        ),
        (("0.5", "2024-08-06T15:36:05"), "line 3: .* without a time zone, and '0.5' in line 2 is a number of seconds"),
    ],
)
def test_a_table_has_one_clock(tmp_path, cells, told):
    table = tmp_path / "times.csv"
    table.write_text("file,t\n" + "\n".join(f"A_{i}.png,{cell}" for i, cell in enumerate(cells)))
    with pytest.raises(SceneError, match=told):
        times_from_csv(table, "file", "t")
    table.write_text(f"file,t\nA_0.png,{cells[0]}\nA_1.png,{cells[0]}")
    assert len(times_from_csv(table, "file", "t")) == 2


def test_a_table_names_missing_columns_and_bad_cells(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("file,s\na,soon\n")
    with pytest.raises(SceneError, match="data.time_csv_time=when: .*t.csv has no such column; it has file, s"):
        times_from_csv(table, "file", "when")
    with pytest.raises(SceneError, match="line 2: 'soon' in column s is neither seconds nor a date-time"):
        times_from_csv(table, "file", "s")


def test_a_name_or_a_cell_with_an_underscore_is_no_number(tmp_path):
    """Python takes 1_5 for 15."""
    table = tmp_path / "t.csv"
    table.write_text("file,s\na,1_5\n")
    with pytest.raises(SceneError, match="line 2: '1_5' in column s is neither seconds nor a date-time"):
        times_from_csv(table, "file", "s")
    with pytest.raises(SceneError, match="'1_5' is no time of the form seconds"):
        time_by_pattern("frame_1_5.png", r"frame_(.+)\.png", None)
