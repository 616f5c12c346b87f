"""What the time to an accuracy is shown as: cells over seeds, records, and a picture near the ends."""

from dataclasses import replace

import pytest
from test_time_to_accuracy_runs import a_panel, outcome

from heatsplat.studies.time_to_accuracy.report import ends, markdown, named, picture, records, times


def test_the_standard_schedule_stands_below_each_recipe_that_lies_between_its_runs():
    panel = a_panel()
    panel.outcomes.append(outcome("slow", 900, 99.0, 42.0))
    names = [line.split("|")[1].strip() for line in ends(panel)[2:]]
    same = "– standard in the same time"
    assert names == ["standard, 800 steps (reference)", "standard, 100 steps", "early", same, "late", same, "slow"]


def test_seeds_of_a_recipe_are_one_row_whatever_their_lengths():
    panel = a_panel()
    panel.references["1"] = replace(panel.references["0"], seed="1")
    panel.outcomes += [outcome("budget", 300, 30.0, 40.0), replace(outcome("budget", 311, 30.0, 42.0), seed="1")]
    (row,) = [line for line in ends(panel) if "budget" in line]
    assert row.startswith("| budget | 2 | ≈ 306 | 30.0 ± 0.0 |") and "41.00 ± 1.41" in row


def test_fields_have_no_gaussians_to_compare():
    panel = a_panel()
    panel.outcomes[:] = [replace(one, gaussians=0.0) for one in panel.outcomes]
    panel.references["0"] = panel.outcomes[-1]
    assert all(line.endswith("| 0 | – |") for line in ends(panel)[2:])


def test_times_have_a_dash_where_the_accuracy_is_not_reached():
    lines = {line.split("|")[1].strip(): line for line in times(a_panel(), "end")}
    assert lines["early"].count("–") == 6
    assert lines["late"].startswith("| late | 30.0 |") and "| 0.38 |" in lines["late"]


def test_records_hold_every_run_and_the_standard_schedule_in_its_time():
    rows = {row["recipe"]: row for row in records([a_panel()])}
    assert len(rows) == 6 and rows["standard in the time of late"]["seconds"] == 30.0
    assert rows["late"]["psnr_off"] == pytest.approx(-0.1)
    assert named(a_panel(), a_panel().outcomes[0]) == "late"


def test_the_picture_shows_the_ends_whatever_a_reset_throws_back():
    panel = a_panel()
    panel.references["0"].course["psnr"].insert(1, (50, 8.0))
    figure = picture([panel], "cpu_seconds")
    psnr, mae = figure.axes
    assert psnr.get_ylim() == pytest.approx((29.0, 42.0)) and psnr.get_xlabel() == "processor seconds of training"
    assert mae.get_yscale() == "log"
    levels = [
        line.get_ydata()[0] for line in psnr.lines if len(set(line.get_ydata())) == 1 and len(line.get_ydata()) == 2
    ]
    assert levels == pytest.approx([41.0, 40.8])
    assert "processor seconds" in markdown([panel], "cpu_seconds").partition("\n")[0]


def test_seconds_beside_a_reference_of_another_machine_are_told():
    panel = a_panel()
    panel.outcomes[:] = [replace(one, on="EPYC, 4 threads") for one in panel.outcomes]
    assert "Seconds are of" not in markdown([panel], "train_seconds")
    panel.outcomes[0] = replace(panel.outcomes[0], on="Xeon, 4 threads")
    told = "within one: EPYC, 4 threads (3 runs); Xeon, 4 threads (1 run).\n"
    assert told in markdown([panel], "train_seconds")
