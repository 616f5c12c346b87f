"""Cells and lines of tables."""

import math

from heatsplat.io.tables import NONE, markdown_table, number, over_seeds, read_csv, write_csv


def test_numbers_have_thousands_and_their_spread():
    assert number(1234.567, 1) == "1,234.6" and number(1234.567, 1, 0.04) == "1,234.6 ± 0.0"
    assert number(None, 2) == number(math.nan, 2) == NONE and number(1.0, 2, math.nan) == "1.00"


def test_several_seeds_have_a_spread_and_one_has_none():
    assert over_seeds([1.0, 3.0], 2) == "2.00 ± 1.41"
    assert over_seeds([1.0], 2) == "1.00" and over_seeds([], 2) == NONE


def test_bars_and_ends_of_lines_in_cells_are_escaped():
    assert markdown_table(["a", "b"], [["x|y", 1]], "lr") == ["| a | b |", "|---|---:|", r"| x\|y | 1 |"]
    assert markdown_table(["a"], [["two\nlines"]])[2] == "| two lines |"


def test_a_file_holds_numbers_texts_and_nothing(tmp_path):
    write_csv(tmp_path / "a.csv", [{"a": 0.1, "b": None}, {"a": math.inf, "c": "text"}])
    rows = read_csv(tmp_path / "a.csv")
    assert rows == [{"a": 0.1, "b": None, "c": None}, {"a": math.inf, "b": None, "c": "text"}]
