"""The commands as a user types them, from another working directory.

A process of its own has what is about processes: exit codes, streams, and a run from its beginning. What a command refuses, and
what it makes of a finished run, is asked of its function in this process, which has the libraries.
"""

import inspect
import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import hydra
import numpy as np
import pytest
import torch
from commands import succeeds
from hydra._internal.utils import get_args_parser
from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from running import LOOKS, NO_PICTURES

import heatsplat
from heatsplat import cli, composition
from heatsplat.contracts import SceneError
from heatsplat.geometry.transforms import OPENGL_AXES
from heatsplat.io.tiff import read_temperature
from heatsplat.runs.lock import OccupiedError

ROOT = Path(__file__).resolve().parents[2]
TINY = (
    "data.size=tiny", "max_steps=20", LOOKS, "callbacks.probes.times=4", "callbacks.costs.fps_repeats=1",
    "callbacks.turntable.frames=4", "callbacks.surfaces.views=4", "callbacks.viewer.cameras=4",
)  # fmt: skip


def command(script: str, *overrides: str, cwd: Path, code: int = 0) -> str:
    """What ``python src/<script>.py`` prints; checks its exit code."""
    return succeeds([str(ROOT / "src" / f"{script}.py"), *overrides], cwd, code, COLUMNS="200")


@pytest.fixture
def told(monkeypatch, capsys):
    """What a command prints that runs in this process, with what it ends: of a sentence, the exit code is 1."""
    root = logging.getLogger()
    handlers = root.handlers[:]

    def of(script: str, *overrides: str, cwd: Path, code: int = 0) -> str:
        monkeypatch.chdir(cwd)
        monkeypatch.setenv("COLUMNS", "200")
        monkeypatch.setattr(cli.sys, "argv", [str(ROOT / "src" / f"{script}.py"), *overrides])
        capsys.readouterr()
        said, ended = "", 0
        try:
            getattr(cli, script)()
        except SystemExit as end:
            said, ended = (end.code, 1) if isinstance(end.code, str) else ("", end.code or 0)
        shown = capsys.readouterr()
        output = shown.out + shown.err + said
        assert ended == code, output
        return output

    yield of
    for handler in root.handlers[:]:
        if handler not in handlers:
            root.removeHandler(handler)
            handler.close()
    for handler in handlers:
        root.addHandler(handler)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Folder of a finished tiny run, trained from another working directory."""
    folder = tmp_path_factory.mktemp("cli")
    output = command("train", "method=etgs", *TINY, f"hydra.run.dir={folder}/run", cwd=folder)
    assert "PSNR" in output and "training" in output and ".png" in output
    return folder / "run"


def test_a_run_leaves_what_it_promises(finished):
    for name in (
        ".hydra/config.yaml",
        "tb",
        "checkpoints/last.ckpt",
        "renders",
        "metrics.json",
        "report.md",
        "run.log",
    ):
        assert (finished / name).exists(), name
    assert sorted(path.name for path in (finished / "checkpoints").glob("step_*.ckpt"))
    assert not (finished / "FAILED").exists()
    found = json.loads((finished / "metrics.json").read_text())
    assert set(found) >= {"test", "cost", "effects", "data", "versions"}
    assert set(found["cost"]) >= {"train_seconds", "steps_per_second", "render_fps", "peak_memory_mb", "gaussians"}
    report = (finished / "report.md").read_text()
    for link in (part.split(")")[0] for part in report.split("](")[1:]):
        assert (finished / link).exists(), f"report.md points to {link}"


def test_a_finished_run_is_skipped(finished, told):
    before = (finished / "metrics.json").read_text()
    assert "has results already" in told("train", "method=etgs", *TINY, f"hydra.run.dir={finished}", cwd=finished)
    assert (finished / "metrics.json").read_text() == before


def test_evaluate_needs_the_checkpoint_only_and_agrees_with_training(finished, told):
    seen = ("callbacks.images=null", "callbacks.viewer=null", "callbacks.probes=null", *NO_PICTURES)
    told("evaluate", f"ckpt={finished}/checkpoints/last.ckpt", *seen, cwd=finished.parent)
    (again,) = finished.glob("evaluations/*/metrics.json")
    first, second = (json.loads(path.read_text())["test"] for path in (finished / "metrics.json", again))
    assert first["psnr"] == second["psnr"] and first["mae_c"] == second["mae_c"]


def test_a_stopped_run_stays_as_it_is_where_other_settings_are_given(finished, told, tmp_path):
    for name in ("checkpoints", ".hydra"):
        shutil.copytree(finished / name, tmp_path / name)
    before = {path: path.read_bytes() for path in tmp_path.glob("*/*")}
    others = ("optim.means=1e-3", f"hydra.run.dir={tmp_path}")
    output = told("train", "method=etgs", *TINY, *others, cwd=tmp_path, code=1)
    assert f"{tmp_path} holds an unfinished run with other settings (optim.means)" in " ".join(output.split())
    assert len(before) > 4 and before == {path: path.read_bytes() for path in tmp_path.glob("*/*")}
    assert not (tmp_path / "FAILED").exists()


def test_evaluate_keeps_what_a_run_has_measured(finished):
    kept = {path: path.read_bytes() for path in (*finished.glob("[a-z]*.[jmhc]*"), *finished.glob(".hydra/*"))}
    assert {"metrics.json", "report.md", "test_per_image.csv", "config.yaml"} <= {path.name for path in kept}
    ckpt = f"ckpt={finished}/checkpoints/last.ckpt"
    told = command("evaluate", ckpt, f"hydra.run.dir={finished}", cwd=finished, code=1)
    assert f"\n{finished} holds a run or results" in f"\n{told}" and "OccupiedError" not in told
    assert all(path.read_bytes() == content for path, content in kept.items()) and not (finished / "FAILED").exists()


def test_results_and_runs_without_them_are_no_place_to_evaluate_in(tmp_path):
    config = OmegaConf.create({"ckpt": f"{tmp_path}/run/checkpoints/last.ckpt"})
    (tmp_path / "other").mkdir()
    cli.check_vacant(config, tmp_path / "other")
    (tmp_path / "other" / "metrics.json").touch()
    for folder in ("other", "run"):
        with pytest.raises(OccupiedError, match="give another folder with hydra.run.dir"):
            cli.check_vacant(config, tmp_path / folder)


@pytest.mark.parametrize(
    ("script", "folder"),
    [
        ("evaluate", "evaluations"),
        ("render", "views"),
        ("simplify", "levels"),
        ("view", "viewers"),
        ("export", "exports"),
    ],
)
def test_a_sweep_over_a_checkpoint_stays_with_its_run(script, folder, tmp_path):
    with hydra.initialize_config_dir(composition.CONF, version_base="1.3"):
        config = hydra.compose(script, [f"ckpt={tmp_path}/checkpoints/last.ckpt"], return_hydra_config=True)
    assert Path(config.hydra.sweep.dir).parent == tmp_path / folder
    assert "job.num" in OmegaConf.to_container(config.hydra.sweep, resolve=False)["subdir"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("range_c=30", "range_c must be a list of 2 numbers, got 30"),
        ("range_c=[30,10]", "range_c must be two increasing numbers"),
        ("colormap=virids", "colormap=virids is no map of matplotlib, as inferno, viridis.* are"),
        ("fps=0", "fps must be above 0, got 0"),
        ("fps=abc", "fps must be a number, got abc"),
        ("frames=1.5", "frames must be a whole number"),
        ("time=abc", "time must be a number of seconds or a date-time such as .*, got abc"),
        ("images=[]", "images must be all, or one or a list of recorded, clean and rgb"),
        ("images=3", "images must be all, or one or a list of recorded, clean and rgb, got 3"),
        ("unseen=show", "unseen must be one of nan, keep"),
        (
            "camera_file=a.json",
            "trajectory=orbit with camera_file=a.json: cameras of a file are rendered by trajectory=cameras",
        ),
        (
            "trajectory=cameras",
            "trajectory=cameras with camera_file=null: cameras of a file are rendered by trajectory=cameras",
        ),
        ("threads=0", "threads must be 1 to .* on this machine, or null for all cores, got 0"),
        ("threads=abc", "threads must be 1 to .* got abc"),
    ],
)
def test_what_render_cannot_take_is_named_before_anything_is_loaded(wrong, told, tmp_path):
    config = composition.compose(["ckpt=nowhere.ckpt", "video=false", wrong], "render")
    with pytest.raises(SceneError, match=told):
        inspect.unwrap(cli.render)(config, tmp_path)


@pytest.mark.parametrize("wrong", ["time=abc", "time=[]", "layer=air", "threads=0"])
def test_what_export_cannot_take_is_named_before_anything_is_loaded(wrong, tmp_path):
    config = composition.compose(["ckpt=nowhere.ckpt", "what=ply", wrong], "export")
    with pytest.raises(SceneError, match=f"^{wrong.partition('=')[0]} must be"):
        inspect.unwrap(cli.export)(config, tmp_path)


def test_render_writes_temperatures_pictures_and_a_video(finished, told):
    output = told(
        "render", f"ckpt={finished}/checkpoints/last.ckpt", "trajectory=orbit", "time=600", "frames=3",
        cwd=finished.parent,
    )  # fmt: skip
    assert "3 frames" in output
    (folder,) = finished.glob("views/orbit_*")
    tiffs, pngs = sorted(folder.glob("tiff/*.tiff")), sorted(folder.glob("png/*.png"))
    assert len(tiffs) == len(pngs) == 3
    celsius = cv2.imread(str(tiffs[0]), cv2.IMREAD_UNCHANGED)
    assert celsius.dtype == "float32" and 10 < np.nanmean(celsius) < 80
    assert (folder / "video.mp4").stat().st_size > 1000


def test_render_shows_what_the_cameras_of_a_file_see(finished, told, tmp_path):
    trained = heatsplat.load(finished / "checkpoints" / "last.ckpt")
    scene, frame = trained.scene, trained.scene.train.frames[0]
    pose = torch.linalg.inv(frame.camera.viewmat) @ torch.from_numpy(OPENGL_AXES)
    lens = {"w": frame.camera.width, "h": frame.camera.height, "fl_x": frame.camera.K[0, 0].item()}
    listed = [{"transform_matrix": pose.tolist(), "time_s": 0.0}, {"transform_matrix": pose.tolist()}]
    (tmp_path / "mine.json").write_text(json.dumps({**lens, "frames": listed}))
    told(
        "render", f"ckpt={finished}", "trajectory=cameras", "camera_file=mine.json", "video=false", "png=false", "depth=true",
        cwd=tmp_path,
    )  # fmt: skip
    (folder,) = finished.glob("views/cameras_*")
    rows = [row.split(",") for row in (folder / "frames.csv").read_text().splitlines()[1:]]
    assert [(row[0], float(row[1])) for row in rows] == [("camera_0000", 0.0), ("camera_0001", scene.middle_s)]
    celsius = read_temperature(folder / "tiff" / "camera_0000.tiff")
    np.testing.assert_allclose(celsius, trained.render(frame.camera, 0.0), atol=1e-3)
    depth = read_temperature(folder / "tiff_depth" / "camera_0000.tiff")
    np.testing.assert_allclose(
        depth, scene.metres_per_unit * trained.depth(frame).nan_to_num(np.nan, np.nan), rtol=1e-5
    )


def test_a_sweep_runs_every_job_and_a_failing_one_takes_no_other_down(tmp_path, told, monkeypatch):
    cleared = []
    monkeypatch.setattr(cli, "clear_away", lambda: cleared.append(True))  # before each job, whose memory is measured
    output = told(
        "train", "-m", "method=3dgs", "init.opacity=2.0,0.1", *TINY, "max_steps=4", "doctor=false", "test=false",
        f"hydra.sweep.dir={tmp_path}/sweep", cwd=tmp_path, code=1,
    )  # fmt: skip
    assert "init.opacity must lie in (0, 1)" in output and len(cleared) == 2
    jobs = [path for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    failed = [path for path in jobs if (path / "FAILED").exists()]
    assert len(jobs) == 2 and len(failed) == 1  # the first
    assert all("opacity" in (path / "FAILED").read_text() for path in failed)
    assert all((path / "checkpoints" / "last.ckpt").exists() for path in jobs if path not in failed)


def test_a_folder_that_is_not_used_is_told(tmp_path, told):
    nowhere = ("method=etgs", "data=rhd", "data.root=/nowhere/at/all")
    single = told("train", *nowhere, f"hydra.sweep.dir={tmp_path}/sweep", cwd=tmp_path, code=1)
    assert "hydra.sweep.dir is not used: a single run (without -m) writes to hydra.run.dir=" in single
    swept = told("train", "-m", *nowhere, "seed=0", f"hydra.run.dir={tmp_path}/run", cwd=tmp_path, code=1)
    assert "hydra.run.dir is not used: the jobs of a sweep write to hydra.sweep.dir=" in swept
    both = (f"hydra.run.dir={tmp_path}/run", f"hydra.sweep.dir={tmp_path}/sweep")
    assert "is not used" not in told("train", *nowhere, *both, cwd=tmp_path, code=1)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("study=work_precision",), "python src/study.py study=work_precision"),
        (("method=etgs", "data=rhd"), "data.root"),
        (("method=etgs", "data=rhd", "data.root=/nowhere/at/all"), "/nowhere/at/all"),
        (("method=3dgs", "ckpt=/nowhere/last.ckpt"), "no checkpoint at /nowhere/last.ckpt"),
        (("method=3dgs", "data.split=every_9th"), "every_9th"),
        (("method=etgs", "hydra.sweeper.rows={eight:{set:['thermal.frequencies=8']}}"), "a single run: add -m"),
        (("method=etgs", "ckpt=[a,b]"), "ckpt must be"),
    ],
)
def test_bad_input_is_named_with_exit_code_one(overrides, message, tmp_path, told):
    assert message in told("train", *overrides, f"hydra.run.dir={tmp_path}/run", cwd=tmp_path, code=1)


def test_what_is_refused_leaves_no_folder_unless_it_was_given_a_name(tmp_path, told, monkeypatch):
    monkeypatch.setattr(composition, "ROOT", tmp_path)
    refused = ("train", "method=etgs", "data=rhd", "data.root=/nowhere/at/all")
    assert "/nowhere/at/all" in told(*refused, cwd=tmp_path, code=1)
    assert [*tmp_path.rglob("*")] == [tmp_path / "outputs"]
    beside = tmp_path / "outputs" / "etgs_all" / "before"
    beside.mkdir(parents=True)
    told(*refused, cwd=tmp_path, code=1)
    assert [*(tmp_path / "outputs").rglob("*")] == [beside.parent, beside]
    told(*refused, f"hydra.run.dir={tmp_path}/run", cwd=tmp_path, code=1)
    assert (tmp_path / "run" / "FAILED").exists() and (tmp_path / "run" / "run.log").exists()


def test_names_of_folders_may_look_like_numbers(tmp_path, told):
    for name in ("2024_08_07", "17"):
        (tmp_path / name).mkdir()
    refused = ("train", "method=etgs", "data=colmap", "hydra.run.dir=1e3")
    assert "data.root=/" in told(*refused, "data.root=2024_08_07", cwd=tmp_path, code=1)
    assert "there is no such scene" in told(*refused, "data.root=.", "data.scene=1_8", cwd=tmp_path, code=1)
    assert "data.scene=17: a sparse model" in told(*refused, "data.root=.", "data.scene=17", cwd=tmp_path, code=1)
    assert (tmp_path / "1e3" / "FAILED").exists()
    assert composition.compose(["data=colmap", "data.root=17", "data.scene=1_8"])["data"]["scene"] == "1_8"


def test_what_wrote_something_before_it_failed_stays(tmp_path, told, monkeypatch):
    def fails(config, output_dir):
        (output_dir / "verdicts.md").touch()
        raise SceneError("too late")

    monkeypatch.setattr(composition, "ROOT", tmp_path)
    monkeypatch.setattr("heatsplat.runs.run.train_in", fails)
    assert "too late" in told("train", "method=etgs", *TINY, cwd=tmp_path, code=1)
    (kept,) = tmp_path.rglob("verdicts.md")
    assert (kept.parent / "FAILED").exists()


def test_help_lists_the_choices(tmp_path, told):
    output = told("train", "method=etgs", "--help", cwd=tmp_path)
    assert "etgs" in output and "colmap" in output


def test_help_says_what_methods_and_studies_are_and_leaves_out_what_is_internal(tmp_path, told):
    train = told("train", "--help", cwd=tmp_path)
    assert re.search(r"^  3dgs +3D Gaussian Splatting", train, re.MULTILINE)
    assert "max_steps: 30000" in train and "# training steps" in train and "  renderer: auto, cpu, gsplat" in train
    assert "_target_" not in train and "override" not in train and "optional" not in train and "hydra.run" not in train
    assert not re.search(r"@package|^module:|^hydra:|python src/\S+ study=", train, re.MULTILINE)
    study = told("study", "-h", cwd=tmp_path)
    assert re.search(r"^  steps +Times whole training steps part by part", study, re.MULTILINE)
    for options in re.findall(r"^(?:method|data|preset):\n((?:  .+\n)+)", train, re.MULTILINE):
        assert all(len(line.split()) > 3 for line in options.splitlines())


def test_help_of_other_commands_explains_each_of_their_settings(tmp_path, told):
    for command, says in {
        "render": "frames: 60         # number of images (orbit, path, view)",
        "export": "  above: null      # [x, y, z] direction in the world from which the map is seen",
        "simplify": "  share: 0.2                 # of the Gaussians merged",
        "evaluate": "  only: null     # a surface of a synthetic scene",
        "view": "training_cameras: 36 # those in the page",
    }.items():
        shown = told(command, "--help", cwd=tmp_path)
        assert says in shown and "hydra" not in shown and "\n\n\n" not in shown, command


def test_help_of_preparation_lists_its_own_settings_with_their_units(tmp_path, told):
    output = told("prepare", "--help", cwd=tmp_path)
    assert "reflected_c: null          # apparent reflected temperature, °C" in output
    assert (
        "poses: thermal  # thermal | rgb | given | none" in output
        and "camera_model: SIMPLE_RADIAL  # of COLMAP" in output
    )
    assert "refractive_index: null" in output and "internal" not in output and "etgs" not in output
    shell = f"{sys.executable} {ROOT / 'src' / 'train.py'} --help | head -1"
    ended = subprocess.run(shell, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "Traceback" not in ended.stderr and "BrokenPipe" not in ended.stderr


def test_help_whose_reader_has_gone_is_no_error_where_there_is_no_sigpipe_as_on_windows(tmp_path, monkeypatch):
    class Gone(io.StringIO):
        def flush(self):
            raise BrokenPipeError

        def fileno(self):
            return spare

    with open(tmp_path / "spare", "w") as file:
        spare = file.fileno()
        monkeypatch.delattr(cli.signal, "SIGPIPE", raising=False)
        monkeypatch.setattr(cli.sys, "argv", ["src/train.py", "--help"])
        monkeypatch.setattr(cli.sys, "stdout", Gone())
        with pytest.raises(SystemExit, match="141"):
            cli.train()


@pytest.mark.parametrize("encoding", ["cp1252", "cp932", "ascii"])
def test_letters_that_a_console_does_not_have_are_spelled_out(encoding, tmp_path, monkeypatch):
    shown = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(cli.sys, "argv", ["src/train.py", "--help"])
    monkeypatch.setattr(cli.sys, "stdout", shown)
    cli.train()
    text = shown.buffer.getvalue().decode(encoding)
    assert "max_steps: 30000" in text and ("\\u03c4" in text) == (encoding != "cp932")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["/data/flight", "/data/scene"], "Every argument names what it sets: source=FOLDER target=FOLDER"),
        (
            ["poses=none", "poses.camera_model=RADIAL"],
            "poses has nothing to set with poses=none: leave poses.camera_model out",
        ),
    ],
)
def test_what_preparation_cannot_take_is_told_with_the_remedy(arguments, meant, tmp_path, told):
    output = told("prepare", *arguments, cwd=tmp_path, code=1)
    assert meant in output and "Traceback" not in output and "To append" not in output


def test_a_command_without_arguments_shows_how_it_is_used_and_trains_nothing(tmp_path, told):
    for script in ("train", "study"):
        assert f"src/{script}.py {'method' if script == 'train' else 'study'}=" in told(script, cwd=tmp_path, code=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("method=etsg", "Did you mean method=etgs"),
        ("max_stepz=10", "Did you mean max_steps"),
        ("metod=etgs", "Did you mean method"),
        ("optim.meens=1", "Did you mean optim.means"),
        ("schedule.factor=2", "schedule has nothing to set"),
        ("logger.colour=red", "logger has "),
        ("data.root=/data/Flug über Köln, 2. Tag", "\"data.root='/data/Flug über Köln, 2. Tag'\""),
        ("data.root=/data/flight,2", "\"data.root='/data/flight,2'\""),
        ("data.ambient_c=20,5", "data.ambient_c=20.5"),
        ("data.bounds_c=20,30", "two numbers have brackets: data.bounds_c=[20,30]"),
    ],
)
def test_typing_errors_get_a_suggestion(wrong, meant, tmp_path, told):
    output = told("train", "seed=1", wrong, cwd=tmp_path, code=1)
    assert meant in output and "Traceback" not in output


def test_typing_errors_in_settings_of_a_further_folder_get_a_suggestion(tmp_path, told):
    (tmp_path / "it's a conf" / "thermal").mkdir(parents=True)
    (tmp_path / "it's a conf" / "thermal" / "mine.yaml").write_text("_target_: mine.Heat\ngain: 1.0\n")
    folder = f"--config-dir={tmp_path}/it's a conf"
    output = told("train", folder, "method=3dgs", "thermal=mine", "thermal.gian=2", cwd=tmp_path, code=1)
    assert "Did you mean thermal.gain?" in output and "To append" not in output


def test_a_view_of_several_checkpoints_is_refused_with_a_sentence(tmp_path, told):
    output = told("view", "ckpt=[a,b]", cwd=tmp_path, code=1)
    assert output.strip() == "ckpt must be one checkpoint or the folder of one run, got ['a', 'b']"


def test_a_setting_of_another_command_is_not_offered_to_be_added(tmp_path, told):
    said = told("view", f"ckpt={tmp_path}/none.ckpt", "trajectory=orbit", cwd=tmp_path, code=1)
    assert "view has no such setting; --help lists those that it has" in said and "+trajectory" not in said


def test_a_typing_error_ends_a_process_with_its_sentence_and_exit_code_one(tmp_path):
    output = command("train", "seed=1", "method=etsg", cwd=tmp_path, code=1)
    assert "Did you mean method=etgs" in output and "Traceback" not in output


def test_ctrl_c_before_training_ends_with_a_sentence(monkeypatch, tmp_path, told):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("heatsplat.runs.run.train_in", interrupted)
    said = told("train", *TINY, f"hydra.run.dir={tmp_path}/run", cwd=tmp_path, code=130)
    assert "Interrupted." in said


def test_a_group_set_to_null_is_told_its_options(tmp_path, told):
    output = told("train", "method=etgs", "logger=null", cwd=tmp_path, code=1)
    assert "logger=null" in output and "none, tensorboard" in output and "Traceback" not in output


def test_a_value_that_only_a_scene_shows_to_be_wrong_is_told_in_a_sentence(tmp_path, told):
    output = told("train", "method=etgs", *TINY, "thermal.frequencies=-1", "hydra.run.dir=run", cwd=tmp_path, code=1)
    assert "frequencies must be a whole number of at least 0, got -1" in output and "Traceback" not in output
    assert "Traceback" in (tmp_path / "run" / "FAILED").read_text()


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            "method=etgs stages=frozen_geometry",
            "stages=frozen_geometry needs first_steps, which method=etgs does not have: choose method=ntr_gaussian or thermalgs "
            r"or thermogs, or add \+first_steps=\.\.\.",
        ),
        ("method=etgs stages=fine_tuning", "stages=fine_tuning needs first_steps, .*: choose method=mftg, or"),
        ("method=3dgs loss=mftg", "loss=mftg needs first_steps, .*: choose method=mftg, or"),
        ("method=3dgs loss=supirgs", "loss=supirgs needs super_resolution, .*: choose method=supirgs, or"),
        ("method=3dgs loss=srgs", "loss=srgs needs super_resolution, .*: choose method=srgs, or"),
        ("method=etgs density=first_stage", "density=first_stage needs grown.sfm, .*: choose method=ntr_gaussian or"),
        ("method=msmg density=first_stage", "density=first_stage needs grown.separate, .*: choose method=ntr_gaussian or"),
        ("method=thermogs init=voxels", "init=voxels needs first_stage.voxels, and first_stage has sfm, .*: leave init=voxels"),
        ("method=etgs name='${nowhere}'", r"name needs nowhere, which method=etgs does not have: add \+nowhere="),
    ],
)  # fmt: skip
def test_an_option_of_other_methods_is_told_what_it_needs_and_which_have_it(overrides, told):
    with pytest.raises(ValueError, match=f"^{told}"):
        composition.compose(overrides.split())


def test_an_option_of_other_methods_is_told_in_a_sentence(tmp_path, told):
    output = told("train", "method=etgs", "stages=fine_tuning", *TINY, "hydra.run.dir=run", cwd=tmp_path, code=1)
    assert (
        "stages=fine_tuning needs first_steps" in output and "Traceback" not in output and "object_type" not in output
    )


def test_flags_may_stand_among_settings():
    given = ["method=etgs", "-m", "seed=0,1", "--config-dir", "/mine=2", "--info", "thermal=my_drift", "--cfg=job"]
    flags = ["-m", "--config-dir", "/mine=2", "--info", "--cfg=job"]
    assert cli._settings_first(given) == ["method=etgs", "seed=0,1", "thermal=my_drift", *flags]
    parsed = get_args_parser().parse_args(cli._settings_first(given))
    assert parsed.multirun and parsed.config_dir == "/mine=2" and parsed.info == "all" and parsed.cfg == "job"
    assert cli._settings_first(["--multi", "~x", "a=-1"]) == ["~x", "a=-1", "--multi"]
    known = {flag for action in get_args_parser()._actions for flag in action.option_strings}
    assert known == {*cli.ALONE, *cli.WITH_VALUE}


def test_a_sweep_whose_configuration_is_asked_for_is_told_to_ask_for_one_job(tmp_path, told):
    output = told("train", "-m", "method=etgs,3dgs", "--cfg", "job", cwd=tmp_path, code=1)
    assert (
        output == "--cfg and --info show one job: leave out -m, and give each setting one value (seed=0, not seed=0,1)"
    )


@pytest.mark.parametrize(
    ("typed", "meant"), [(["--max_steps=7000"], "max_steps=7000 "), (["--seed", "1"], "seed=... "), (["-s"], "s=... ")]
)
def test_a_setting_with_dashes_is_told_how_it_is_written(typed, meant, tmp_path, told):
    output = told("train", "method=etgs", *typed, cwd=tmp_path, code=1)
    name = typed[0].partition("=")[0]
    assert (
        output.strip()
        == f"{name} is no flag of this command: settings have no dashes, as in {meant}(--help lists them)"
    )


def command_that_raises(error, monkeypatch):
    """A command whose job fails with an error of Hydra's."""
    monkeypatch.setattr(cli.hydra, "main", lambda **_: lambda job: lambda: job(None))
    monkeypatch.setattr(cli.sys, "argv", ["train", "method=etgs"])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def train(config):
        raise error

    return cli._command(train)


def test_what_a_job_starts_has_the_environment_that_the_user_gave_it(monkeypatch):
    monkeypatch.setattr(cli.hydra, "main", lambda **_: lambda job: lambda: job(None))
    monkeypatch.setattr(cli.sys, "argv", ["study", "study=tune"])
    seen = []
    command = cli._command(lambda config: seen.append(os.environ.get("HYDRA_FULL_ERROR")))
    for given in (None, "1"):
        if given is None:
            monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
        else:
            monkeypatch.setenv("HYDRA_FULL_ERROR", given)
        command()
        assert os.environ.get("HYDRA_FULL_ERROR") == given
    assert seen == [None, "1"]


def failed(**settings):
    with pytest.raises(InstantiationException) as failure:
        composition.build({"thermal": settings})
    return failure.value


def test_settings_that_a_class_does_not_take_are_told_in_a_sentence(monkeypatch):
    for settings, told in (
        (
            {"_target_": "heatsplat.losses.compose.Weighted", "term": None, "wait": 1},
            "unexpected keyword argument 'wait'",
        ),
        ({"_target_": "heatsplat.losses.compose.Weighted"}, "missing 1 required positional argument: 'term'"),
        ({"_target_": "heatsplat.density.anchors.Anchors", "every": "abc"}, "'<' not supported between"),
    ):
        with pytest.raises(SystemExit, match=rf"^thermal: .*{told}.* \(HYDRA_FULL_ERROR=1 shows where\)$"):
            command_that_raises(failed(**settings), monkeypatch)()


def test_a_mistake_of_ours_keeps_its_traceback(monkeypatch):
    for target, settings in (
        ("losses.schedules.linear", {"progress": "abc", "start": 0.0, "end": 1.0}),  # not in a constructor
        ("losses.compose.Loss", {"terms": 5}),  # 'int' object has no attribute 'items'
    ):
        error = failed(_target_=f"heatsplat.{target}", **settings)
        with pytest.raises(InstantiationException):
            command_that_raises(error, monkeypatch)()


def test_results_stay_those_of_their_settings(finished, told):
    before = {path: path.read_bytes() for path in (finished / ".hydra").iterdir()}
    others = ("optim.means=1e-3", f"hydra.run.dir={finished}")
    assert "other settings (optim.means)" in told("train", "method=etgs", *TINY, *others, cwd=finished, code=1)
    longer = ("max_steps=21", f"hydra.run.dir={finished}")  # whose density control and schedules differ as well
    assert "other settings (max_steps, " in told("train", "method=etgs", *TINY, *longer, cwd=finished, code=1)
    assert len(before) == 3 and before == {path: path.read_bytes() for path in (finished / ".hydra").iterdir()}
    assert not (finished / "FAILED").exists()
