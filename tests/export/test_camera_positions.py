"""Tables of camera positions as programs write them."""

import pytest

from heatsplat.contracts import SceneError
from heatsplat.export.camera_positions import read_positions


def table(tmp_path, *lines):
    path = tmp_path / "gps.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_heights_are_of_the_first_column_that_says_any(tmp_path):
    path = table(
        tmp_path, "name;latitude;longitude;above_takeoff_m;altitude_m", "a.jpg;47,5;8,5;;410", "b.jpg;47;8;;411;more"
    )
    assert read_positions(path) == {"a": (47.5, 8.5, 410.0), "b": (47.0, 8.0, 411.0)}


def test_a_table_without_heights_is_level_where_that_is_allowed(tmp_path):
    for columns in ("name,latitude,longitude", "name,latitude,longitude,altitude"):
        path = table(tmp_path, columns, "a.jpg,47.5,8.5", "b.jpg,0,0")
        assert read_positions(path, flat=True) == {"a": (47.5, 8.5, 0.0)}
    assert read_positions(path) == {}
    with pytest.raises(SceneError, match="has no column above_takeoff_m or altitude_m or"):
        read_positions(table(tmp_path, "name,latitude,longitude", "a.jpg,47.5,8.5"))


@pytest.mark.parametrize(
    ("row", "complaint"),
    [("b,47,east,1", "gps.csv: .*east.* in latitude, longitude, alt"), ("b,147,8,1", "b lies nowhere .* latitude 147")],
)
def test_what_is_no_position_is_refused(tmp_path, row, complaint):
    with pytest.raises(SceneError, match=complaint):
        read_positions(table(tmp_path, "name,latitude,longitude,alt", "a,47,8,1", row))
