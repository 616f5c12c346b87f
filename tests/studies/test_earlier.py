"""A leaderboard's page is the record of its runs: it speaks for those whose folders are gone."""

import json

import pytest
from boards import board, hand_in, protocol_folder, run_of, submission

from heatsplat.contracts import SceneError
from heatsplat.studies.leaderboard.earlier import MARK, read_page
from heatsplat.studies.leaderboard.report import write_leaderboard
from heatsplat.studies.leaderboard.standings import standings


def test_a_page_speaks_for_runs_whose_folders_are_gone(tmp_path):
    root, first, then = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "first", tmp_path / "then"
    for seed, off in ((0, 1.0), (1, 1.1)):
        run_of(first, "3dgs", "cooling", seed, off, seconds=8.0)
        run_of(first, "etgs", "cooling", seed, off + 1, seconds=9.0)
    hand_in(tmp_path / "theirs" / "cooling", -0.25)
    told = {"method": "theirs", "track": "steps", "scenes": {"cooling": {"seconds": 99}}}
    (tmp_path / "theirs" / "metrics.json").write_text(json.dumps(told))
    asked = {"tracks": ["steps"], "note": ""}
    write_leaderboard(first, board(root, **asked, submissions=[str(tmp_path / "theirs")]))

    run_of(
        then, "3dgs", "cooling", 0, 5.0, seconds=24.0
    )  # fewer seeds than the page has; a machine three times as slow
    for seed in (0, 1):
        run_of(then, "etgs", "cooling", seed, 0.5, seconds=30.0)
    page = first / "leaderboard.html"
    write_leaderboard(then, board(root, **asked, earlier=str(page)))
    for sweep, own in ((then, str(page)), (tmp_path / "none", str(then / "leaderboard.html"))):
        sweep.mkdir(exist_ok=True)  # the page of a merged table tells the same once more
        found = standings(sweep, board(root, **asked, earlier=own))
        entries = {one.method: one for one in found.entries}
        assert entries["3dgs"].mean("mae_c") == pytest.approx(1.05, abs=1e-4)
        assert entries["etgs"].mean("mae_c") == pytest.approx(0.5, abs=1e-4)
        assert [entries[name].cost("seconds") for name in ("3dgs", "etgs", "theirs")] == pytest.approx([8, 10, 99])
        assert [entries[name].rank for name in ("3dgs", "etgs", "theirs")] == [(3, 3), (2, 2), (1, 1)]
        assert [entries[name].seeds for name in ("3dgs", "etgs", "theirs")] == [2, 2, 1]
    text = (then / "leaderboard.md").read_text()
    assert (
        "Seconds of later runs are multiplied by 0.33 (equal steps)" in text and "| `theirs` | 0.24 | 1 | 99 |" in text
    )
    pictures = read_page(then / "leaderboard.html", board(root, **asked)).pictures.values()
    assert all(set(shown[which]) == {"3dgs", "etgs", "theirs"} for shown in pictures for which in ("renders", "errors"))


def test_seconds_of_a_submission_are_those_that_it_tells(tmp_path):
    """They are of a machine that the runs of the reference say nothing of."""
    root, first, then = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "first", tmp_path / "then"
    run_of(first, "3dgs", "cooling", 0, 1.0, seconds=8.0)
    asked = {"tracks": ["steps"], "note": ""}
    write_leaderboard(first, board(root, **asked))
    for method, seconds in (("3dgs", 24.0), ("etgs", 30.0)):
        run_of(then, method, "cooling", 0, 0.5, seconds=seconds)
    hand_in(tmp_path / "theirs" / "cooling", -0.25)
    told = {"method": "theirs", "track": "steps", "scenes": {"cooling": {"seconds": 99}}}
    (tmp_path / "theirs" / "metrics.json").write_text(json.dumps(told))
    page, theirs = str(first / "leaderboard.html"), [str(tmp_path / "theirs")]
    found = standings(then, board(root, **asked, earlier=page, submissions=theirs))
    assert {one.method: one.cost("seconds") for one in found.entries if one.seeds} == {
        "3dgs": 8,
        "etgs": 10,
        "theirs": 99,
    }
    assert "those of submissions are as handed in" in found.note


def numbers_of_all(entry):
    """What a table says of an entry but for its seconds, which are scaled."""
    parts = [entry.mean("mae_c", part) for part in sorted(entry.parts)]
    return [entry.mean("mae_c"), entry.deviation("mae_c"), entry.mean("psnr"), entry.cost("gaussians"), *parts]


def test_seeds_of_a_page_and_of_later_runs_add_up(tmp_path):
    """Mean and spread are those of all runs in one folder; runs of a seed that the page has too do not count."""
    root, whole = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "whole"
    first, then = tmp_path / "first", tmp_path / "then"
    offs = {0: 1.0, 1: 1.4, 2: 2.0, 3: 2.3}
    for seed, off in offs.items():
        folders = [whole, first if seed < 2 else then]
        for folder in folders:
            run_of(folder, "3dgs", "cooling", seed, off, seconds=8.0 + seed)
    run_of(then, "3dgs", "cooling", 1, 9.0, seconds=8.0)
    asked = {"tracks": ["steps"], "note": "", "seeds": list(offs)}
    write_leaderboard(first, board(root, **asked))
    write_leaderboard(then, board(root, **asked, earlier=str(first / "leaderboard.html")))
    later = tmp_path / "none"
    later.mkdir()
    (wanted,) = (one for one in standings(whole, board(root, **asked)).entries if one.seeds)
    for folder, page in ((then, first), (later, then)):
        found = standings(folder, board(root, **asked, earlier=str(page / "leaderboard.html")))
        (entry,) = (one for one in found.entries if one.seeds)
        assert sorted(entry.all_numbers) == [0, 1, 2, 3] and entry.seeds == 4
        assert numbers_of_all(entry) == pytest.approx(numbers_of_all(wanted), rel=1e-6)
    rows = (then / "leaderboard.csv").read_text()
    assert rows.count("3dgs,cooling,steps") == 3  # a page, and the runs of two seeds


def test_seeds_of_a_submission_add_up_as_those_of_runs_do(tmp_path):
    root = protocol_folder(tmp_path / "root", "cooling")
    theirs = [str(submission(tmp_path / f"theirs_{seed}", 1.0 + seed, seed=seed)) for seed in range(3)]
    first, then = tmp_path / "first", tmp_path / "then"
    for folder in (first, then):
        folder.mkdir()

    def seeds(folder, **asked):
        (entry,) = (one for one in standings(folder, board(root, note="", **asked)).entries if one.seeds)
        return sorted(entry.all_numbers), entry.mean("mae_c")

    assert seeds(first, submissions=theirs) == ([0, 1, 2], pytest.approx(2.0, abs=1e-4))
    write_leaderboard(first, board(root, note="", submissions=theirs[:1]))
    page = str(first / "leaderboard.html")
    assert seeds(then, submissions=theirs[1:], earlier=page) == ([0, 1, 2], pytest.approx(2.0, abs=1e-4))
    assert seeds(then, submissions=[theirs[2], theirs[2]]) == ([2], pytest.approx(3.0, abs=1e-4))  # once each
    unnumbered = [str(submission(tmp_path / f"again_{k}", off)) for k, off in enumerate((1.0, 2.0))]
    assert seeds(then, submissions=unnumbered)[0] == [0, 1]
    assert seeds(then, submissions=[*unnumbered, theirs[0]])[0] == [0, 1, 2]  # what tells its number keeps it
    assert seeds(then, submissions=unnumbered[:1] * 2)[0] == [0]


def test_a_page_that_is_none_is_refused(tmp_path):
    root, first = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "first"
    run_of(first, "3dgs", "cooling", 0, 1.0, seconds=8.0)
    asked = {"tracks": ["steps"], "note": ""}
    write_leaderboard(first, board(root, **asked))
    page = first / "leaderboard.html"
    whole = page.read_text()
    cut = whole[: whole.index(MARK) + 300]
    for text, message in (
        ("<html>", "no page of a leaderboard"),
        (whole.replace("tiny", "demo"), "sizes"),
        (
            whole.replace("cpu_seconds", "train_seconds"),
            "are train_seconds, .* cpu_seconds; give leaderboard.clock=train_",
        ),
        (
            whole.replace("max_steps=2000", "max_steps=900"),
            r"track steps .* is max_steps=900 cap_max=30000, .* board max_steps=2000 cap_max=30000; leave the page out, or .*"
            r"leaderboard.protocol.tracks.steps=\['max_steps=900','cap_max=30000'\]",
        ),
        (cut, "other.html is damaged"),
    ):
        (tmp_path / "other.html").write_text(text)
        with pytest.raises(SceneError, match=message):
            standings(first, board(root, **asked, earlier=str(tmp_path / "other.html")))
