"""What people and their programs write beside images."""

import pytest

from heatsplat.contracts import SceneError, number_in
from heatsplat.datamodules.side_files import finite, read_table, says_fahrenheit, says_kelvin


@pytest.mark.parametrize(
    "text",
    ["Unit: °F", "unit=F", '{"unit": "F", "emissivity": 0.95}', "camera: T1020; Units = Fahrenheit", "in degrees F", "degF",
     '<Item name="UNITTYPE" sample="0" role="unittype">F</Item>', 'role="unittype">deg F<', "temperature_unit: f"],
)  # fmt: skip
def test_text_that_says_fahrenheit(text):
    assert says_fahrenheit(text)


@pytest.mark.parametrize(
    "text",
    ["", "Unit: °C", '{"unit": "C"}', "Unit: Fluke", "degC", 'role="unittype">K<', "community: F", "F", "units: F/1.4"],
)
def test_text_that_does_not(text):
    assert not says_fahrenheit(text)


@pytest.mark.parametrize(
    "text", ["Unit: K", "unit=K", '{"unit": "K"}', "in kelvin", "Units: Kelvins", 'role="unittype">K<']
)
def test_text_that_says_kelvin(text):
    assert says_kelvin(text) and not says_fahrenheit(text)


@pytest.mark.parametrize(
    "text", ["", "Unit: °C", "unit=F", "K", "units: K/count", "Kelvinator", 'role="unittype">deg C<']
)
def test_text_that_says_no_kelvin(text):
    assert not says_kelvin(text)


def test_underscores_within_digits_make_no_number(tmp_path):
    (tmp_path / "t.csv").write_text("a;b\n1_5;2,5\n")
    table = read_table(tmp_path / "t.csv")
    ((_, (one, other)),) = table.rows
    assert table.number(other) == 2.5 and number_in(" 1e1 ") == 10.0
    with pytest.raises(ValueError, match="'1_5'"):
        table.number(one)
    with pytest.raises(SceneError, match="fl_x is '1_500', a number is needed"):
        finite("1_500", "fl_x")
