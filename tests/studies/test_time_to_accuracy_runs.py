"""Panels of the time to an accuracy: levels, the standard schedule in between, order."""

import pytest

from heatsplat.studies.time_to_accuracy.runs import Outcome, Panel, without_length

MARGINS = {"psnr": 0.2, "mae_c": 0.02}


def outcome(recipe: str | None, steps: int, seconds: float, psnr: float, course=()) -> Outcome:
    courses = {"psnr": list(course), "mae_c": [(s, 5 - v / 10) for s, v in course]}
    return Outcome(recipe, "0", steps, seconds, {"psnr": psnr, "mae_c": 5 - psnr / 10}, 10.0 * steps, courses)


def a_panel() -> Panel:
    reference = outcome(None, 800, 80.0, 41.0, [(40, 38), (80, 40)])
    others = [outcome("late", 300, 30.0, 40.9), outcome("early", 100, 12.0, 36.0), outcome(None, 100, 10.0, 35.0)]
    return Panel("heated", MARGINS, {"0": reference}, [*others, reference])


def test_a_level_is_worse_than_the_reference_by_the_margin():
    panel = a_panel()
    assert panel.level("psnr", 40.0) == pytest.approx(39.8) and panel.level("mae_c", 0.1) == pytest.approx(0.12)


def test_groups_begin_with_the_reference_and_go_on_by_time():
    assert [(own[0].recipe, own[0].steps) for own in a_panel().groups()] == [
        (None, 800), (None, 100), ("early", 100), ("late", 300),
    ]  # fmt: skip


def test_the_standard_schedule_lies_on_a_line_over_log_seconds_and_never_beyond_its_runs():
    panel = a_panel()
    found = panel.standard_in(outcome("x", 1, 10.0 * 8**0.5, 0.0))  # half way between 10 and 80
    assert found.scores == pytest.approx({"psnr": 38.0, "mae_c": 1.2})
    assert (found.steps, found.gaussians) == (450, pytest.approx(4500.0))
    assert panel.standard_in(outcome("x", 1, 9.9, 0.0)) is None is panel.standard_in(outcome("x", 1, 80.1, 0.0))


def test_what_is_as_good_as_the_standard_schedule_in_its_time_takes_as_long():
    panel, seconds = a_panel(), 40.0
    panel.margins = {"psnr": 41.0 - panel.standard_in(outcome("x", 1, seconds, 0.0)).scores["psnr"], "mae_c": 0.02}
    assert panel.measures(outcome("x", 1, seconds, 40.0))["end_psnr_of_own"] == pytest.approx(1.0)


def test_what_never_gets_as_far_has_no_time_to_it():
    panel = a_panel()
    late, early = (panel.measures(one) for one in panel.outcomes[:2])
    assert late["end_psnr"] == late["end_mae_c"] == 30.0 and late["end_psnr_of_all"] == 30 / 80
    assert early["end_psnr"] is early["end_psnr_of_own"] is early["way_psnr"] is None
    assert panel.measures(panel.references["0"])["way_psnr"] == pytest.approx(40 + 40 * 1.8 / 2)


def test_a_recipe_is_its_overrides_without_the_length():
    assert without_length(["a.b=1", "max_steps=5"]) == ["a.b=1"]
