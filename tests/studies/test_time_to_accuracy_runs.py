"""What one run is beside others: accuracies that count as equal, and the standard schedule in the same seconds."""

import pytest

from heatsplat.studies.time_to_accuracy_runs import Outcome, Panel, parsed, without_length


def outcome(recipe, steps, seconds, psnr, course=()):
    scores = {"psnr": psnr, "mae_c": (50 - psnr) / 10}
    mae = [(s, (50 - value) / 10) for s, value in course]
    return Outcome(recipe, "0", steps, seconds, scores, steps * 2.0, {"psnr": list(course), "mae_c": mae})


REFERENCE = outcome(None, 800, 80.0, 41.0, [(20, 30), (40, 38), (80, 40)])
SHORT = outcome(None, 200, 20.0, 37.0, [(20, 37)])
QUICK = outcome("quick", 300, 40.0, 40.9, [(10, 36), (40, 41)])


@pytest.fixture
def panel():
    return Panel("", {"psnr": 0.2, "mae_c": 0.02}, {"0": REFERENCE}, [QUICK, SHORT, REFERENCE])


def test_a_level_is_worse_than_the_reference_by_the_margin(panel):
    assert panel.level("psnr", 40.0) == pytest.approx(39.8) and panel.level("mae_c", 0.1) == pytest.approx(0.12)


def test_groups_begin_with_the_reference_and_end_with_recipes(panel):
    assert panel.groups() == [[REFERENCE], [SHORT], [QUICK]]


def test_the_standard_schedule_lies_between_its_runs_over_log_seconds_and_never_beyond_them(panel):
    usual = panel.standard_in(QUICK)  # 40 s are half way between 20 and 80
    assert (usual.recipe, usual.seed, usual.seconds, usual.steps) == (None, "0", 40.0, 500)
    assert usual.scores == pytest.approx({"psnr": 39.0, "mae_c": 1.1}) and usual.gaussians == pytest.approx(1000)
    for seconds in (19.9, 80.1):
        assert panel.standard_in(outcome("quick", 300, seconds, 40.0)) is None


def test_a_run_is_measured_by_courses_and_by_ends(panel):
    found = panel.measures(QUICK)
    assert found["time_ratio"] == 0.5 and found["gaussians_ratio"] == pytest.approx(300 / 800)
    assert found["psnr_off"] == pytest.approx(-0.1) and found["mae_c_off"] == pytest.approx(0.01)
    way, own = 10 + 30 * 3.8 / 5, 40 + 40 * 1.8 / 2  # to 39.8 dB
    assert found["way_psnr"] == pytest.approx(way) and found["way_psnr_of_own"] == pytest.approx(way / own)
    assert found["end_psnr"] == 40.0 and found["end_psnr_of_own"] == pytest.approx(40 / (20 + 60 * 3.8 / 4))
    late = panel.measures(SHORT)
    assert [late[f"{way}_{score}"] for way in ("way", "end") for score in ("psnr", "mae_c")] == [None] * 4


def test_overrides_are_read_as_keys_and_values():
    assert parsed(["max_steps=9", "a.b=c=d"]) == {"max_steps": "9", "a.b": "c=d"}
    assert without_length(["max_steps=9", "density=fixed"]) == ["density=fixed"]
