"""Tables of the papers: what is planned, what is missing and told, and ours beside the paper's."""

import csv
import re
import sys
from collections.abc import Collection
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from commands import succeeds
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from running import NO_PICTURES, compose_run

from heatsplat import cli
from heatsplat.contracts import SceneError
from heatsplat.io.results import RunResults
from heatsplat.studies.finished import Runs
from heatsplat.studies.published.comparison import compare, compare_all, markdown, write_comparison
from heatsplat.studies.published.reproduction import Reproduction, Run, reproduction_of
from heatsplat.studies.published.sources import source

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENTS = sorted((ROOT / "conf" / "experiment").glob("table_*.yaml"))
ALL_METHODS = sorted(path.stem for path in (ROOT / "conf" / "method").glob("*.yaml"))
METHODS = ("3dgs", "direct_3dgs", "energy_balance", "etgs", "ntr_gaussian", "ravigs", "supirgs", "thermogs", "ti3dgs")
SHARED = yaml.safe_load((ROOT / "conf" / "experiment" / "shared" / "table.yaml").read_text())["table"]


def config_of(name: str, **changes: object) -> dict:
    """The section "table" of an experiment."""
    own = yaml.safe_load((ROOT / "conf" / "experiment" / f"table_{name}.yaml").read_text())["table"]
    return SHARED | own | changes


def rows_of(config: dict) -> dict:
    """Rows of the ablation that the table names."""
    if not config["ablation"]:
        return {}
    return yaml.safe_load((ROOT / "conf" / "ablation" / f"{config['ablation']}.yaml").read_text())["hydra"]["sweeper"][
        "rows"
    ]


def reproduced(
    name: str, root: Path | None = None, given: tuple[str, ...] = (), have: Collection[str] = METHODS, **changes: object
) -> Reproduction:
    """The reproduction where heatsplat has the methods ``have``."""
    config = config_of(name, **changes)
    return reproduction_of(config, None if root is None else str(root), have, rows_of(config), given)


def put(root: Path, marker: str, *scenes: str) -> Path:
    for scene in scenes:
        (root / scene / marker).mkdir(parents=True)
    return root


def after(run: Run) -> list[str]:
    """What the sweep adds to a run that comes after another."""
    return ["table.after=others/checkpoints/last.ckpt"] if run.after else []


def everything(root: Path, name: str) -> Path:
    """A root with an empty folder for every scene that the table wants."""
    reproduction = reproduced(name)
    if reproduction.source:
        put(root, reproduction.source.any[0], *reproduction.missing)
    return root


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_every_table_is_filled_and_composes(path, tmp_path):
    name = path.stem.removeprefix("table_")
    reproduction = reproduced(name, everything(tmp_path, name), have=ALL_METHODS)
    assert not reproduction.missing and (reproduction.runs or not reproduction.source)
    trained = {(run.method, run.setting) for run in reproduction.runs}
    assert {row for row in reproduction.rows if row not in reproduction.absent} == trained
    if config_of(name)["ablation"] or not reproduction.source:
        return  # composed by the slow test
    run = next(run for run in reproduction.runs if run.method == reproduction.paper)
    composed = compose_run(f"experiment={path.stem}", *run.overrides, f"row='{run.row}'")
    assert composed.table.paper == reproduction.paper and composed.data.scene == run.folder
    assert composed.data._target_.split(".")[2] == {"ti3dgs_own": "ti_nsd"}.get(
        reproduction.source.key, reproduction.source.key
    )
    assert composed.max_steps == composed.published.steps == 30000
    assert composed.trainer.max_steps == (7000 if run.setting == "7k" else -1)


@pytest.mark.slow
@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_every_row_of_every_table_composes_as_a_stored_config_its_own(path, tmp_path):
    name = path.stem.removeprefix("table_")
    reproduction = reproduced(name, everything(tmp_path, name), have=ALL_METHODS)
    first = {run.row: run for run in reversed(reproduction.runs)}
    assert compose_run(f"experiment={path.stem}").table.paper == reproduction.paper
    made = [
        {
            key: value
            for key, value in compose_run(f"experiment={path.stem}", *run.overrides, *after(run)).items()
            if key != "data"
        }
        for run in first.values()
    ]
    assert len({str(config) for config in made}) == len(first)


def test_scenes_are_found_by_name_other_name_and_what_is_told(tmp_path):
    root = put(tmp_path / "RHD", "thermal/sparse", "Cooling-Bench", "cooling_dumbbels", "my_bike")
    (root / "heat_transfer").mkdir()  # no scene: nothing in it
    reproduction = reproduced("etgs_1", root, folders={"cooling_ebike": "my_bike"})
    found = {run.scene: run.folder for run in reproduction.runs}
    assert found == {
        "cooling_bench": "Cooling-Bench",
        "cooling_dumbbells": "cooling_dumbbels",
        "cooling_ebike": "my_bike",
    }
    assert "heat_transfer" in reproduction.missing and len(reproduction.missing) == 7
    assert [run.row for run in reproduction.runs] == ["3dgs"] * 3 + ["ntr_gaussian"] * 3 + ["etgs"] * 3
    assert (
        reproduction.runs[-1].overrides[0] == "method=etgs"
        and "data.scene='Cooling-Bench'" in reproduction.runs[-2].overrides
    )


def test_folders_are_told_apart_in_any_script(tmp_path):
    """Names without a Latin letter were all one, and a told name was only as good as its likeness."""
    rhd = source("rhd")
    for name in ("长凳", "电动车", "cups", "cups-", "Bu\u0308gel"):
        (tmp_path / name / "sparse").mkdir(parents=True)
    told = {"cooling_bench": "长凳", "cooling_ebike": "电动车", "warming_cups": "cups-", "heat_transfer": "b\u00fcgel"}
    assert rhd.find(tmp_path, told) == {**told, "heat_transfer": "Bu\u0308gel"}
    assert rhd.find(tmp_path, told | {"warming_cups": "cups"})["warming_cups"] == "cups"
    assert rhd.scene_of("电动车", told) == "cooling_ebike" and rhd.scene_of("杯子", told) is None


def test_folders_are_told_on_the_command_line_by_the_scenes_of_the_table(tmp_path):
    root = put(tmp_path / "RHD", "sparse", "my_bench")
    typed = "table.folders={cooling_bench: my_bench}"
    table = OmegaConf.to_container(compose_run("experiment=table_etgs_1", typed).table)
    assert {(run.scene, run.folder) for run in reproduction_of(table, str(root), METHODS).runs} == {
        ("cooling_bench", "my_bench")
    }
    for wrong, message in (
        ({"bench": "my_bench"}, r"table.folders: bench is no scene of RHD \(ETGS\); there are cooling_checkboard, "),
        ("my_bench", r"such as 'table.folders=\{cooling_checkboard: NAME\}'"),
    ):
        with pytest.raises(SceneError, match=message):
            reproduced("etgs_1", None, folders=wrong)


def test_a_run_on_an_unseen_scene_comes_after_one_on_all_others(tmp_path):
    reproduction = reproduced("thermogs_2", put(tmp_path, "meta.json", "S1", "S2", "S3", "S4"))
    rows = ["ntr_gaussian_cross_time", "thermogs_cross_scene", "thermogs_cross_time"]
    assert [run.row for run in reproduction.runs] == [row for row in rows for _ in range(4)]
    assert reproduction.absent["ntr_gaussian", "cross_scene"] == "its networks are of one scene"
    assert reproduction.absent["thermalgs", "cross_scene"] == "its features are of one scene"
    assert {run.after for run in reproduction.runs if run.setting == "cross_time"} == {None}
    second = reproduction.runs[5]
    assert second.job(["max_steps=5"]) == [
        "max_steps=5", "method=thermogs", "data.scene='S2'", "row='thermogs_cross_scene'"
    ]  # fmt: skip
    assert second.after.job(["data.root=/x", "+data.latitude=47", "data.each.altitude_m=9", "seed=1"]) == [
        "data.root=/x", "+data.each.latitude=47", "data.each.altitude_m=9", "seed=1", "method=thermogs", "data=scenes",
        "data@data.each=thermo", "data.scenes=['S1','S3','S4']", "row='thermogs_cross_scene_others'",
    ]  # fmt: skip
    told = reproduction.summary()
    assert "12 runs (3 rows x 4 of 4 scenes)" in told
    assert "Before them, 4 runs: thermogs_cross_scene_others on S2+S3+S4, " in told
    more = reproduced("thermogs_2", tmp_path, methods=["energy_balance"])
    assert more.absent["energy_balance", "cross_scene"] == "nothing of it is shared by scenes"


def test_a_scene_is_not_left_out_while_others_are_not_on_disk(tmp_path):
    reproduction = reproduced("thermogs_2", put(tmp_path, "meta.json", "S1", "S2", "S4"), scenes=["thermo_s1"])
    assert [run.row for run in reproduction.runs] == ["ntr_gaussian_cross_time", "thermogs_cross_time"]
    reason = "Not run: thermogs_cross_scene on thermo_s1, which comes after a run on all the other scenes; thermo_s3 is"
    assert reason in reproduction.summary() and reason in markdown(reproduction, compare(reproduction, {}))


def test_unseen_times_are_means_over_scenes_and_unseen_scenes_stand_alone(tmp_path):
    reproduction = reproduced("thermogs_2", everything(tmp_path, "thermogs_2"))
    found = {}
    for i, scene in enumerate(reproduction.source.scenes):
        found |= results(scene, "thermogs_cross_time", psnr=30.0 + i)
        found |= results(scene, "thermogs_cross_scene", psnr=20.0 + i)
    lines = {(line.scene, line.setting): line for line in compare(reproduction, found) if line.method == "thermogs"}
    mean, third = lines["thermo_s1_s4", "cross_time"], lines["thermo_s3", "cross_scene"]
    assert mean.ours["psnr"] == 31.5 and mean.printed["psnr"].printed == "31.83"
    assert third.ours["psnr"] == 22.0 and third.printed["psnr"].printed == "26.03" and len(lines) == 5


def test_all_that_is_missing_is_told_in_one_message(tmp_path):
    told = reproduced("etgs_1").summary(lpips_weights=str(tmp_path / "none.pth"))
    for scene in reproduced("etgs_1").source.scenes:
        assert scene in told
    for text in (
        "data.root is not set",
        "https://huggingface.co/datasets/jankinkin/RHD_dataset",
        "thermal/sparse/0/{cameras,images,points3D}.bin",
        "thermal/info.json",
        "mip_splatting, thermal3dgs, hexplane_4dgs (heatsplat does not have it)",
        "LPIPS will be n/a",
        "Rows: 3dgs, ntr_gaussian, etgs",
        "data.root=/data/rhd",
    ):
        assert text in told, text
    gone = reproduced("ravigs_1", tmp_path / "gone").summary()
    assert f"there is no folder {tmp_path / 'gone'}" in gone and "zenodo.org/records/15609062" in gone
    some = reproduced("etgs_1", put(tmp_path, "sparse", "cooling_bench")).summary()
    assert "3 runs (3 rows x 1 of 10 scenes)" in some and "Missing: 9 scenes" in some and f"not in {tmp_path}" in some


def test_tables_of_facts_train_nothing_and_say_so():
    for name in ("etgs_5", "thermogs_1", "thermogs_7", "thermogs_8"):
        reproduction = reproduced(name)
        assert (
            not reproduction.runs
            and not reproduction.missing
            and "nothing of this table is trained" in reproduction.summary()
        )
    text = markdown(reproduced("thermogs_7"), compare(reproduced("thermogs_7"), {}))
    assert "no data set on disk has the true materials" in text and "| – / " in text


def test_what_is_asked_for_limits_the_runs_and_not_the_table(tmp_path):
    root = put(tmp_path, "images", "apples", "wall", "bridge")
    reproduction = reproduced("ti3dgs_i", root, methods=["ti3dgs"], settings=["7k"], scenes=["wall"])
    assert [(run.method, run.setting, run.scene) for run in reproduction.runs] == [("ti3dgs", "7k", "wall")]
    assert reproduction.runs[0].overrides == ("method=ti3dgs", "trainer.max_steps=7000", "data.scene='wall'")
    assert reproduction.absent["ti3dgs", "30k"] == "not asked for" and ("plenoxels", "") in reproduction.rows
    assert reproduced("ti3dgs_i", root, methods="ti3dgs", settings="7k", scenes="wall").runs == reproduction.runs
    assert [run.row for run in reproduced("ti3dgs_i", root, methods="etgs", settings="7k", scenes="wall").runs] == [
        "etgs_7k"
    ]
    grouped = reproduced("ti3dgs_iv", root, scenes=["ti_nsd_outdoor"])
    assert {run.scene for run in grouped.runs} == {"bridge"} and len(grouped.missing) == 6


def test_the_command_line_wins_over_the_settings_of_the_table(tmp_path):
    root = put(tmp_path, "images", "wall")
    runs = reproduced("ti3dgs_i", root, ("trainer.max_steps",)).runs
    assert all("max_steps" not in text for run in runs for text in run.overrides)


def test_methods_beyond_the_paper_join_its_table(tmp_path):
    reproduction = reproduced("etgs_1", put(tmp_path, "sparse", "cooling_bench"), methods=["etgs", "energy_balance"])
    assert [run.row for run in reproduction.runs] == ["etgs", "energy_balance"]
    lines = compare(reproduction, {("energy_balance", "cooling_bench"): runs("energy_balance", "x", psnr=39.0)})
    (line,) = (line for line in lines if line.method == "energy_balance" and line.scene == "cooling_bench")
    assert line.ours == {"psnr": 39.0} and not line.printed
    assert "| cooling_bench | energy_balance | 39.00 / – | – | – |" in markdown(reproduction, lines)


@pytest.mark.parametrize(
    ("name", "given", "changes", "message"),
    [
        ("etgs_1", ("method",), {}, r"method=...: a table has several; choose among them with table.methods"),
        ("etgs_1", ("data.scene",), {}, r"choose among them with table.scenes"),
        (
            "etgs_1",
            (),
            {"methods": ["nerf"]},
            r"table.methods: nerf is neither in the table \(3dgs, .* nor in conf/method",
        ),
        ("ti3dgs_i", (), {"settings": ["8k"]}, r"table.settings: 8k is not in the table; there are '', 7k, 30k"),
        ("etgs_1", (), {"scenes": ["bench"]}, r"table.scenes: bench is not in the table; there are cooling_checkboard"),
        ("ti3dgs_i", (), {"protocols": {}}, r"setting 7k is in none of table.protocols"),
    ],
)
def test_what_does_not_exist_is_named_with_what_does(name, given, changes, message):
    with pytest.raises(SceneError, match=message):
        reproduced(name, None, given, **changes)


@pytest.mark.parametrize("knob", ["seed=0,1", "optim.decay=1.0,0.5"])
def test_every_job_of_a_table_has_a_folder_of_its_own(knob, tmp_path):
    """Names are cut, and a seed or a knob may stand behind the cut; without their own folders, jobs are taken for done."""
    root = everything(tmp_path, "ravigs_4")
    reproduction = reproduced("ravigs_4", root, settings=["baseline", "grad"], scenes=["double_robot"])
    key, _, values = knob.partition("=")
    folders = []
    for run in reproduction.runs:
        for value in values.split(","):
            given = ["max_steps=3000", f"{key}={value}", f"data.root={root}", "callbacks.images=null"]
            compose_run("experiment=table_ravigs_4", *given, *run.overrides, f"row='{run.row}'")
            folders.append(HydraConfig.get().sweep.subdir)
    assert len(folders) == 4 == len(set(folders))
    assert all(
        folder.startswith(f"{run.row}_double_robot_")
        for folder, run in zip(folders[::2], reproduction.runs, strict=True)
    )
    assert max(len(folder.encode()) for folder in folders) < 200
    compose_run("experiment=table_ravigs_4", *given, *run.overrides, f"row='{run.row}'")
    assert HydraConfig.get().sweep.subdir == folders[-1]  # so that a stopped sweep goes on


def test_runs_of_one_row_with_other_settings_have_lines_of_their_own(tmp_path):
    """A folder that two commands filled."""
    reproduction = reproduced("etgs_1", put(tmp_path / "RHD", "sparse", "cooling_bench"))
    found = [
        runs("etgs", "cooling_bench", "max_steps=300", psnr=38.0),
        runs("etgs", "cooling_bench", "max_steps=3000", psnr=39.0),
        runs("3dgs", "cooling_bench", psnr=30.0),
    ]
    lines = compare_all(reproduction, found)
    text = markdown(reproduction, lines)
    assert "| cooling_bench | etgs, max_steps=300 | 38.00 / 38.25 (-0.25) |" in text
    assert "| cooling_bench | etgs, max_steps=3000 | 39.00 / 38.25 (+0.75) |" in text
    assert "| cooling_bench | 3dgs | 30.00 / " in text and "| cooling_bench | mip_splatting | – / " in text
    assert len([line for line in lines if line.scene == "cooling_bench"]) == 1 + len(
        compare_at(reproduction, "cooling_bench")
    )
    assert sum(line.scene == "mean of the scenes that ran" for line in lines) == 3
    assert compare_all(reproduction, found[2:]) == compare(reproduction, {("3dgs", "cooling_bench"): found[2]})


def compare_at(reproduction: Reproduction, scene: str) -> list:
    return [line for line in compare(reproduction, {}) if line.scene == scene]


def runs(row: str, scene: str, other: str = "", **values: float | list[float]) -> Runs:
    table = pd.DataFrame({name: pd.Series(value) for name, value in values.items()})
    return Runs(row, scene, table.assign(failed=None), other)


def results(scene: str, row: str, **values: float | list[float]) -> dict:
    return {(row, scene): runs(row, scene, **values)}


def test_ours_stands_beside_the_printed_value_with_the_difference_and_its_cost(tmp_path):
    reproduction = reproduced("etgs_1", put(tmp_path, "sparse", "cooling_bench", "cooling_ebike"))
    found = results("cooling_bench", "etgs", psnr=[38.0, 39.0], ssim=0.98, train_seconds=100.0, gaussians=1000.0)
    found |= results("cooling_ebike", "etgs", psnr=[40.0, 41.0], ssim=0.99, train_seconds=200.0, gaussians=3000.0)
    lines = {(line.scene, line.method): line for line in compare(reproduction, found)}
    bench = lines["cooling_bench", "etgs"]
    assert bench.printed["psnr"].printed == "38.25" and bench.difference("psnr") == pytest.approx(0.25)
    assert bench.seeds == 2 and bench.spread["psnr"] == pytest.approx(0.5**0.5)
    assert lines["average", "etgs"].ours == {}  # two of ten scenes are not the paper's average
    ran = lines["mean of the scenes that ran", "etgs"]
    assert ran.ours["psnr"] == 39.5 and ran.theirs["psnr"] == pytest.approx((38.25 + 41.67) / 2)
    assert ran.cost == {"train_seconds": 150.0, "gaussians": 2000.0} and ran.label.endswith("(2 of 10)")
    text = markdown(reproduction, list(lines.values()))
    assert (
        "| cooling_bench | etgs | 38.50 ± 0.71 / 38.25 (+0.25) | 0.9800 / 0.983 (-0.0030) | – / 0.050 | 100.0 | 1,000 |"
        in text
    )
    assert "| cooling_bench | mip_splatting | – / " in text


def test_an_average_over_all_scenes_is_their_mean(tmp_path):
    reproduction = reproduced("etgs_1", everything(tmp_path, "etgs_1"))
    found = {}
    for i, scene in enumerate(reproduction.source.scenes):
        found |= results(scene, "3dgs", psnr=30.0 + i)
    lines = [line for line in compare(reproduction, found) if line.method == "3dgs"]
    average = next(line for line in lines if line.scene == "average")
    assert average.ours["psnr"] == 34.5 and average.difference("psnr") == pytest.approx(34.5 - 32.16)
    assert not any(line.scene == "mean of the scenes that ran" for line in lines)


def test_groups_and_unnamed_scenes_are_means_and_units_are_the_papers(tmp_path):
    root = put(tmp_path, "images", "apples", "wall", "UAV1")
    reproduction = reproduced("supirgs_3", root)
    found = results("apples", "3dgs", train_seconds=600.0, render_fps=10.0) | results(
        "wall", "3dgs", train_seconds=1200.0, render_fps=30.0
    )
    printed, line = (line for line in compare(reproduction, found) if line.method == "3dgs")
    assert printed.label == "(scenes not named)" and printed.ours == {}
    assert line.ours == {"train_min": 15.0, "fps": 20.0} and line.theirs == {}
    assert line.label == "mean of the scenes that ran (2 of 20)"
    small = [run for run in reproduction.runs if run.method == "3dgs"]
    assert len(small) == 3 and small[0].overrides[:2] == ("method=3dgs", "data.degrade=lr4")
    tones = reproduced("supirgs_1", root)
    found = (
        results("apples", "supirgs", psnr=30.0)
        | results("wall", "supirgs", psnr=32.0)
        | results("uav1", "supirgs", psnr=9.0)
    )
    by_scene = {line.label: line for line in compare(tones, found) if line.method == "supirgs"}
    indoor = by_scene["mean of the scenes that ran, ti_nsd_indoor (2 of 7)"]
    assert indoor.ours["psnr"] == 31.0 and indoor.difference("psnr") is None
    assert by_scene["mean of the scenes that ran, ti_nsd_uav (1 of 6)"].ours["psnr"] == 9.0
    assert {by_scene[f"ti_nsd_{place}"].ours.get("psnr") for place in ("indoor", "outdoor", "uav")} == {None}


def test_a_mean_over_some_scenes_is_not_compared_with_the_printed_mean_over_all(tmp_path):
    reproduction = reproduced("etgs_4", everything(tmp_path, "etgs_4"))
    scenes = list(reproduction.source.scenes)
    found = {key: one for scene in scenes[:3] for key, one in results(scene, "etgs_K=24", psnr=15.0).items()}
    text = markdown(reproduction, compare(reproduction, found))
    assert "| average | etgs | K=24 | – / 40.68 |" in text and "average (3 of 10)" not in text
    assert "| mean of the scenes that ran (3 of 10) | etgs | K=24 | 15.00 / – |" in text
    found |= {key: one for scene in scenes[3:] for key, one in results(scene, "etgs_K=24", psnr=15.0).items()}
    assert "| average | etgs | K=24 | 15.00 / 40.68 (-25.68) |" in markdown(reproduction, compare(reproduction, found))


def write_fake(layout: str, root: Path, *scenes: str) -> Path:
    """A data set with scenes that are the synthetic room, or the yard with its weather for Thermo."""
    from dataclasses import replace

    from scene_files import LAYOUTS

    from heatsplat.datamodules.synthetic_scene.film import SIZES, film
    from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
    from heatsplat.datamodules.synthetic_scene.presets import PRESETS
    from heatsplat.datamodules.synthetic_scene.scene import Scene

    world = OutdoorScene(OUTDOOR["outdoor"]) if layout == "thermo" else Scene(PRESETS["cooling"])
    recording = film(world, replace(SIZES["tiny"], frames=12, points=200))
    for scene in scenes:
        LAYOUTS[layout](recording, root / scene)
    return root


def command(*overrides: str, code: int = 0) -> str:
    return succeeds([str(ROOT / "src" / "train.py"), *overrides], code=code, COLUMNS="200")


SHORT = (
    "max_steps=4", "threads=1", "data.downscale=2", "trainer.val_check_interval=4", "trainer.limit_val_batches=1",
    "trainer.limit_test_batches=2", "callbacks.images=null", "callbacks.probes=null", "callbacks.costs.fps_repeats=1",
    "callbacks.viewer=null", "doctor=false", *NO_PICTURES,
)  # fmt: skip
UNLOGGED = ("callbacks.dashboard=null", "callbacks.statistics=null", "callbacks.attributes=null", "logger=none")


def test_one_command_trains_a_table_and_prints_ours_beside_the_papers(tmp_path, monkeypatch, caplog):
    """In this process, to save its start; the slow tests give the command as a user does."""
    root = write_fake("rhd", tmp_path / "RHD", "cooling_dumbbels")
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none")  # as this process has it
    overrides = ("experiment=table_etgs_7", f"data.root={root}", "table.methods=[etgs]", *SHORT, *UNLOGGED, *quiet)
    monkeypatch.setattr(sys, "argv", ["train.py", *overrides, f"hydra.sweep.dir={tmp_path}/sweep"])
    with caplog.at_level("INFO", logger="heatsplat"):
        cli.train()
    assert "Missing: 9 scenes" in caplog.text and "ETGS, Tab. 7: ours beside the paper's" in caplog.text
    with open(tmp_path / "sweep" / "comparison.csv", newline="") as file:
        rows = {(row["scene"], row["method"], row["metric"]): row for row in csv.DictReader(file)}
    ours = rows["cooling_dumbbells", "etgs", "train_s"]
    assert 0 < float(ours["ours"]) == float(ours["train_seconds"]) and float(ours["gaussians"]) > 0
    assert float(ours["difference"]) == pytest.approx(float(ours["ours"]) - float(ours["printed"]))
    assert (
        rows["cooling_dumbbells", "3dgs", "train_s"]["ours"] == ""
        and rows["cooling_bench", "etgs", "train_s"]["printed"]
    )
    assert (tmp_path / "sweep" / "table.md").exists()
    (folder,) = (path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert folder.name.startswith("etgs_cooling_dumbbels_") and (folder / "metrics.json").exists()


def test_one_command_trains_on_the_other_scenes_first_and_goes_on_when_that_failed(tmp_path, monkeypatch, caplog):
    root = write_fake("thermo", tmp_path / "Thermo", "S1", "S2", "S3", "S4")
    weather = (root / "S3" / "weather.csv").rename(tmp_path / "weather.csv")
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none", "thermal.width=16", f"data.root={root}")
    asked = ("table.methods=[thermogs]", "table.scenes=[thermo_s2]", "table.settings=[cross_scene]")
    overrides = ["experiment=table_thermogs_2", *asked, *SHORT, *UNLOGGED, *quiet, f"hydra.sweep.dir={tmp_path}/sweep"]
    comparison = tmp_path / "sweep" / "comparison.md"

    def go(*more: str) -> str:
        caplog.clear()
        monkeypatch.setattr(sys, "argv", ["train.py", *overrides, *more])
        with caplog.at_level("INFO", logger="heatsplat"):
            cli.train()
        return caplog.text

    told = go("table.dry=true")
    assert "1 runs (1 rows x 1 of 1 scenes)" in told and not comparison.exists()
    assert "Before them, 1 runs: thermogs_cross_scene_others on S1+S3+S4" in told
    with pytest.raises(SystemExit):
        go()
    failed = comparison.read_text().partition("## Jobs without a result\n\n")[2].partition("\n\n")[0].splitlines()
    reasons = dict(line.removeprefix("- ").split(": ", 1) for line in failed)
    why = reasons["thermogs_cross_scene_others on S1+S3+S4"]
    assert "lacks 'weather'" in why and len(reasons) == 2
    assert f"the run that comes before this one has no results: {why}" in reasons["thermogs_cross_scene on S2"]

    weather.rename(root / "S3" / "weather.csv")
    assert "has results already" not in go()
    first, then = sorted((tmp_path / "sweep").glob("thermogs*"), key=lambda path: "_others_" not in path.name)
    stored = [torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for run in (first, then)]
    assert torch.equal(*(state["thermal.network.own.weight"] for state in stored))
    assert len(stored[0]["splats.raw.means"]) > len(stored[1]["splats.raw.means"])
    assert re.search(r"\| thermo_s2 \| thermogs \| cross_scene \| [\d.]+ / 31.24 \(", comparison.read_text())
    assert go().count("has results already; skipped") == 2


@pytest.mark.slow
def test_a_table_goes_on_when_more_scenes_come_and_with_several_seeds(tmp_path):
    root = write_fake("rhd", tmp_path / "RHD", "cooling_dumbbels")
    base = ("experiment=table_etgs_1", f"data.root={root}", "table.methods=[3dgs,etgs]", *SHORT, "seed=0,1")
    sweep = f"hydra.sweep.dir={tmp_path}/sweep"
    command(*base, sweep)
    write_fake("rhd", root, "cooling_bench")
    output = command(*base, "table.scenes=[cooling_bench,cooling_dumbbells]", sweep)
    assert output.count("has results already; skipped") == 4 and "Missing" not in output
    text = (tmp_path / "sweep" / "comparison.md").read_text()
    for scene in ("cooling_bench", "cooling_dumbbells"):
        for method in ("3dgs", "etgs"):
            assert re.search(rf"\| {scene} \| {method} \| \d+\.\d+ ± \d+\.\d+ / \d+\.\d+ \([-+]\d+\.\d+\) \|", text)
    assert "LPIPS" in text and "mean of the scenes that ran (2 of 10)" in text


@pytest.mark.slow
def test_without_data_nothing_trains_and_dry_runs_tell_only(tmp_path):
    folder = f"hydra.sweep.dir={tmp_path}/sweep"
    output = command("experiment=table_ti3dgs_ii", f"data.root={tmp_path}/none", folder, code=1)
    assert "Missing: 7 scenes of TI-NSD" in output and "Traceback" not in output
    root = put(tmp_path / "TI-NSD", "images", "chair")
    output = command("experiment=table_ti3dgs_ii", f"data.root={root}", "table.dry=true", folder)
    assert "7 runs (7 rows x 1 of 7 scenes)" in output and not (tmp_path / "sweep" / "table.md").exists()
    output = command("experiment=table_ti3dgs_ii", f"data.root={root}", "method=etgs", folder, code=1)
    assert "choose among them with table.methods" in output and "Traceback" not in output


def job(sweep: Path, method: str, scene: str, psnr: float | None) -> Path:
    """A job's folder as a run leaves it; without a PSNR it has no results."""
    folder = sweep / f"{method}_{scene}_"
    (folder / ".hydra").mkdir(parents=True)
    told = [f"method={method}", f"row='{method}'", f"data.scene='{scene}'"]
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(told))
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"data": {"scene": scene}}))
    if psnr is not None:
        RunResults(run={"scene": scene, "method": method}, test={"psnr": psnr}).write(folder / "metrics.json")
    return folder


def test_a_table_that_is_filled_piece_by_piece_keeps_what_it_has(tmp_path):
    """Each command asks for one scene or method; the comparison is of all that is in the folder."""
    root, sweep = put(tmp_path / "RHD", "sparse", "cooling_bench", "my_bike"), tmp_path / "sweep"
    told = {"cooling_ebike": "my_bike"}
    pieces = (("etgs", "cooling_bench", {}), ("energy_balance", "cooling_bench", {}), ("3dgs", "my_bike", told))
    for method, folder, folders in pieces:
        scene = "cooling_ebike" if folders else folder
        reproduction = reproduced("etgs_1", root, methods=[method], scenes=[scene], folders=folders)
        (run,) = reproduction.runs
        job(sweep, run.method, run.folder, 30.0)
        write_comparison(sweep, reproduction)
    text = (sweep / "comparison.md").read_text()
    for line in ("cooling_bench | etgs", "cooling_bench | energy_balance", "cooling_ebike | 3dgs"):
        assert f"| {line} | 30.00 / " in text
    assert "- The paper's figures only: ntr_gaussian (not asked for)" in text
    with open(sweep / "comparison.csv", newline="") as file:
        ours = {(row["scene"], row["method"]) for row in csv.DictReader(file) if row["ours"]}
    assert {("cooling_bench", "etgs"), ("cooling_bench", "energy_balance"), ("cooling_ebike", "3dgs")} <= ours


def test_a_run_that_failed_is_named_in_the_comparison(tmp_path):
    reproduction = reproduced("etgs_1", put(tmp_path / "RHD", "sparse", "cooling_bench"))
    failed = job(tmp_path / "sweep", "etgs", "cooling_bench", None)
    (failed / "FAILED").write_text("Traceback\nSceneError: no points\n")
    write_comparison(tmp_path / "sweep", reproduction)
    text = (tmp_path / "sweep" / "comparison.md").read_text()
    assert "## Jobs without a result\n\n- etgs on cooling_bench: SceneError: no points" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "layout", "scene", "metrics"),
    [
        ("ravigs_1", "thermoscenes", "double_robot", {"psnr", "ssim", "mae_c", "mae_roi_c"}),
        ("ravigs_2", "thermoscenes", "buildingA_spring", {"rgb_psnr", "rgb_ssim"}),
        ("supirgs_2", "thermoscenes", "trees", {"psnr", "ssim", "mae_c", "mae_roi_c"}),
        ("supirgs_3", "ti_nsd", "UAV1", {"train_min", "memory_mb", "fps"}),
        ("ti3dgs_iv", "ti_nsd", "Tall_Building", {"psnr", "ssim"}),
        ("thermogs_2", "thermo", "S1", {"psnr", "ssim", "mae_c"}),
        ("thermogs_9", "thermo", "S2", {"memory_gb", "fps"}),
    ],
)
def test_tables_of_every_data_set_are_filled(name, layout, scene, metrics, tmp_path):
    """One scene on disk: every row that is not the paper's alone has every metric but LPIPS."""
    root = write_fake(layout, tmp_path / "data", scene)
    short = [text for text in SHORT if "downscale" not in text]  # 4 divides the images' sides
    output = command(f"experiment=table_{name}", f"data.root={root}", *short, f"hydra.sweep.dir={tmp_path}/sweep")
    reproduction = reproduced(name, root, have=ALL_METHODS)
    assert len({run.folder for run in reproduction.runs}) == 1 and "Jobs without a result" not in output
    with open(tmp_path / "sweep" / "comparison.csv", newline="") as file:
        ours = {(row["method"], row["setting"], row["metric"]) for row in csv.DictReader(file) if row["ours"]}
    assert {(run.method, run.setting, metric) for run in reproduction.runs for metric in metrics} <= ours
