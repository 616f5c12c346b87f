"""Sweeps: named rows times a grid, the table at the end, failed jobs, and continuing where one stopped."""

import ast
import csv
import itertools
from pathlib import Path

import pytest
import yaml
from commands import succeeds
from finished_runs import job
from hydra.core.utils import JobReturn, JobStatus
from running import NO_PICTURES, compose_run

from heatsplat.composition import scene_name
from heatsplat.contracts import SceneError
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults
from heatsplat.runs.resume import NOT_LEARNED
from heatsplat.studies import sweeps
from heatsplat.studies.finished import NOT_A_ROW, NOT_WHAT_WAS_LEARNED, read_runs, row_names, settings_of
from heatsplat.studies.published.figures import quoted
from heatsplat.studies.sweeps import collect, markdown, picture, write_sweep
from hydra_plugins.heatsplat_sweeper.rows import folder_name

ROOT = Path(__file__).resolve().parents[2]
TRAIN = str(ROOT / "src" / "train.py")


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
    assert rows["K = 24"].values("train_seconds") == [12.0, 13.0] and rows["K = 24"].count == 2
    assert rows["K = 8"].mean("ssim") is None and rows["K = 8"].spread("ssim") is None
    assert rows["broken"].failed == ["SceneError: no points"] and rows["stopped"].failed == ["not finished"]


def test_a_job_that_was_trained_again_counts_once(sweep, caplog):
    job(sweep, 11, ["row='K = 24'", "seed=0"], 36.0)
    job(sweep, 12, ["seed=1", "row='K = 24'"], None)  # did not get to its end
    rows = {row.name: row for row in collect(sweep)}
    assert sorted(rows["K = 24"].values("psnr")) == [36.0, 37.0]
    assert "2 jobs were trained more than once; each counts once" in caplog.text


@pytest.mark.parametrize(
    ("first", "again"),
    [
        (["seed=1"], ["seed=1", "launcher=joblib"]),
        (["seed=1"], ["seed=1", "threads=1"]),
        ([], ["seed=0"]),
        (["seed=1", "row=x"], ["seed=1", "row='x'"]),
        (["seed=1", "data.seed=1"], ["seed=1"]),
    ],
)
def test_a_seed_counts_once_however_it_was_asked_for(first, again, tmp_path):
    job(tmp_path, 0, first, 30.0)
    job(tmp_path, 1, again, 31.0)
    job(tmp_path, 2, [*(text for text in again if "seed=" not in text), "seed=5"], 33.0)
    (row,) = collect(tmp_path)
    assert row.values("psnr") == [31.0, 33.0]


def test_seconds_of_several_machines_or_threads_are_told(sweep):
    """As of a sweep that went on with another launcher, which gives its jobs other threads."""

    def text(**run):
        (path,) = sweep.glob(f"*_0_x/{METRICS_FILE}")
        results = RunResults.read(path)
        results.run |= run
        results.write(path)
        return markdown(collect(sweep), {})

    for number in (1, 2, 3):
        (path,) = sweep.glob(f"*_{number}_x/{METRICS_FILE}")
        results = RunResults.read(path)
        results.run |= {"machine": "EPYC, 4 cores", "threads": 4}
        results.write(path)
    assert "Seconds" not in text() + text(machine="EPYC, 4 cores", threads=4)
    told = "compare within one: EPYC, 4 cores, 1 thread (1 run); EPYC, 4 cores, 4 threads (3 runs)."
    assert told in text(threads=1)


def test_runs_of_several_versions_are_told(sweep):
    """As of a sweep that got another seed after an update."""
    for number, commit in ((0, "fcb7dfd630"), (1, "fcb7dfd630"), (2, "343e0805aa"), (3, None)):
        (path,) = sweep.glob(f"*_{number}_x/{METRICS_FILE}")
        results = RunResults.read(path)
        results.versions = {"heatsplat": "0.1.0", "git_commit": commit}
        results.write(path)
    told = "several versions of heatsplat: 0.1.0 (1 run); 0.1.0 343e0805 (1 run); 0.1.0 fcb7dfd6 (2 runs)."
    assert told in markdown(collect(sweep), {})
    for number in (2, 3):
        (path,) = sweep.glob(f"*_{number}_x/{METRICS_FILE}")
        path.unlink()
    assert "several versions" not in markdown(collect(sweep), {})


def test_recordings_of_a_scene_are_seeds_of_their_own(tmp_path):
    for number, own in enumerate((["data.scene_seed=0"], ["data.scene_seed=1"], ["data.seed=1"])):
        job(tmp_path, number, ["seed=0", *own], 30.0 + number)
    (row,) = collect(tmp_path)
    assert row.count == 3


def test_experiments_that_are_swept_are_rows_of_their_own(tmp_path):
    for number, (name, seed) in enumerate(itertools.product(("one", "two"), (0, 1))):
        job(tmp_path, number, [f"experiment={name}", f"seed={seed}"], 30.0 + number)
    assert {row.label: row.mean("psnr") for row in collect(tmp_path)} == {
        "experiment=one": 30.5,
        "experiment=two": 32.5,
    }


def test_the_table_is_written_for_people_programs_and_eyes(sweep):
    written = write_sweep(sweep, ["K = 24", "K = 8"], {"K = 24": quoted("etgs", "4", "K=24", ["average"])})
    assert [path.name for path in written] == ["table.md", "table.csv", "table.png"]
    text = (sweep / "table.md").read_text()
    assert "| row | runs | PSNR (dB) | MAE (°C) | train (s) | paper: PSNR (dB) | paper: SSIM | paper: LPIPS |" in text
    assert "| K = 24 | 2 | 35.50 ± 2.12 | 4.500 ± 2.121 | 12.5 ± 0.7 | 40.68 | 0.989 | 0.050 |" in text
    assert text.index("K = 24") < text.index("K = 8") and "- broken on cooling: SceneError: no points" in text
    with open(sweep / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert (
        float(rows[0]["psnr"]) == 35.5
        and rows[0]["paper_psnr"] == "40.68"
        and rows[1]["paper_psnr"] == ""
        and rows[2]["failed"] == "1"
    )


def test_own_scores_are_columns_with_their_units(sweep):
    for number, rmse, name in ((0, 0.51234, "rmse_c"), (2, 0.41234, "rmse_c"), (1, 1234.5, "steps_seen")):
        (path,) = sweep.glob(f"*_{number}_x/{METRICS_FILE}")
        results = RunResults.read(path)
        results.put("test", name, rmse)
        results.put("test", "none_at_all", None, "nothing was seen")
        if name == "rmse_c":
            results.definitions[name] = "°C, lower is better: root of the mean square error"
        results.write(path)
    write_sweep(sweep)
    text = (sweep / "table.md").read_text()
    assert "| PSNR (dB) | MAE (°C) | rmse_c (°C) | steps_seen | train (s) |" in text and "none_at_all" not in text
    assert "| 0.4623 ± 0.0707 | – |" in text and "| – | 1,234 (1 of 2) |" in text
    with open(sweep / "table.csv", newline="") as file:
        first, second, *_ = csv.DictReader(file)
    assert (
        float(first["rmse_c"]) == pytest.approx(0.46234)
        and first["steps_seen"] == ""
        and second["steps_seen"] == "1234.5"
    )


def test_scores_of_different_scenes_stand_in_panels_of_their_own(tmp_path, monkeypatch):
    for number, (method, scene) in enumerate([("etgs", "cooling"), ("3dgs", "static")]):
        job(tmp_path, number, [f"method={method}", f"data.scene={scene}"], 30.0 + number, scene=scene)
    assert "No two rows are of one scene" in markdown(collect(tmp_path), {})
    job(tmp_path, 2, ["method=3dgs", "data.scene=cooling"], 33.0, scene="cooling")
    rows = collect(tmp_path)
    assert "No two rows" not in markdown(rows, {})
    panels = picture(rows).axes
    assert [axes.get_title() for axes in panels] == ["cooling", "cooling", "static", "static"]
    monkeypatch.setattr(sweeps, "DRAWN", 1)
    assert len(picture(rows).axes) == 2 and picture(rows).get_suptitle() == "the first 1 of 2 scenes; the table has all"
    labels = [axes.get_legend_handles_labels()[1] for axes in panels]
    assert [len(each) for each in labels] == [2, 2, 1, 1]


def test_a_folder_without_jobs_has_no_table(tmp_path):
    assert write_sweep(tmp_path) == [] and list(tmp_path.iterdir()) == []


def test_a_job_of_a_grid_is_named_by_what_it_sets():
    jobs = [
        {"method": "etgs", "seed": "1", "max_steps": "9", "thermal.frequencies": "8"},
        {"method": "etgs", "seed": "1", "max_steps": "9", "thermal.frequencies": "24"},
        {"method": "3dgs", "seed": "1", "max_steps": "9"},
    ]
    names = [("etgs thermal.frequencies=8", ""), ("etgs thermal.frequencies=24", ""), ("3dgs", "")]
    assert row_names(jobs, ["cooling"] * 3) == names
    assert row_names([{"seed": "1", "data.scene": "cooling"}], ["cooling"]) == [("run", "")]


def test_what_all_rows_have_is_told_once(tmp_path):
    for number, method in enumerate(("etgs", "3dgs")):
        job(tmp_path, number, [f"method={method}", "max_steps=9", "seed=0", "threads=1"], 30.0)
    write_sweep(tmp_path)
    text = (tmp_path / "table.md").read_text()
    assert "All rows: `max_steps=9`." in text and "| etgs | 1 |" in text and "| 3dgs | 1 |" in text


def test_what_makes_no_other_recipe_is_not_in_a_name():
    same = (
        "ckpt=x.ckpt",
        "test=false",
        "data.scene_seed=3",
        "data.seed=3",
        "++seed=1",
        "table.scenes=[wall]",
        "threads=1",
    )
    assert settings_of(dict(text.partition("=")[::2] for text in ("method=etgs", *same))) == []
    assert settings_of({"b": "1", "a": "2"}) == settings_of({"a": "2", "b": "1"}) == ["a=2", "b=1"]


def test_what_runs_may_differ_in_when_they_go_on_and_what_folders_leave_out_makes_no_row():
    known = NOT_A_ROW | NOT_WHAT_WAS_LEARNED
    assert known >= NOT_LEARNED
    train = yaml.safe_load((ROOT / "conf" / "train.yaml").read_text())
    left_out = train["hydra"]["job"]["config"]["override_dirname"]["exclude_keys"]
    assert {key for key in left_out if key not in known and key.partition(".")[0] not in known} == set()


def test_jobs_of_one_row_with_other_settings_are_rows_of_their_own(tmp_path):
    """A folder that two commands filled: means over both lengths would be of nothing."""
    for number, (steps, seed, k) in enumerate(((9, 0, 8), (9, 1, 8), (99, 0, 8), (9, 0, 24), (9, 1, 24))):
        own = [
            f"thermal.frequencies={k}",
            f"seed={seed}",
            f"max_steps={steps}",
            "callbacks.images=null",
            f"row='K = {k}'",
        ]
        job(tmp_path, number, own, 30.0 + steps + seed)
    rows = {row.label: row for row in collect(tmp_path)}
    assert list(rows) == ["K = 8, max_steps=9", "K = 8, max_steps=99", "K = 24"]
    assert [row.count for row in rows.values()] == [2, 1, 2] and rows["K = 8, max_steps=9"].mean("psnr") == 39.5
    write_sweep(tmp_path, ["K = 24", "K = 8"], {"K = 8": {"psnr": "40.57"}})
    text = (tmp_path / "table.md").read_text()
    assert "| K = 8, max_steps=99 | 1 | 129.00 |" in text and text.count("40.57") == 2
    assert text.index("| K = 24 |") < text.index("| K = 8, max_steps=9 |")


@pytest.mark.parametrize("row", [[], ["row=plain"]])
@pytest.mark.parametrize(
    "values",
    [
        ("data.root=/one", "data.root=/other"),
        ("data.scene=one/cooling", "data.scene=other/cooling"),
        ("+trainer.gradient_clip_val=1e-4", "+trainer.gradient_clip_val=null"),
        ("callbacks=default", "callbacks=plateau"),
        ("threads=1", "threads=2"),
    ],
)
def test_a_grid_has_a_row_for_each_value_and_means_over_seeds_alone(values, row, tmp_path):
    for number, (value, seed) in enumerate(itertools.product(values, (0, 1))):
        job(tmp_path, number, ["method=etgs", value, f"seed={seed}", *row], 30.0 + number)
    rows = {row.label: row.mean("psnr") for row in collect(tmp_path)}
    start = "plain, " if row else "etgs "
    assert rows == {f"{start}{values[0]}": 30.5, f"{start}{values[1]}": 32.5}


def test_where_jobs_ran_and_that_they_went_on_makes_no_row(tmp_path):
    job(tmp_path, 0, ["method=etgs", "seed=0", "launcher=joblib", "table.after='a/last.ckpt'"], 30.0)
    job(tmp_path, 1, ["method=etgs", "seed=1", "table.after='b/last.ckpt'", "ckpt=last.ckpt", "threads=1"], 31.0)
    (row,) = collect(tmp_path)
    assert row.label == "etgs" and row.count == 2


def test_a_row_of_several_methods_is_a_row_for_each(tmp_path):
    for number, method in enumerate(("etgs", "3dgs")):
        job(tmp_path, number, [f"method={method}", "row=plain"], 30.0 + number)
    assert {row.label: row.mean("psnr") for row in collect(tmp_path)} == {"plain, etgs": 30.0, "plain, 3dgs": 31.0}


def test_jobs_of_which_nothing_can_be_read_are_told_one_by_one(sweep):
    for number in (1, 3):
        (path,) = sweep.glob(f"*_{number}_x")
        (path / ".hydra" / "overrides.yaml").write_text("{")
    table = markdown(collect(sweep), {})
    assert table.count("overrides.yaml cannot be read") == 2 and "Jobs without a result: 4" in table


def test_scores_that_have_the_name_of_a_column_take_no_other_down(sweep):
    (path,) = sweep.glob(f"*_0_x/{METRICS_FILE}")
    results = RunResults.read(path)
    for name in ("failed", "results", "name"):
        results.put("test", name, 1.0)
    results.write(path)
    assert next(row for row in collect(sweep) if row.name == "K = 8").count == 2
    assert "| row | runs | PSNR (dB) | MAE (°C) | train (s) |" in markdown(collect(sweep), {})


def test_results_that_cannot_be_read_are_told_beside_the_others(sweep):
    damaged = next(path for path in sweep.iterdir() if "_1_" in path.name)
    (damaged / METRICS_FILE).write_text("{")
    rows = {row.label: row for row in collect(sweep)}
    assert rows["K = 24"].count == 1
    (reason,) = rows["K = 24"].failed
    assert f"{damaged / METRICS_FILE} is not a metrics.json" in reason and "Delete the folder" in reason


@pytest.mark.parametrize("name", ["METRICS_FILE", "CURVE_FILE", "FAILED"])
def test_studies_read_files_by_the_names_that_io_gives_them(name):
    package = ROOT / "src" / "heatsplat"
    defined = [
        path.relative_to(package).as_posix()
        for path in sorted([*(package / "io").rglob("*.py"), *(package / "studies").rglob("*.py")])
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign) and any(isinstance(one, ast.Name) and one.id == name for one in node.targets)
    ]
    assert defined == ["io/results.py"]


def test_folders_have_names_that_are_cut_and_still_differ():
    short = "max_steps=3000,seed=0"
    assert folder_name(short) == short
    long = "loss.terms.guided_variation=null," * 6
    names = [folder_name(f"{long}seed={seed}") for seed in range(9)]
    assert len(set(names)) == 9 and max(map(len, names)) <= 120
    assert all(name.startswith(long[:50]) and f",seed={seed}-" in name for seed, name in enumerate(names))
    assert folder_name(f"{long}seed=3") == names[3]  # a sweep that is started again finds its folders
    assert folder_name(f"seed=0,{long}x=1") != folder_name(
        f"seed=0,{long.replace('null', '0', 4)}x=1"
    )  # alike at both ends
    umlauts = folder_name("data.time_csv=" + "zürich_übung_" * 12 + "seed=1")
    assert len(umlauts.encode()) <= 120 and umlauts.startswith("data.time_csv=zürich") and "seed=1-" in umlauts
    inside = {
        folder_name("ckpt=runs/last.ckpt"),
        folder_name("ckpt=runs-last.ckpt"),
        folder_name("ckpt=runs\\last.ckpt"),
    }
    assert len(inside) == 3 and not any("/" in name for name in inside)


def test_folders_of_scenes_with_long_names_fit():
    assert (
        scene_name("colmap", "/data/Dach (Süd)", None) == "Dach--Süd-" and scene_name("colmap", None, None) == "colmap"
    )
    names = [scene_name("colmap", f"/data/{'küche_' * 30}{number}", None) for number in (1, 2)]
    assert names[0] != names[1] and all(len(name.encode()) <= 80 and name.startswith("küche_") for name in names)
    job = folder_name("thermal.source_penalty=0.1," * 20)
    assert len(f"energy_balance_{names[0]}_100_{job}".encode()) <= 255


class Remembering:
    """A launcher whose second job fails."""

    def __init__(self) -> None:
        self.batches: list[tuple[int, list[str]]] = []

    def launch(self, job_overrides: list[list[str]], initial_job_idx: int) -> list[JobReturn]:
        self.batches.append((initial_job_idx, [" ".join(job) for job in job_overrides]))
        returned = [JobReturn(overrides=job, status=JobStatus.COMPLETED) for job in job_overrides]
        for done in returned:
            if done.overrides == ["seed=1"]:
                done.status = JobStatus.FAILED
                done.return_value = RuntimeError("no points")
        return returned


def test_batches_after_one_with_a_failure_run_too_and_the_failure_is_told_at_the_end(tmp_path, monkeypatch):
    config = compose_run("method=3dgs")
    # Imported here: composing loads plugins, and with them the classes that sweep, anew.
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    from hydra_plugins.heatsplat_sweeper.rows import RowSweeper

    launcher = Remembering()
    monkeypatch.setattr("hydra.core.plugins.Plugins.instantiate_launcher", lambda self, **settings: launcher)
    monkeypatch.setattr(BasicSweeper, "validate_batch_is_legal", lambda self, batch: None)
    sweeper = RowSweeper(max_batch_size=2)
    config.hydra = {"sweep": {"dir": str(tmp_path)}}
    context = type("Context", (), {"config_loader": None})()
    sweeper.setup(hydra_context=context, task_function=None, config=config)
    with pytest.raises(RuntimeError, match="no points"):
        sweeper.sweep(["seed=0,1,2,3,4"])
    assert launcher.batches == [(0, ["seed=0", "seed=1"]), (2, ["seed=2", "seed=3"]), (4, ["seed=4"])]
    with pytest.raises(ValueError, match="max_batch_size must be 1 or more, or null for all, got 0"):
        RowSweeper(max_batch_size=0)


@pytest.mark.parametrize(("numbers", "told"), [(19, 0), (20, 1)])
def test_settings_of_many_jobs_are_composed_once_for_all_seeds_and_that_is_told(monkeypatch, caplog, numbers, told):
    compose_run("method=3dgs")
    from hydra.plugins.sweeper import Sweeper

    from heatsplat.studies.rows import Rows
    from hydra_plugins.heatsplat_sweeper.rows import RowSweeper

    composed = []
    monkeypatch.setattr(Sweeper, "validate_batch_is_legal", lambda self, batch: composed.extend(batch))
    sweeper = RowSweeper()
    sweeper.plan = Rows({}, None, None, "3dgs")
    with caplog.at_level("INFO", "heatsplat"):
        sweeper.validate_batch_is_legal(
            [[f"max_steps={k}", f"seed={seed}"] for seed in (0, 1, 2) for k in range(numbers)]
        )
    assert composed == [[f"max_steps={k}", "seed=0"] for k in range(numbers)]
    assert caplog.text.count(f"composing the settings of {numbers} jobs before the first starts") == told


@pytest.mark.parametrize(
    ("size", "expected"),
    [(None, ["seed=0 a", "b c d"]), (2, ["seed=0 a", "b c", "d"]), (1, ["seed=0", "a", "b", "c", "d"])],
)
def test_no_job_starts_before_those_that_come_first_have_ended(size, expected):
    compose_run("method=3dgs")
    from hydra_plugins.heatsplat_sweeper.rows import Batches

    launcher = Remembering()
    returned = Batches(launcher, size, first=2).launch([["seed=0"], ["a"], ["b"], ["c"], ["d"]], initial_job_idx=0)
    assert [" ".join(job) for _, job in launcher.batches] == expected
    starts = [0, *itertools.accumulate(len(jobs) for _, jobs in launcher.batches)]
    assert [start for start, _ in launcher.batches] == starts[:-1]
    assert [job.overrides for job in returned] == [["seed=0"], ["a"], ["b"], ["c"], ["d"]]


def test_a_sweep_runs_all_rows_survives_a_failure_and_goes_on_where_it_stopped(tmp_path):
    """One of three rows cannot be built; the others have results, and the second time only that one is tried again."""
    rows = "{a:{set:[]},b:{set:['thermal.frequencies=2'],printed:'K=16'},c:{set:['data.size=huge']}}"
    command = [
        TRAIN, "-m", "method=etgs", "data.size=tiny", "data.downscale=2",
        "max_steps=4", "trainer.val_check_interval=4", "seed=0", "threads=1", "callbacks.images=null", "callbacks.probes=null",
        "callbacks.viewer=null", "callbacks.dashboard=null", "callbacks.statistics=null", "callbacks.attributes=null",
        "callbacks.costs.fps_repeats=1", *NO_PICTURES, "doctor=false", f"hydra.sweeper.rows={rows}",
        "hydra.sweeper.paper={of:etgs,table:'4',scenes:[average]}",
        f"hydra.sweep.dir={tmp_path}/sweep",
    ]  # fmt: skip
    assert "data.size must be one of" in succeeds(command, code=1, HYDRA_FULL_ERROR="0")
    table = (tmp_path / "sweep" / "table.md").read_text()
    assert "| a | 1 |" in table and "| b | 1 |" in table and "40.59" in table
    assert "- c on cooling:" in table and "got 'huge'" in table
    assert succeeds(command, code=1).count("has results already; skipped") == 2


def test_folders_of_jobs_with_many_overrides_have_names_that_fit(tmp_path):
    many = [
        f"callbacks.{name}=null"
        for name in ("images", "probes", "attributes", "statistics", "dashboard", "checkpoint", "viewer")
    ]
    command = [
        TRAIN, "-m", "method=etgs", "data.size=tiny", "data.downscale=2",
        "max_steps=2", "seed=0", *many, *NO_PICTURES, "doctor=false",
        "thermal.source_penalty=0.000000000000000000000000000000000001", "test=false",
        "callbacks.metrics.lpips_net=null", "callbacks.costs.fps_repeats=1", f"hydra.sweep.dir={tmp_path}/sweep",
    ]  # fmt: skip
    succeeds(command)
    (folder,) = (path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert folder.name.startswith("etgs_cooling_0_") and len(folder.name) < 160


def test_runs_are_found_in_a_folder_at_any_depth_but_not_within_each_other(tmp_path):
    for place in ("a/one", "a/one/evaluations/first", "b/deep/two"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / FAILED).write_text("RuntimeError: broken")
    expected = [tmp_path / "a/one", tmp_path / "b/deep/two"]
    for folders in (tmp_path, str(tmp_path), [str(tmp_path)], expected, [tmp_path, tmp_path / "b"]):
        assert read_runs(folders)["folder"].tolist() == expected
    (tmp_path / "a" / "latest").symlink_to("one")
    (tmp_path / "b" / "deep" / "above").symlink_to("..")
    assert read_runs(tmp_path)["folder"].tolist() == expected
    (tmp_path / "empty").mkdir()
    with pytest.raises(SceneError, match="empty holds no run"):
        read_runs([tmp_path / "empty"])
    with pytest.raises(SceneError, match="there is no folder .*nowhere"):
        read_runs(tmp_path / "nowhere")
