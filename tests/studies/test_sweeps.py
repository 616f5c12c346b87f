"""Sweeps: named rows times a grid, the table at the end, failed jobs, and continuing where one stopped."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from running import compose_run

from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.studies.sweeps import collect, row_name, write_sweep

ROOT = Path(__file__).resolve().parents[2]
ABLATIONS = sorted((ROOT / "conf" / "ablation").glob("*.yaml"))


def job(folder: Path, number: int, overrides: list[str], psnr: float | None, **costs: float) -> Path:
    """A job's folder as a run leaves it."""
    path = folder / f"etgs_cooling_{number}_x"
    (path / ".hydra").mkdir(parents=True)
    (path / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (path / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"data": {"scene": "cooling"}}))
    if psnr is not None:
        results = RunResults(run={"scene": "cooling"})
        results.put("test", "psnr", psnr)
        results.put("test", "mae_c", 40.0 - psnr)
        results.put("cost", "train_seconds", costs.get("seconds", 10.0))
        results.write(path / METRICS_FILE)
    return path


@pytest.fixture
def sweep(tmp_path) -> Path:
    for seed in (0, 1):
        job(tmp_path, 2 * seed, [f"seed={seed}", "row='K = 8'"], 30.0 + seed, seconds=10.0)
        job(tmp_path, 2 * seed + 1, [f"seed={seed}", "row='K = 24'"], 34.0 + 3 * seed, seconds=12.0 + seed)
    broken = job(tmp_path, 4, ["seed=0", "row=broken"], None)
    (broken / "FAILED").write_text("Traceback\n...\nSceneError: no points\n")
    job(tmp_path, 10, ["seed=0", "row=stopped"], None)
    return tmp_path


def test_rows_have_means_spreads_and_reasons(sweep):
    rows = {row.name: row for row in collect(sweep)}
    assert list(rows) == ["K = 8", "K = 24", "broken", "stopped"]
    assert rows["K = 8"].mean("psnr") == 30.5 and rows["K = 8"].spread("psnr") == pytest.approx(0.5**0.5)
    assert rows["K = 24"].values["train_seconds"] == [12.0, 13.0] and rows["K = 24"].jobs == 2
    assert rows["K = 8"].mean("ssim") is None and rows["K = 8"].spread("ssim") is None
    assert rows["broken"].failed == ["SceneError: no points"] and rows["stopped"].failed == ["not finished"]


def test_the_table_is_written_for_people_programs_and_eyes(sweep):
    written = write_sweep(sweep, ["K = 24", "K = 8"], {"K = 24": "40.68 dB"})
    assert [path.name for path in written] == ["table.md", "table.csv", "table.png"]
    text = (sweep / "table.md").read_text()
    assert "| row | runs | PSNR (dB) | MAE (°C) | train (s) | paper |" in text
    assert "| K = 24 | 2 | 35.50 ± 2.12 | 4.500 ± 2.121 | 12.5 ± 0.7 | 40.68 dB |" in text
    assert text.index("K = 24") < text.index("K = 8") and "- broken on cooling: SceneError: no points" in text
    with open(sweep / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["psnr"]) == 35.5 and rows[0]["paper"] == "40.68 dB" and rows[2]["failed"] == "1"


def test_a_folder_without_jobs_has_no_table(tmp_path):
    assert write_sweep(tmp_path) == [] and list(tmp_path.iterdir()) == []


def test_a_job_of_a_grid_is_named_by_what_it_sets():
    assert row_name({"method": "etgs", "seed": "1", "thermal.frequencies": "8"}) == "etgs thermal.frequencies=8"
    assert row_name({"seed": "1", "data.scene": "cooling"}) == "run"


@pytest.mark.parametrize("path", ABLATIONS, ids=lambda path: path.stem)
def test_rows_of_an_ablation_are_different_recipes_that_compose(path, tmp_path):
    rows = yaml.safe_load(path.read_text())["hydra"]["sweeper"]["rows"]
    method, recipes = path.stem.partition("_")[0], []
    for name, row in rows.items():
        config = compose_run(tmp_path, f"method={method}", *row.get("set", []), f"row='{name}'")
        recipes.append({key: value for key, value in config.items() if key != "row"})
    texts = [str(recipe) for recipe in recipes]
    assert len(set(texts)) == len(rows) > 1


def test_a_sweep_runs_all_rows_survives_a_failure_and_goes_on_where_it_stopped(tmp_path):
    """One of three rows cannot be built; the others have results, and the second time only that one is tried again."""
    rows = "{a:{set:[]},b:{set:['thermal.frequencies=2'],paper:'40 dB'},c:{set:['data.size=huge']}}"
    command = [
        sys.executable, str(ROOT / "src" / "train.py"), "-m", "method=etgs", "data.size=tiny", "data.downscale=2",
        "max_steps=4", "seed=0", "callbacks.images=null", "callbacks.probes=null", f"hydra.sweeper.rows={rows}",
        f"hydra.sweep.dir={tmp_path}/sweep",
    ]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "HYDRA_FULL_ERROR": "0"})
    assert first.returncode != 0 and "data.size=huge: choose one of" in first.stdout + first.stderr
    table = (tmp_path / "sweep" / "table.md").read_text()
    assert "| a | 1 |" in table and "| b | 1 |" in table and "40 dB" in table
    assert "- c on cooling:" in table and "data.size=huge" in table
    again = subprocess.run(command, capture_output=True, text=True)
    assert (again.stdout + again.stderr).count("has results already; skipped") == 2


def test_folders_of_jobs_with_many_overrides_have_names_that_fit(tmp_path):
    many = [
        f"callbacks.{name}=null" for name in ("images", "probes", "attributes", "statistics", "dashboard", "checkpoint")
    ]
    command = [
        sys.executable, str(ROOT / "src" / "train.py"), "-m", "method=etgs", "data.size=tiny", "data.downscale=2",
        "max_steps=2", "seed=0", *many, "thermal.source_l2=0.000000000000000000000000000000000001", "test=false",
        "callbacks.metrics.lpips_net=null", "callbacks.costs.fps_repeats=1", f"hydra.sweep.dir={tmp_path}/sweep",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    (folder,) = (path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert folder.name.startswith("etgs_cooling_0_") and len(folder.name) < 160
