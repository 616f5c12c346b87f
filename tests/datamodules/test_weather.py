"""Weather records: reading tables, checking them, the sun, and the weather at a moment."""

from __future__ import annotations

import logging
import math
from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneData, SceneError, Weather
from heatsplat.datamodules.sun import Site, clear_sky, clouds, split_irradiance, sun_directions
from heatsplat.datamodules.weather import make_weather, read_weather, with_weather
from heatsplat.datamodules.weather_table import utc_seconds

SITE = Site(47.0, 9.0, 500.0)
# 11 July 2024, midnight UTC.
MIDNIGHT_S = 1720656000.0


def test_samples_are_sorted_merged_and_gaps_are_bridged_and_told(table):
    path = table(
        "time_s,air_c,wind_m_s",
        "1800,12,NaN",
        "0,10,1",
        "3600,14,3",
        "1800,14,",
        "600,,2",
        "4200,,4",
    )
    weather = read_weather(path)
    assert weather.times_s.tolist() == [0.0, 600.0, 1800.0, 3600.0]
    assert weather.air_c.tolist() == pytest.approx([10.0, 11.0, 13.0, 14.0])
    assert weather.wind_m_s.tolist() == pytest.approx([1.0, 2.0, 2.4, 3.0])
    notes = weather.notes
    assert (
        "sorted" in notes["unsorted"] and "averaged" in notes["duplicates"] and "1 samples at the ends" in notes["cut"]
    )
    assert notes["gaps"] == {"air_c": "1 values interpolated", "wind_m_s": "1 values interpolated"}
    assert notes["missing"] == "humidity_percent, irradiance_w_m2, pressure_hpa"
    assert notes["ranges"]["air_c"] == [10.0, 14.0] and notes["span_h"] == 1.0


def test_a_column_that_shortens_the_record_is_named_and_a_short_rest_is_worth_a_warning(table, caplog):
    hours = [f"{600 * i},{10 + i},{2 if 6 <= i < 12 else ''}" for i in range(20)]
    weather = read_weather(table("time_s,air_c,wind_m_s", *hours))
    assert weather.times_s.tolist()[:1] + weather.times_s.tolist()[-1:] == [3600.0, 6600.0]
    assert weather.notes["cut"] == "14 samples at the ends lack wind_m_s and are left out"
    assert (
        "weather.csv: 14 samples at the ends lack wind_m_s" in caplog.text
        and "second 3600 to second 6600" in caplog.text
    )


def test_a_sample_that_a_column_lacks_at_the_end_is_no_warning(table, caplog):
    lines = [f"{600 * i},{10 + i},{2 if i < 19 else ''}" for i in range(20)]
    assert "lack wind_m_s" in read_weather(table("time_s,air_c,wind_m_s", *lines)).notes["cut"] and not caplog.text


def test_a_column_without_values_counts_as_missing(table):
    weather = read_weather(table("time_s,air_c,wind_m_s", "0,10,", "60,11,NA"))
    assert weather.wind_m_s is None and "wind_m_s" in weather.notes["missing"]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["time_s,air_c"], "holds no weather"),
        (["time_s,air_c", "0,1", "60,warm"], "line 3: 'warm' in column air_c is no number"),
        (["time_s,air_c", "0,1", "60"], "line 3: 1 cells for 2 columns"),
        (["sep=;", "time_s;air_c", "0;1", "60;1,2,3"], "weather.csv, line 4: '1,2,3' in column air_c is no number"),
        (
            ["time_s,air_c", "0,1,5", "60,2,5"],
            "weather.csv, line 2: 3 cells for 2 columns; separate columns by semicolons",
        ),
        (
            ["time,air_c", "1720656000000,1", "1720659600000,2"],
            "line 2, column time: .* divide milliseconds since 1970 by 1000",
        ),
        (["time_s,humidity_percent", "0,0.5", "60,0.6"], "humidity_percent is 0.6 at the most, .* humidity_fraction"),
        (["hour,air_c", "0,1", "1,2"], "no column of times .* it has hour, air_c"),
        (["time_s,snow_cm", "0,1", "1,2"], "none of the columns air_c, wind_m_s, .* it has time_s, snow_cm"),
        (
            ["time_s,temperature", "0,1", "1,2"],
            "column 'temperature' has no unit; name it one of temperature_c, temp.*_k",
        ),
        (
            ["time_s,air_c,GHI [MJ/m2]", "0,1,2", "1,2,2"],
            r"column 'GHI \[MJ/m2\]' has an unknown unit; name it one of ghi_w_m2, ghi_kw_m2",
        ),
        (["time_s,air_c,temp_k", "0,1,2", "1,2,2"], "'air_c' and 'temp_k' are both air_c"),
        (
            ["time,air_c", "2024-07-11T06:00,1", "2024-07-11T07:00,1"],
            "line 2, column time: .* has no time zone. .*weather_zone=UTC",
        ),
        (["time,air_c", "noon,1", "1,1"], "line 2, column time: 'noon' is neither seconds nor a date-time"),
        (["time_s,air_c", "0,1", "1720656000,1"], "use one clock"),
        (["time_s,irradiance_w_m2", "0,10", "60,-40"], "irradiance_w_m2 is -40 at second 60 .* between 0 and 1600"),
        (["time_s,humidity_percent", "0,50", "60,104"], "humidity_percent is 104 at second 60 .* between 0 and 100"),
        (["time_s,wind_m_s", "0,-1", "60,1"], "wind_m_s is -1 at second 0"),
        (
            ["time_s,air_c", "0,290", "60,291"],
            "air_c is 290 at second 0 .2 such values.; .* Check the column and its unit",
        ),
        (["time_s,air_c", "0,1", "36000,2"], "air_c has no value for 10 hours after second 0, longer than the 3 hours"),
        (
            ["time_s,air_c,wind_m_s", "0,1,", "60,1,", "120,,2", "180,,3"],
            "wind_m_s begins at second 120, when air_c has ended .second 60., so its columns have no span",
        ),
    ],
)
def test_bad_tables_are_refused_by_line_and_column(table, lines, message):
    with pytest.raises(SceneError, match=message):
        read_weather(table(*lines))


def test_a_missing_table_and_a_bad_zone_are_named(tmp_path, table):
    with pytest.raises(SceneError, match="there is no weather table"):
        read_weather(tmp_path / "none.csv")
    with pytest.raises(SceneError, match="weather_zone=Mars/Crater is no time zone; give UTC"):
        read_weather(table("time,air_c", "2024-07-11T06:00,1", "2024-07-11T07:00,1"), zone="Mars/Crater")


def test_longer_gaps_may_be_allowed(table):
    path = table("time_s,air_c", "0,1", "36000,2")
    assert read_weather(path, max_gap_s=12 * 3600.0).air_c.tolist() == [1.0, 2.0]


def test_an_unlit_pyranometer_may_read_a_little_less_than_nothing(table):
    weather = read_weather(table("time_s,irradiance_w_m2", "0,-2.5", "60,10"))
    assert weather.irradiance_w_m2.tolist() == [0.0, 10.0]
    assert "1 values between -5 and 0" in weather.notes["irradiance_offset"]


def hourly(hours=25, **columns):
    times = MIDNIGHT_S + 3600.0 * np.arange(hours)
    return times, {name: np.full(hours, value) for name, value in columns.items()}


def test_the_sun_stands_where_astronomy_says():
    """Equinox at the equator: rises in the east, passes overhead, sets in the west; and midsummer noon at 47° north."""
    equinox = utc_seconds("2024-03-20T00:00:00Z", None, "")
    site = Site(0.0, 0.0)
    # True noon of that day is 12:07:30 at Greenwich.
    morning, noon, evening = sun_directions(site, equinox + 3600 * np.array([7.125, 12.125, 17.125]))
    assert morning == pytest.approx([math.cos(math.radians(15)), 0.0, math.sin(math.radians(15))], abs=0.01)
    assert noon == pytest.approx([0.0, 0.0, 1.0], abs=0.01)
    assert evening[0] == pytest.approx(-morning[0], abs=0.01)
    solstice = utc_seconds("2024-06-20T12:00:00Z", None, "") + 120.0
    direction = sun_directions(Site(47.0, 0.0), np.array([solstice]))[0]
    assert direction == pytest.approx([0.0, -math.cos(math.radians(66.44)), math.sin(math.radians(66.44))], abs=0.005)
    assert np.linalg.norm(direction) == pytest.approx(1.0)


def test_world_axes_turn_the_sun():
    when = MIDNIGHT_S + 3600.0 * np.array([6.0, 11.0, 23.0])
    east, north, up = sun_directions(SITE, when).T
    # y up, x north (so that z is east), as some reconstructions have it.
    turned = sun_directions(Site(47.0, 9.0, 500.0, up=(0.0, 2.0, 0.0), north=(3.0, 0.5, 0.0)), when)
    assert turned == pytest.approx(np.stack([north, up, east], axis=1))


@pytest.mark.parametrize(("east", "west"), [(210.0, -150.0), (180.0, -180.0), (360.0, 0.0)])
def test_longitudes_are_counted_on_around_the_earth(east, west):
    when = MIDNIGHT_S + 3600.0 * np.arange(24)
    light = clear_sky(Site(20.0, east), when)
    assert light.max() > 500.0
    assert np.array_equal(light, clear_sky(Site(20.0, west), when))
    assert np.array_equal(sun_directions(Site(20.0, east), when), sun_directions(Site(20.0, west), when))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"latitude": 95.0}, "latitude=95.0 and data.longitude=9.0 .* are no place"),
        ({"longitude": 361.0}, "longitude=361.0 .* are no place .*-180 to 360"),
        ({"north": (0.0, 0.0, 2.0)}, "data.north=.* points up"),
        ({"up": (0.0, 0.0, 0.0)}, "data.up and data.north are three numbers"),
    ],
)
def test_impossible_sites_are_refused(options, message):
    with pytest.raises(SceneError, match=message):
        Site(**{"latitude": 47.0, "longitude": 9.0, **options})


def test_light_is_split_so_that_it_adds_up_and_night_is_exactly_zero():
    when = MIDNIGHT_S + 600.0 * np.arange(145)
    bright = clear_sky(SITE, when)
    height = sun_directions(SITE, when)[:, 2]
    assert 800.0 < bright.max() < 1000.0
    for share in (1.0, 0.3):
        direct, diffuse = split_irradiance(SITE, when, share * bright)
        assert (direct[height <= 0] == 0).all() and (diffuse[height <= 0] == 0).all()
        day = height > 0.06
        level = direct * height + diffuse
        assert np.abs(level - share * bright)[day].max() < 1.0
        assert (direct >= 0).all() and (diffuse >= 0).all()
    assert (bright[height <= 0] == 0).all()
    clear, _ = split_irradiance(SITE, when, bright)
    assert clear.max() > 600.0 and direct.max() < 100.0  # of a cloudy sky little comes straight


def test_clouds_are_told_by_the_light_of_an_hour_and_by_night_lie_between_dusk_and_dawn():
    when = MIDNIGHT_S + 600.0 * np.arange(145)
    bright = clear_sky(SITE, when)
    noon, night = slice(66, 79), slice(0, 18)
    assert np.abs(clouds(SITE, when, bright)).max() < 1e-12
    assert np.allclose(clouds(SITE, when, 0.3 * bright), 0.7)
    assert (clouds(SITE, when, 1.2 * bright) == 0.0).all()  # light from the edges of clouds is not less than none
    shaded = bright.copy()
    shaded[72] = 0.0  # ten minutes of an hour, as two halves of neighbouring steps
    assert clouds(SITE, when, shaded)[noon].max() == pytest.approx(1 / 6, abs=0.01)
    evening = np.where(when > when[72], 0.5, 1.0) * bright
    told = clouds(SITE, when, evening)
    assert told[night].max() < 1e-12 and told[-1] == pytest.approx(0.5)
    assert clouds(SITE, when[:18], bright[:18]) is None  # nothing but night


def test_a_record_tells_clouds_by_its_cover_or_by_its_light(table):
    measured = read_weather(table("utc,ghi_w_m2,air_c", *day("300.0,15")), site=SITE)
    assert measured.clouds.max() > 0.6 and "Crawford" in measured.notes["clouds"]
    covered = read_weather(table("utc,cloud cover (%),ghi_w_m2", *day("100,300.0")), site=SITE)
    assert (
        torch.allclose(covered.clouds, torch.tensor(0.75, dtype=torch.float64)) and "Kasten" in covered.notes["clouds"]
    )
    by_eighths = read_weather(table("utc,cloud_cover_oktas", *day("4")))
    assert torch.allclose(by_eighths.clouds, torch.tensor(0.75 * 0.5**3.4, dtype=torch.float64))
    assert read_weather(table("utc,air_c", *day("15")), site=SITE).clouds is None  # light of a cloudless sky tells none
    with pytest.raises(SceneError, match="cloud_cover is 1.2"):
        read_weather(table("utc,cloud_cover_percent", *day("120")))


def test_recorded_clouds_take_their_share_of_light_that_was_not_measured(table):
    clear = read_weather(table("utc,air_c", *day("15")), site=SITE)
    dull = read_weather(table("utc,air_c,cloud_cover_oktas", *day("15,8")), site=SITE)
    torch.testing.assert_close(dull.irradiance_w_m2, 0.25 * clear.irradiance_w_m2)
    assert dull.direct_w_m2.max() < 0.1 * clear.direct_w_m2.max()  # the light that is left comes from all over the sky
    assert "clouds take" in dull.notes["irradiance"] and "clouds" not in clear.notes["irradiance"]


@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("minutes", [60, 10])
def test_an_hour_that_clocks_show_twice_comes_twice(table, minutes, step):
    first_s, step_s = 1729980000.0, 60.0 * minutes  # 2024-10-26, 22:00 UTC; at 1:00 UTC summer time ends in Berlin
    times_s = [first_s + k * step_s for k in range(6 * 60 // minutes)]
    shown = [datetime.fromtimestamp(time_s, ZoneInfo("Europe/Berlin")).replace(tzinfo=None) for time_s in times_s]
    lines = [f"{time.isoformat()},{k}" for k, time in enumerate(shown)]
    weather = read_weather(table("time,air_c", *lines[::step]), zone="Europe/Berlin")
    assert weather.times_s.tolist() == times_s
    assert weather.air_c.tolist() == [*range(len(times_s))]
    assert not {"unsorted", "duplicates"} & weather.notes.keys()


def test_rain_is_a_rate_or_what_fell_since_the_sample_before(table):
    by_rate = read_weather(table("utc,rain_mm_h", *day("2.5")))
    assert (by_rate.rain_mm_h == 2.5).all()
    inches = read_weather(table("utc,rainfall (in/h),air_c", *day("0.1,15")))
    assert torch.allclose(inches.rain_mm_h, torch.tensor(2.54).double())
    halves = [f"2024-07-11T06:{minute:02d}:00Z,{mm}" for minute, mm in ((0, 0), (10, 0.5), (30, 2), (40, ""))]
    fallen = read_weather(table("utc,Precipitation [mm]", *halves))
    assert torch.allclose(fallen.rain_mm_h, torch.tensor([0.0, 2.0, 8.0, 0.0]).double())
    assert torch.trapezoid(fallen.rain_mm_h, fallen.times_s / 3600.0).item() == pytest.approx(2.5)  # mm, all that fell
    assert (
        fallen.notes["dry"] == "1 samples without rain_mm are taken for dry"
        and "since the sample" in fallen.notes["rain"]
    )
    assert read_weather(table("utc,air_c", *day("15"))).rain_mm_h is None
    with pytest.raises(SceneError, match="tells rain twice, as rain_mm_h and as rain_mm; keep one"):
        read_weather(table("utc,rain_mm_h,precipitation_mm", *day("1,1")))
    with pytest.raises(SceneError, match="column 'rain' has no unit; name it one of rain_mm_h"):
        read_weather(table("utc,rain", *day("1")))
    with pytest.raises(SceneError, match="rain_mm_h is -1"):
        read_weather(table("utc,rain_mm_h", *day("-1")))


def day(cells: str) -> list[str]:
    """A line for every hour of daylight."""
    return [f"2024-07-11T{hour:02d}:00:00Z,{cells}" for hour in range(6, 18)]


def test_the_sun_shines_until_it_sets():
    """Minutes around a sunrise: light comes as soon as the sun, refracted by air, stands above the horizon."""
    when = MIDNIGHT_S + 3600.0 * 3 + 60.0 * np.arange(120)
    height = np.degrees(np.arcsin(sun_directions(SITE, when)[:, 2]))
    bright = clear_sky(SITE, when)
    low = (height > 0.7) & (height < 4.9)
    assert low.sum() > 20 and (bright[low] > 0).all() and (np.diff(bright[low]) > 0).all()
    direct, diffuse = split_irradiance(SITE, when, bright)
    assert (direct[low] + diffuse[low] > 0).all()


def test_records_are_resampled_for_the_sun_and_keep_their_samples():
    times, columns = hourly(air_c=15.0, wind_m_s=2.0)
    columns["air_c"] = 15.0 + np.sin(np.arange(25))
    weather = make_weather(times, columns, site=SITE)
    assert weather.times_s.diff().max() <= 600.0 and len(weather.times_s) == 24 * 6 + 1
    assert weather.air_c[::6].tolist() == pytest.approx(columns["air_c"].tolist())
    assert weather.sun.norm(dim=1).allclose(torch.ones(145, dtype=torch.float64))
    assert "cloudless" in weather.notes["irradiance"] and "irradiance_w_m2" in weather.notes["missing"]
    assert weather.irradiance_w_m2.max() > 800.0
    assert 0.3 < weather.notes["night_share"] < 0.4
    night = weather.sun[:, 2] <= 0
    for name in ("direct_w_m2", "diffuse_w_m2", "irradiance_w_m2"):
        assert (getattr(weather, name)[night] == 0).all()


def test_a_night_without_sun_is_told(caplog):
    times, columns = hourly(3, air_c=15.0)
    with caplog.at_level(logging.WARNING):
        weather = make_weather(times - 3 * 3600.0, columns, site=SITE)
    assert "the sun never rises" in weather.notes["night_only"] and "the sun never rises" in caplog.text
    assert weather.direct_w_m2.abs().max() == 0.0 and weather.notes["night_share"] == 1.0


def test_sunlight_at_midnight_means_a_wrong_zone():
    times, columns = hourly(irradiance_w_m2=0.0)
    columns["irradiance_w_m2"][:4] = 400.0
    with pytest.raises(SceneError, match="400 W/m² of sunlight at 2024-07-11T00:00:00.* Check the time zone"):
        make_weather(times, columns, site=SITE)


def test_seconds_without_a_date_have_no_sun():
    weather = make_weather(np.array([0.0, 3600.0]), {"air_c": np.array([1.0, 2.0])}, site=SITE)
    assert weather.sun is None and "UTC of its times is not known" in weather.notes["sun"]


def test_the_weather_at_a_moment_is_linear_between_samples_and_nothing_is_extrapolated():
    weather = Weather(torch.tensor([0.0, 100.0, 400.0]).double(), air_c=torch.tensor([10.0, 20.0, 14.0]).double())
    assert [weather.at(t).air_c for t in (0.0, 50.0, 100.0, 250.0, 400.0)] == pytest.approx([10, 15, 20, 17, 14])
    assert weather.at(50.0).wind_m_s is None
    for time in (-1.0, 401.0):
        with pytest.raises(SceneError, match="there is no weather for second .*: the record runs from 0 to 400 s"):
            weather.at(time)


@pytest.mark.parametrize(
    ("times", "air", "message"),
    [
        ([0.0], [1.0], "two or more samples at strictly increasing times"),
        ([0.0, 0.0], [1.0, 1.0], "strictly increasing"),
        ([0.0, 1.0], [1.0, math.nan], "weather.air_c must hold 2 finite samples"),
        ([0.0, 1.0], [1.0], "weather.air_c must hold 2 finite samples"),
    ],
)
def test_a_record_that_cannot_be_interpolated_is_refused(times, air, message):
    with pytest.raises(SceneError, match=message):
        Weather(torch.tensor(times).double(), air_c=torch.tensor(air).double())


@pytest.fixture(scope="module")
def yard() -> SceneData:
    from heatsplat.datamodules.synthetic import Synthetic

    return Synthetic(scene="outdoor", size="tiny", frames=6).scene


def test_another_table_replaces_the_weather_of_a_scene(yard, tmp_path):
    path = tmp_path / "gale.csv"
    times = MIDNIGHT_S + 3600.0 * np.arange(49)
    path.write_text("utc,wind_m_s,air_c\n" + "".join(f"{t},{20.0},{8.0}\n" for t in times))
    scene = with_weather(yard, path)
    assert scene.weather.at(3600.0).wind_m_s == 20.0 and scene.weather.humidity_percent is None
    assert torch.allclose(scene.weather.sun[6], yard.weather.sun[6], atol=1e-9)  # the same place and clock
    for part in ("train", "val", "test"):
        for view, old in zip(getattr(scene, part), getattr(yard, part), strict=True):
            assert view.frame.environment == scene.weather.at(view.time_s) != old.frame.environment
            assert torch.equal(view.thermal, old.thermal)
    assert scene.notes["weather_replaced_by"] == str(path)
    assert yard.truth is not None and scene.truth is None  # which is that of the old weather


def test_a_table_that_misses_frames_is_refused_by_name(yard, tmp_path):
    path = tmp_path / "short.csv"
    path.write_text(f"utc,air_c\n{MIDNIGHT_S},8\n{MIDNIGHT_S + 3600 * 3},8\n")
    with pytest.raises(SceneError, match="frame frame_0000.*: there is no weather for second .* covers every frame"):
        with_weather(yard, path)
    path.write_text("time_s,air_c\n0,8\n5000,8\n")
    with pytest.raises(SceneError, match="do not share a clock"):
        with_weather(yard, path)
