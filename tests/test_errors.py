"""Settings that are of no use are named, with what they must be."""

import math
import re

import pytest

from heatsplat.errors import SceneError, as_written, check_count, check_numbers, check_option, number_in, rounded


def test_an_option_that_there_is_not_is_told_those_that_there_are():
    check_option("codec", "h264", ("auto", "h264"))
    with pytest.raises(SceneError, match="^codec must be one of auto, h264, got 'h265'$"):
        check_option("codec", "h265", ("auto", "h264"), SceneError)
    with pytest.raises(ValueError, match="^figures must be one of null, pdf, got 'png'$"):
        check_option("figures", "png", (None, "pdf"))


def test_settings_are_told_as_people_write_them():
    assert as_written([20.0, None, [True, "x"]]) == "[20.0, null, [true, x]]"
    assert as_written({"a": None, "b": (1, False)}) == "{a: null, b: [1, false]}"
    for check, said in (
        (lambda: check_option("codec", None, (True, "h264")), "codec must be one of true, h264, got null"),
        (lambda: check_numbers("range_c", [20.0, None], 2), "range_c must be a list of 2 numbers, got [20.0, null]"),
        (lambda: check_count("frames", None), "frames must be a whole number, 1 or more, got null"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
            check()


@pytest.mark.parametrize("wrong", ["x", "12", True, None, [1.0], math.nan, math.inf])
def test_a_setting_that_is_no_number_is_named(wrong):
    check_numbers("clip", 3)
    with pytest.raises(ValueError, match="clip must be a number, got"):
        check_numbers("clip", wrong)


@pytest.mark.parametrize("wrong", [2.0, [1.0], [1, 2, 3], [1, "b"], "ab", [1, math.nan]])
def test_a_setting_that_is_no_list_of_numbers_is_named(wrong):
    check_numbers("bounds", (1, 2.5), 2)
    with pytest.raises(ValueError, match="bounds must be a list of 2 numbers, got"):
        check_numbers("bounds", wrong, 2)


@pytest.mark.parametrize("wrong", [0, -1.5, [1, 0]])
def test_a_setting_that_is_not_above_its_bound_is_named(wrong):
    count = len(wrong) if isinstance(wrong, list) else None
    check_numbers("fps", 1e-9, above=0)
    with pytest.raises(ValueError, match="^fps must be above 0, got "):
        check_numbers("fps", wrong, count, above=0)


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "abc", None, True])
def test_what_counts_nothing_is_named(wrong):
    with pytest.raises(SceneError, match=r"^study\.trials must be a whole number, 1 or more, got "):
        check_count("study.trials", wrong)
    check_count("study.trials", 1)
    check_count("study.seeds", 0, least=0)


def test_large_numbers_of_messages_have_no_powers_of_ten():
    assert [rounded(value, 2) for value in (0.0512, 9.96, 49.4, 130.2, -1_234_567.0, math.inf)] == [
        "0.051", "10", "49", "130", "-1,200,000", "inf",
    ]  # fmt: skip
    assert rounded(99.7, 2) == "100" and rounded(999.7, 3) == "1,000"


def test_underscores_within_digits_make_no_number():
    assert number_in(" 1e1 ") == 10.0
    with pytest.raises(ValueError, match="'1_5'"):
        number_in("1_5")
