"""A leaderboard's page is the record of its runs: it speaks for those whose folders are gone."""

import json

import pytest
from boards import board, hand_in, protocol_folder, run_of

from heatsplat.contracts import SceneError
from heatsplat.studies.leaderboard.earlier import read_page
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
    pictures = read_page(then / "leaderboard.html", board(root, **asked))["scenes"][0]["pictures"]
    assert all(set(shown[which]) == {"3dgs", "etgs", "theirs"} for shown in pictures for which in ("renders", "errors"))

    for text, message in (("<html>", "no page of a leaderboard"), (page.read_text().replace("tiny", "demo"), "sizes")):
        (tmp_path / "other.html").write_text(text)
        with pytest.raises(SceneError, match=message):
            standings(then, board(root, **asked, earlier=str(tmp_path / "other.html")))
