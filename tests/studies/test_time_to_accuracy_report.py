"""The tables, the picture and the rows of the time to an accuracy."""

import pytest

from heatsplat.studies.time_to_accuracy_report import ends, markdown, named, picture, records, times
from heatsplat.studies.time_to_accuracy_runs import Outcome, Panel


def outcome(recipe, seed, steps, seconds, psnr, course=(), **further):
    courses = {"psnr": list(course), "mae_c": []}
    return Outcome(recipe, seed, steps, seconds, {"psnr": psnr, **further}, 1000.0, courses)


def panel_of(**further):
    """Two seeds of a reference of 80 s, a short standard run of 20 s and a recipe of 40 s."""
    outcomes = []
    for seed, gain in (("0", 0.0), ("1", 1.0)):
        outcomes += [
            outcome(None, seed, 800, 80.0, 41 + gain, [(40, 38 + gain), (80, 40 + gain)], **further),
            outcome(None, seed, 200, 20.0, 37 + gain, **further),
            outcome("quick", seed, 300, 40.0, 40.9 + gain, [(10, 36 + gain), (40, 41 + gain)], **further),
        ]
    return Panel("etgs on heated", {"psnr": 0.2, "mae_c": 0.02}, {one.seed: one for one in outcomes[::3]}, outcomes)


def test_runs_are_called_by_their_recipe_or_their_length():
    panel = panel_of()
    names = [named(panel, one) for one in panel.outcomes[:3]]
    assert names == ["standard, 800 steps (reference)", "standard, 200 steps", "quick"]


def test_the_table_of_ends_has_the_standard_schedule_under_each_recipe():
    *_, reference, short, quick, usual = ends(panel_of())
    assert reference.startswith(
        "| standard, 800 steps (reference) | 2 | 800 | 80.0 ± 0.0 | 1.00 ± 0.00 | 41.50 ± 0.71 |"
    )
    assert short.startswith("| standard, 200 steps | 2 | 200 |") and "| 0 of 2 |" in short
    assert quick.startswith("| quick | 2 | 300 | 40.0 ± 0.0 | 0.50 ± 0.00 | 41.40 ± 0.71 | -0.10 ± 0.00 | 2 of 2 |")
    assert usual.startswith("| – standard in the same time | 2 | ≈ 500 | 40.0 ± 0.0 | 0.50 ± 0.00 | 39.50 ± 0.71 |")


@pytest.mark.parametrize(("way", "quick"), [("way", "32.8 ± 0.0"), ("end", "40.0 ± 0.0")])
def test_the_tables_of_times_have_dashes_where_an_accuracy_was_not_reached(way, quick):
    *_, short, recipe = times(panel_of(), way)
    assert short == "| standard, 200 steps | – | – | – |" and recipe.startswith(f"| quick | {quick} |")


def test_scores_that_not_all_runs_have_are_left_out():
    panel = panel_of()
    assert "MAE" not in markdown([panel], "cpu_seconds")
    assert len(picture([panel], "cpu_seconds").axes) == 1
    both = panel_of(mae_c=0.5)
    text = markdown([both], "cpu_seconds")
    assert "processor seconds" in text and "within 0.2 dB and 0.02 °C of it" in text
    assert [axes.get_ylabel() for axes in picture([both], "cpu_seconds").axes] == ["PSNR (dB)", "MAE (°C)"]


def test_every_run_has_a_row_and_every_recipe_one_of_the_standard_schedule_beside_it():
    rows = records([panel_of()])
    first = [(row["recipe"], row["steps"], row["psnr"]) for row in rows if row["seed"] == "0"]
    assert first == [
        ("standard, 800 steps (reference)", 800, 41.0),
        ("standard, 200 steps", 200, 37.0),
        ("quick", 300, 40.9),
        ("standard in the time of quick", 500, pytest.approx(39.0)),
    ]
