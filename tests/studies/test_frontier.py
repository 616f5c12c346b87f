"""The frontier of finished runs: what is read, who lies on the front, time to a quality, and what is written."""

import csv
import re
from pathlib import Path

import pytest
import yaml

from heatsplat.contracts import SceneError
from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.studies.frontier import dominated, group, read_runs, run, seconds_to


def made(
    folder: Path, method: str, overrides: list[str], course: list[tuple[float, float]], seconds: float, psnr: float
):
    """A run's folder, as far as the frontier reads it."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([f"method={method}", *overrides]))
    rows = ["step,train_seconds,gaussians,psnr,mae_c", *(f"1,{s},10,{v},{40 - v}" for s, v in course), "9,,10,99,0"]
    (folder / "curve.csv").write_text("\n".join(rows) + "\n")
    results = RunResults(run={"scene": "cooling", "method": method})
    results.put("test", "psnr", psnr)
    results.put("test", "mae_c", 40 - psnr)
    results.put("cost", "train_seconds", seconds)
    results.put("cost", "peak_memory_mb", 700.0)
    results.write(folder / METRICS_FILE)


@pytest.fixture
def runs(tmp_path) -> Path:
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        made(tmp_path / f"a{seed}", "etgs", [f"seed={seed}", "max_steps=9"], [(1, 20), (3, 28), (5, 31)], 5.0, psnr)
    made(tmp_path / "sweep" / "b", "3dgs", ["max_steps=9", "threads=1"], [(1, 18), (4, 24)], 4.0, 24.0)
    made(tmp_path / "sweep" / "c", "3dgs", ["max_steps=9", "thermal.sh_degree=2"], [(1, 18), (8, 25)], 8.0, 25.0)
    (tmp_path / "a0" / "evaluations").mkdir()
    (tmp_path / "a0" / "evaluations" / METRICS_FILE).write_text("{}")
    return tmp_path


def test_runs_are_found_at_any_depth_and_grouped_over_seeds(runs):
    recipes = {recipe.name: recipe for recipe in group(read_runs(runs))}
    assert set(recipes) == {"etgs", "3dgs", "3dgs thermal.sh_degree=2"}
    etgs = recipes["etgs"]
    assert len(etgs.runs) == 2 and etgs.mean("psnr") == 31.0 and etgs.spread("psnr") == pytest.approx(2**0.5)
    assert etgs.runs[0].course["psnr"] == [(1, 20), (3, 28), (5, 31)]


def test_the_front_is_what_nothing_beats_in_both(runs):
    front = {recipe.name: recipe.on_front for recipe in group(read_runs(runs))}
    assert front["3dgs"] == {"psnr": True, "mae_c": True}  # the quickest
    assert front["etgs"] == {"psnr": True, "mae_c": True}  # the best
    assert front["3dgs thermal.sh_degree=2"] == {"psnr": False, "mae_c": False}
    assert not dominated(1.0, 2.0, [(1.0, 2.0)]) and dominated(1.0, 2.0, [(1.0, 2.5)])
    assert dominated(1.0, 2.0, [(0.9, 2.0)]) and not dominated(1.0, 2.0, [(0.9, 1.9), (1.1, 2.1)])


def test_time_to_a_quality_lies_on_the_line_between_validations():
    course = [(1.0, 20.0), (3.0, 28.0), (5.0, 26.0), (7.0, 30.0)]
    assert seconds_to(course, 20.0, higher=True) == 1.0 and seconds_to(course, 19.0, higher=True) == 1.0
    assert seconds_to(course, 24.0, higher=True) == 2.0 and seconds_to(course, 29.0, higher=True) == 6.5
    assert seconds_to(course, 31.0, higher=True) is None and seconds_to([], 1.0, higher=True) is None
    falling = [(1.0, 4.0), (2.0, 1.0)]
    assert seconds_to(falling, 2.5, higher=False) == 1.5 and seconds_to(falling, 0.5, higher=False) is None


def test_tables_pictures_and_a_page_that_needs_nothing_else(runs, tmp_path):
    run(tmp_path / "out", [str(runs)])
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert "| etgs | 2 | 5.0 | 31.00 ± 1.41 |" in text and "| PSNR, MAE |" in text
    assert re.search(r"\| seconds to \|.* 25 dB \|.* 30 dB \|", text) and "| 3dgs |" in text
    with open(tmp_path / "out" / "frontier.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert sum(row["views"] == "test" for row in rows) == 8
    assert sum(row["views"] == "validation" for row in rows) == 2 * (3 + 3 + 2 + 2)
    page = (tmp_path / "out" / "frontier.html").read_text()
    assert "data:image/svg+xml;base64," in page and not re.search(r'(?:src|href)="(?!data:)', page)
    assert (tmp_path / "out" / "frontier.png").stat().st_size > 10_000 and list((tmp_path / "out" / "tb").iterdir())


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"there is no finished run .*Give folders that src/train.py wrote"):
        run(tmp_path / "out", str(tmp_path))
