"""Ranks with ties: what the spread of seeds does not tell apart shares its ranks."""

import json
from pathlib import Path

import pytest
from boards import ASKED, VIEWS, board, hand_in, protocol_folder, run_of, submission, truth

from heatsplat.io.results import RunResults
from heatsplat.io.tiff import write_temperature
from heatsplat.studies.leaderboard.page import page
from heatsplat.studies.leaderboard.plan import board_of
from heatsplat.studies.leaderboard.report import markdown, order
from heatsplat.studies.leaderboard.standings import (
    Entry,
    Result,
    beside_reference,
    ranks,
    spread_of,
    standard_error,
    standings,
    usual_spread,
)
from heatsplat.studies.score import SceneScore


def test_a_difference_within_the_spread_is_a_tie():
    means, errors = [1.0, 1.5, 1.01], [0.012, 0.006, 0.012]
    assert ranks(means, errors) == [(1, 2), (3, 3), (1, 2)]
    assert ranks(means, errors, higher=True) == [(2, 3), (1, 1), (2, 3)]
    assert ranks([1.0, 1.2, 1.4], [0.1] * 3) == [(1, 2), (1, 3), (2, 3)]  # two errors of a difference are 0.28
    assert ranks([1.0, 1.2], [0.0, 0.0]) == [(1, 1), (2, 2)]


def entry_of(*values: float) -> Entry:
    """An entry whose seeds have these errors."""
    scores = [SceneScore([{"name": "near_00003", "part": "near", "mae_c": value}]) for value in values]
    return Entry("a", "b", "steps", [Result(seed, score, {}, Path(), "") for seed, score in enumerate(scores)])


def test_a_spread_is_weighed_with_the_usual_one_and_one_seed_has_that():
    usual = usual_spread([entry_of(1.0, 1.2), entry_of(2.0, 2.2, 2.4), entry_of(5.0), entry_of()], "mae_c")
    assert usual == pytest.approx(((0.02 / 1.21 + 2 * 0.04 / 4.84) / 3) ** 0.5)
    assert standard_error(entry_of(2.0), "mae_c", 0.1) == pytest.approx(0.2)
    assert standard_error(entry_of(2.0, 2.0), "mae_c", 0.1) == pytest.approx((2 * 0.04 / 3 / 2) ** 0.5)
    assert standard_error(entry_of(1.0, 1.2), "mae_c", 0.0) == pytest.approx((0.02 / 3 / 2) ** 0.5)
    assert standard_error(entry_of(1.0, 1.2), "mae_c", None) == pytest.approx(0.1)
    assert standard_error(entry_of(2.0), "mae_c", None) == 0.0
    assert usual_spread([entry_of(1.0), entry_of(2.0)], "mae_c") is None


def test_two_seeds_alike_by_chance_are_no_certainty(tmp_path):
    """On each scene seeds vary by what they vary by there."""
    root, sweep = protocol_folder(tmp_path / "root", "cooling", "driven"), tmp_path / "sweep"
    for scene, apart in (("cooling", 0.4), ("driven", 0.002)):
        for seed in (0, 1):
            run_of(sweep, "3dgs", scene, seed, 1.0)
            run_of(sweep, "etgs", scene, seed, 1.1)
            run_of(sweep, "ti3dgs", scene, seed, 2.0 + seed * apart)
    asked = board_of({**ASKED, "root": str(root)}, ["3dgs", "etgs", "ti3dgs"], ())
    found = {(one.method, one.scene): one.rank for one in standings(sweep, asked).entries}
    assert [found[method, "cooling"] for method in ("3dgs", "etgs", "ti3dgs")] == [(1, 2), (1, 2), (3, 3)]
    assert [found[method, "driven"] for method in ("3dgs", "etgs", "ti3dgs")] == [(1, 1), (2, 2), (3, 3)]


def test_a_seed_counts_once(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    run_of(sweep, "3dgs", "cooling", 0, 1.0)
    run_of(tmp_path / "other", "3dgs", "cooling", 0, 3.0)
    (tmp_path / "other" / "3dgs_cooling_steps_0").rename(sweep / "etgs_cooling_steps_0")
    (entry,) = (one for one in standings(sweep, board(root)).entries if one.seeds)
    assert entry.all_numbers == [0] and entry.mean("mae_c") == pytest.approx(1.0, abs=1e-4)


def test_a_run_that_cannot_be_read_takes_no_other_down(tmp_path, caplog):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    for seed, method in ((0, "3dgs"), (0, "etgs"), (1, "etgs")):
        run_of(sweep, method, "cooling", seed, 1.0)
    (sweep / "3dgs_cooling_steps_0" / "metrics.json").write_text("{")
    (sweep / "etgs_cooling_steps_1" / ".hydra" / "overrides.yaml").write_text("{")
    (sweep / "etgs_cooling_steps_0" / "score.json").write_text("{")
    found = {one.method: one for one in standings(sweep, board(root)).entries}
    assert found["etgs"].seeds == 1 and found["3dgs"].seeds == 0
    assert (
        "metrics.json is not a metrics.json of heatsplat" in found["3dgs"].reason and "Delete" in found["3dgs"].reason
    )
    assert "overrides.yaml cannot be read" in caplog.text


def test_runs_of_other_settings_than_the_track_has_do_not_count(tmp_path):
    """In a folder that is gone on with, or whose table is written anew, when the protocol has become another. What the command
    line says for all runs comes after the track's and is meant."""
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    run_of(sweep, "3dgs", "cooling", 0, 1.0)
    run_of(sweep, "etgs", "cooling", 0, 1.0)
    file = sweep / "etgs_cooling_steps_0" / ".hydra" / "overrides.yaml"
    file.write_text(file.read_text() + "- max_steps=6\n")
    assert [one.seeds for one in standings(sweep, board(root)).entries] == [1, 1, 0]
    shorter = board(root, protocol=ASKED["protocol"] | {"tracks": {"steps": ["max_steps=500"]}})
    found = standings(sweep, shorter).entries
    assert [one.seeds for one in found] == [0, 0, 0]
    assert (
        "steps_0 was trained without max_steps=500 of the track steps; give another hydra.sweep.dir" in found[0].reason
    )


def test_scenes_that_are_not_asked_for_are_no_columns(tmp_path):
    root = protocol_folder(tmp_path / "root", "cooling", "driven")
    theirs = submission(tmp_path / "theirs", 0.1, scenes={"driven": None, "cooling": None})
    hand_in(theirs / "driven", 0.1)
    for scenes in (["cooling"], ["cooling", "driven"]):
        found = standings(
            tmp_path / "none", board(root, methods=["3dgs"], scenes=scenes, submissions=[str(theirs)])
        ).entries
        assert [one.scene for one in found if one.method == "theirs"] == scenes


def test_scenes_may_have_names_that_take_quotes(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "Büro, Süd"), tmp_path / "sweep"
    (job,) = board(root, methods=["3dgs"], seeds=[0]).jobs()
    assert "data.scene='Büro, Süd'" in job
    run_of(sweep, "3dgs", "'Büro, Süd'", 0, 1.0)
    assert [one.seeds for one in standings(sweep, board(root, methods=["3dgs"])).entries] == [1]


def test_the_machines_of_seconds_are_told(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    theirs = str(submission(tmp_path / "theirs", 0.1, machine="RTX 4090"))
    for seed, threads in ((0, 1), (1, 4)):
        run_of(sweep, "3dgs", "cooling", seed, 1.0)
        file = sweep / f"3dgs_cooling_steps_{seed}" / "metrics.json"
        results = RunResults.read(file)
        results.run |= {"machine": "EPYC, 4 cores", "threads": threads}
        results.write(file)
    run_of(sweep, "etgs", "cooling", 0, 1.0)  # of a version that did not tell
    assert standings(sweep, board(root, submissions=[theirs])).note == (
        "Measured on EPYC, 4 cores, 1 thread (1 run); EPYC, 4 cores, 4 threads (1 run); RTX 4090 (1 run)."
    )
    assert standings(tmp_path / "none", board(root)).note == ""


def test_a_score_of_a_scene_that_was_made_anew_is_worked_out_anew(tmp_path):
    """``study=scenes`` into a folder whose scenes were deleted, as with another seed."""
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    run_of(sweep, "3dgs", "cooling", 0, 1.0)

    def score():
        (entry,) = (one for one in standings(sweep, board(root)).entries if one.seeds)
        return entry.mean("mae_c")

    assert score() == pytest.approx(1.0, abs=1e-4)
    for view in VIEWS:
        write_temperature(root / "truth" / "cooling" / f"{view}.tiff", truth(view) + 3.0)
    assert score() == pytest.approx(1.0, abs=1e-4)  # as far as anybody was told it is the same scene
    meta = root / "scenes" / "cooling" / "meta.json"
    meta.write_text(meta.read_text().replace("{", '{"scene_seed": 1, '))
    assert score() == pytest.approx(2.0, abs=1e-4)


def test_of_a_score_of_which_more_is_better_the_difference_stands_beside_the_reference(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    run_of(sweep, "3dgs", "cooling", 0, 1.0)
    run_of(sweep, "etgs", "cooling", 0, 0.1)
    asked = board(root, protocol=ASKED["protocol"] | {"scores": ["psnr", "mae_c"]})
    found = {one.method: one for one in standings(sweep, asked).entries}
    assert found["etgs"].rank == (1, 1) and found["3dgs"].rank == (2, 2)
    beside = beside_reference(list(found.values()), asked)
    assert beside == {
        ("3dgs", "steps"): (0.0, 1),
        ("etgs", "steps"): (pytest.approx(20.0, abs=1e-2), 1),
    }  # dB of a tenth


@pytest.mark.parametrize("exact", ["etgs", "3dgs"])
def test_renders_that_are_the_truth_on_one_scene_do_not_hide_it(exact, tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling", "driven"), tmp_path / "sweep"
    for method in ("3dgs", "etgs"):
        run_of(sweep, method, "cooling", 0, 0.0 if method == exact else 0.5)
        run_of(sweep, method, "driven", 0, 0.5)
    asked = board_of({**ASKED, "root": str(root)}, ["3dgs", "etgs"], ())
    found = standings(sweep, asked)
    ratio = (0.0005 / 0.5) ** (0.5 if exact == "etgs" else -0.5)
    beside = beside_reference(found.entries, asked)
    assert beside == {("3dgs", "steps"): (1.0, 2), ("etgs", "steps"): (pytest.approx(ratio, rel=1e-3), 2)}
    assert order(found.entries, asked, "steps") == (["etgs", "3dgs"] if exact == "etgs" else ["3dgs", "etgs"])
    told = "over the scenes on which both ran; errors below 0.0005 °C count as that."
    assert told in markdown(found, asked) and "; errors below 0.0005 °C count as that" in page(found, asked, None)


def test_runs_and_submissions_are_scored_alike_and_ranked_together(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling", "driven"), tmp_path / "sweep"
    for seed, off in ((0, 1.0), (1, 1.1)):
        run_of(sweep, "3dgs", "cooling", seed, off, seconds=8.0)
        run_of(sweep, "etgs", "cooling", seed, off / 2)
    run_of(sweep, "etgs", "driven", 0, None)
    run_of(sweep, "etgs", "glass", 0, 0.1)  # not asked for
    hand_in(tmp_path / "theirs" / "cooling", -0.25)
    told = {"method": "theirs", "track": "steps", "scenes": {"cooling": {"seconds": 99}}}
    (tmp_path / "theirs" / "metrics.json").write_text(json.dumps(told))
    asked = board(root, submissions=[str(tmp_path / "theirs")])
    for _ in range(2):  # the second time from score.json
        found = {(one.method, one.scene): one for one in standings(sweep, asked).entries}
    assert found["3dgs", "cooling"].mean("mae_c") == pytest.approx(1.05, abs=1e-4)
    assert found["3dgs", "cooling"].cost("seconds") == 8.0 and found["theirs", "cooling"].cost("seconds") == 99
    assert [found[name, "cooling"].rank for name in ("3dgs", "etgs", "theirs")] == [(3, 3), (2, 2), (1, 1)]
    assert found["etgs", "driven"].reason.endswith("lacks weather") and found["etgs", "driven"].rank is None
    assert (
        spread_of(list(found.values()), asked)
        == "Seeds vary by 6.7 % (standard deviation, pooled over methods). A method's own spread is weighed with that; one seed "
        "has that."
    )
    assert found["3dgs", "driven"].reason == "not run yet"
    assert found["supirgs", "driven"].reason.startswith("it is for low-resolution images")
    beside = beside_reference(list(found.values()), asked)
    assert beside["etgs", "steps"] == (pytest.approx(0.5, abs=1e-4), 1)
    (sweep / "3dgs_cooling_steps_0" / "submission" / "near_00003.tiff").unlink()
    (sweep / "3dgs_cooling_steps_0" / "score.json").unlink()
    left = next(one for one in standings(sweep, asked).entries if (one.method, one.scene) == ("3dgs", "cooling"))
    assert len(left.runs) == 1 and "lacks 1 of the 3" in left.reason
