"""What a table says of the frames of a recording."""

import numpy as np
import pytest
from camera_files import temperatures
from recordings import read_frames, write_flir, write_images

from heatsplat.contracts import SceneError
from heatsplat.preparation.frames import Reading, read_recording

FLOATS = temperatures().astype(np.float32)
PLACED = {
    "name": "file",
    "latitude_deg": "lat",
    "longitude_deg": "lon",
    "altitude_m": "alt",
    "above_takeoff_m": "height",
    "yaw_deg": "yaw",
    "pitch_deg": "pitch",
    "roll_deg": "roll",
}


def test_a_table_goes_before_the_files(tmp_path):
    write_images(tmp_path / "frames", {"a.tiff": FLOATS, "b.tiff": FLOATS})
    table = tmp_path / "table.csv"
    table.write_text("file;when;lat;lon\na;2024-07-01T10:00:05Z;50,5;7,5\nb.tiff;2024-07-01T10:00:00Z;50,6;7,5\n")
    columns = {"name": "file", "time": "when", "latitude_deg": "lat", "longitude_deg": "lon"}
    frames = read_frames(tmp_path / "frames", Reading(table=table, columns=columns))
    assert [frame.name for frame in frames] == ["b", "a"]
    assert frames[1].position.latitude_deg == 50.5
    with pytest.raises(SceneError, match="has no column 'picture'"):
        read_frames(tmp_path / "frames", Reading(table=table, columns=columns | {"name": "picture"}))
    with pytest.raises(SceneError, match="no column 'utc', as table_columns.time says; it has file, when, lat, lon"):
        read_frames(tmp_path / "frames", Reading(table=table, columns=columns | {"time": "utc"}))
    with pytest.raises(
        SceneError, match="table_columns.heading=yaw: a table tells name, time, .* roll_deg, min_c, max_c, no heading"
    ):
        read_frames(tmp_path / "frames", Reading(table=table, columns=columns | {"heading": "yaw"}))
    table.write_text("file;when;lat;lon\na;yesterday;50,5;7,5\n")
    with pytest.raises(SceneError, match="line 2: 'yesterday' in column when is no date-time"):
        read_frames(tmp_path / "frames", Reading(table=table, columns=columns))


def test_usual_names_of_columns_are_known_and_others_are_listed(tmp_path):
    write_images(tmp_path / "frames", {"a.tiff": FLOATS})
    table = tmp_path / "table.csv"
    table.write_text("image,time,lat,gps_lon,h,note\na,2024-07-01T10:00:05Z,50.5,7.5,80,x\n")
    columns = {"name": "file", "time": "time", "latitude_deg": "latitude", "longitude_deg": "longitude"}
    columns["above_takeoff_m"] = "height"
    found = read_recording(tmp_path / "frames", Reading(table=table, columns=columns))
    assert (found.frames[0].position.latitude_deg, found.frames[0].position.longitude_deg) == (50.5, 7.5)
    assert "table.csv tells latitude_deg, longitude_deg, time of 1 of 1 frames" in found.notes
    assert any("columns h, note are not used" in note and "table_columns." in note for note in found.notes)


def test_a_table_that_tells_nothing_is_refused_and_what_it_tells_is_said(tmp_path):
    write_images(tmp_path / "frames", {"a.tiff": FLOATS, "b.tiff": FLOATS})
    table = tmp_path / "table.csv"
    table.write_text("file,when\na,2024-07-01T10:00:05Z\n")
    with pytest.raises(
        SceneError, match="has none of the columns time; it has file, when: say .* table_columns.time=when"
    ):
        read_frames(tmp_path / "frames", Reading(table=table, columns={"name": "file", "time": "time"}))
    columns = {"name": "file", "time": "when"}
    assert (
        "table.csv tells time of 1 of 2 frames"
        in read_recording(tmp_path / "frames", Reading(table=table, columns=columns)).notes
    )
    table.write_text("file,when\nother,2024-07-01T10:00:05Z\n")
    with pytest.raises(
        SceneError, match="no row for any of the 2 frames, such as a.tiff; its column file begins with other"
    ):
        read_frames(tmp_path / "frames", Reading(table=table, columns=columns))


def test_a_column_of_a_table_replaces_its_own_value_and_no_other(tmp_path):
    source = write_flir(tmp_path / "files", 2)
    table = tmp_path / "table.csv"
    reading = Reading(table=table, columns=PLACED)
    table.write_text("file,lat,lon\nIR_0000,50,8\nIR_0001,50.1,8\n")
    first = read_frames(source, reading)[0].position
    assert (first.latitude_deg, first.longitude_deg, first.altitude_m) == (50.0, 8.0, 100.0)
    table.write_text("file,alt,height\nIR_0000,250,\nIR_0001,,30\n")
    found = read_recording(source, reading)
    places = [frame.position for frame in found.frames]
    assert [(p.latitude_deg, p.altitude_m, p.above_takeoff_m) for p in places] == [
        (51.0, 250.0, None),
        (pytest.approx(51.00001), 100.0, 30.0),
    ]
    assert "table.csv tells above_takeoff_m, altitude_m of 2 of 2 frames" in found.notes


def placed_by(folder, table):
    """The frames of one image a.tiff with a table of this text."""
    write_images(folder / "files", {"a.tiff": FLOATS})
    (folder / "table.csv").write_text(table)
    return read_frames(folder / "files", Reading(table=folder / "table.csv", columns=PLACED))


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("alt,height", "column alt changes nothing, as neither the table nor the files say lat, lon of the same frame"),
        ("lat,alt", "column lat changes nothing, .* say lon of the same frame; add that, or take the column away"),
        ("yaw,roll", "column yaw changes nothing, .* say pitch, roll"),
    ],
)
def test_a_column_that_completes_nothing_is_refused(tmp_path, head, said):
    with pytest.raises(SceneError, match=said):
        placed_by(tmp_path, f"file,{head}\na,1,2\n")


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        ("nan,8", "line 2: 'nan' in column lat is no number; leave cells empty"),
        ("50,inf", "line 2: 'inf' in column lon is no number"),
        ("150,8", "line 2: '150' in column lat is no latitude, which lies between -90 and 90 degrees"),
        ("50,-190", "column lon is no longitude, .* -180 and 180"),
        ("0,0", "line 2: latitude and longitude are 0, as GPS without a fix .* leave both cells empty"),
    ],
)
def test_places_that_cannot_be_are_refused_by_their_line(tmp_path, cells, said):
    with pytest.raises(SceneError, match=said):
        placed_by(tmp_path, f"file,lat,lon\na,{cells}\n")
