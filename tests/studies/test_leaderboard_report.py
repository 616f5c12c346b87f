"""The table of a leaderboard says what ran, what could not, and who is tied."""

import csv
from pathlib import Path

import pytest
from boards import ASKED, board, protocol_folder, run_of
from commands import succeeds

from heatsplat.studies.leaderboard.report import write_leaderboard

ROOT = Path(__file__).resolve().parents[2]


def test_the_table_has_ranks_reasons_and_costs(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling", "driven"), tmp_path / "sweep"
    for seed, off in ((0, 1.0), (1, 1.2)):
        run_of(sweep, "3dgs", "cooling", seed, off)
        run_of(sweep, "etgs", "cooling", seed, off + 0.05)
        run_of(sweep, "etgs", "driven", seed, None)
    asked = board(root, document=str(tmp_path / "docs" / "board.md"), page=str(tmp_path / "docs" / "board.html"))
    written = write_leaderboard(sweep, asked)
    assert {path.name for path in written} == {
        "leaderboard.md",
        "leaderboard.html",
        "leaderboard.csv",
        "board.md",
        "board.html",
    }
    text = (tmp_path / "docs" / "board.md").read_text()
    assert (
        "Scene size: tiny; 4 runs, 0.01 h of CPU time in total; seeds 0, 1. On a busy machine." in text
        and "steps taken: `2,000`" in text
    )
    assert "| `3dgs` | 1.00 | 1 | 10 | 900 | 1,000 | **1.100 (1–2)** | – |" in text
    assert "| `etgs` | 1.05 | 1 | 10 | 900 | 1,000 | **1.150 (1–2)** | – |" in text  # tied
    assert "| method | x 3dgs | scenes | s (CPU time) | peak MB | Gaussians | cooling | driven |" in text
    assert "- `etgs` on driven: scene 'x' lacks weather" in text
    assert (
        "- `3dgs` on driven: not run yet" in text
        and "- `supirgs` on cooling, driven: it is for low-resolution images" in text
    )
    rows = list(csv.DictReader((sweep / "leaderboard.csv").open()))
    found = [row["mae_c_times"] for row in rows if (row["method"], row["scene"]) == ("3dgs", "cooling")]
    assert [round(float(text), 3) for text in found] == [1.0, 1.2]
    assert [row["seed"] for row in rows if row["method"] == "etgs" and row["scene"] == "cooling"] == ["0", "1"]
    assert {row["method"] for row in rows if row["reason"]} == {"3dgs", "etgs", "supirgs"} and len(rows) == 8


def test_seeds_that_failed_are_told_beside_those_that_did_not(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    for seed, off in ((0, 1.0), (1, None)):
        run_of(sweep, "3dgs", "cooling", seed, off)
        run_of(sweep, "etgs", "cooling", seed, 1.0)
    write_leaderboard(sweep, board(root))
    told = "`3dgs` on cooling, seed 1: scene 'x' lacks weather"
    assert f"### Seeds without a result\n\n- {told}\n\n## Scores" in (sweep / "leaderboard.md").read_text()
    rows = list(csv.DictReader((sweep / "leaderboard.csv").open()))
    assert [row["reason"] for row in rows if row["method"] == "3dgs"] == ["", "seed 1: scene 'x' lacks weather"]
    page = (sweep / "leaderboard.html").read_text()
    assert page.count('"reason": "seed 1: scene \'x\' lacks weather"') == 1
    write_leaderboard(sweep, board(root, earlier=str(earlier_page(tmp_path, root))))  # which has the seed
    assert "Seeds without" not in (sweep / "leaderboard.md").read_text()


def earlier_page(folder: Path, root: Path) -> Path:
    """A page with another run of the seed."""
    run_of(folder / "earlier", "3dgs", "cooling", 1, 1.0)
    write_leaderboard(folder / "earlier", board(root))
    return folder / "earlier" / "leaderboard.html"


def test_a_sweep_without_results_replaces_no_document(tmp_path, caplog):
    """Such as one that failed before its first run, or a folder that was mistyped."""
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    sweep.mkdir()
    documents = [tmp_path / "board.md", tmp_path / "board.html"]
    for document in documents:
        document.write_text("of weeks")
    asked = board(root, document=str(documents[0]), page=str(documents[1]))
    assert {path.parent for path in write_leaderboard(sweep, asked)} == {sweep} and "no result in" in caplog.text
    assert [document.read_text() for document in documents] == ["of weeks"] * 2
    run_of(sweep, "3dgs", "cooling", 0, 1.0)
    write_leaderboard(sweep, asked)
    assert all("of weeks" not in document.read_text() for document in documents)


def test_more_is_better_where_the_score_says_so(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    for method, off in (("3dgs", 1.0), ("etgs", 0.1)):
        run_of(sweep, method, "cooling", 0, off)
    asked = board(root, protocol=ASKED["protocol"] | {"scores": ["psnr", "mae_c"]})
    write_leaderboard(sweep, asked)
    text = (sweep / "leaderboard.md").read_text()
    assert (
        "| method | above 3dgs | scenes |" in text
        and "`above 3dgs` is the mean difference of a method's psnr to" in text
    )
    assert text.index("| `etgs` | 20.00 | 1 |") < text.index("| `3dgs` | 0.00 | 1 |") and "relative" not in text
    assert "| cooling | near | `etgs` 49.542 | `3dgs` 29.542 |" in text


@pytest.mark.slow
def test_the_command_runs_methods_on_scenes_and_goes_on_where_it_stopped(tmp_path):
    root, sweep = tmp_path / "root", tmp_path / "sweep"
    succeeds(
        [str(ROOT / "src/study.py"), "study=scenes", f"study.target={root}", "study.size=tiny", "study.scenes=[cooling]",
         f"hydra.run.dir={tmp_path}/written"]
    )  # fmt: skip
    command = [
        str(ROOT / "src/train.py"), "experiment=leaderboard", f"leaderboard.root={root}", "leaderboard.methods=[3dgs,supirgs]",
        "leaderboard.tracks=[steps]", "max_steps=6", "threads=2", f"hydra.sweep.dir={sweep}",
    ]  # fmt: skip
    assert "1 tracks x 1 seeds: 1 runs" in succeeds([*command, "leaderboard.seeds=[0]"])
    before = (sweep / "3dgs_cooling_steps_0" / "metrics.json").stat().st_mtime_ns
    assert "3 runs" in succeeds(command)
    assert (sweep / "3dgs_cooling_steps_0" / "metrics.json").stat().st_mtime_ns == before
    assert (sweep / "leaderboard.md").read_text().count("| `3dgs` |") == 1
    page = (sweep / "leaderboard.html").read_text()
    assert "method=3dgs data=benchmark data.scene=cooling" in page
    assert str(root) not in page  # nor any place of this machine
    assert "give the folder of the protocol's scenes" in succeeds([command[0], "experiment=leaderboard"], code=1)
