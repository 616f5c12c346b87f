"""Every command of the README runs: on the tiny scene, a few steps, with the paths of a reader's machine replaced.

`make test` runs one command of each kind and composes the configuration of all of them; `make test-slow` runs the rest.
"""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from camera_files import temperatures
from commands import Done, in_turn, python
from running import NO_PICTURES, compose_run

from heatsplat import cli

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "README.md").read_text()
COMMANDS = [
    line.split("#")[0].strip()
    for block in re.findall(r"^```sh\n(.*?)^```", TEXT, re.M | re.S)
    for line in block.splitlines()
]
PYTHON = [command for command in COMMANDS if command.startswith("python")]
# What other fast tests run too: sweeps, ablations and tables (tests/studies), budgets, presets and method=auto (tests/training).
LONG = (
    " -m ",
    "preset=",
    "ablation=",
    "experiment=",
    "budget=",
    "method=auto",
    "data=colmap",
    "data.scene=heated",
    "trajectory=view",
)
LASTING = [command for command in PYTHON if any(word in command for word in LONG)]
SHORT = ["data.size=tiny", "max_steps=6", "trainer.val_check_interval=3", "callbacks.probes=null"]
SHORT += ["callbacks.costs.fps_repeats=1"]
UNSEEN = ["callbacks.images=null", "callbacks.viewer=null", *NO_PICTURES]  # files that no test here looks at
FIRST = "python src/train.py method=etgs"


def shell(arguments: list[str], cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        arguments, cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """The /data of the README: the synthetic scene written in the layouts that it names."""
    from scene_files import LAYOUTS

    from heatsplat.datamodules.synthetic_scene.film import SIZES, film
    from heatsplat.datamodules.synthetic_scene.presets import PRESETS
    from heatsplat.datamodules.synthetic_scene.scene import Scene
    from heatsplat.io.tiff import write_temperature

    folder = tmp_path_factory.mktemp("data")
    recording = film(Scene(PRESETS["cooling"]), SIZES["tiny"], seed=0, noise_k=0.05)
    LAYOUTS["rhd"](recording, folder / "RHD" / "cooling_bench")
    LAYOUTS["colmap"](recording, folder / "my_scene")
    for index in range(2):
        write_temperature(folder / "flight" / f"frame_{index}.tiff", temperatures(index))
    return folder


def test_the_readme_names_its_main_commands():
    assert COMMANDS[:2] == ["make demo", "make test"]
    assert any(command.startswith("python src/train.py method=etgs data=rhd") for command in COMMANDS)


@pytest.mark.parametrize("command", [command for command in PYTHON if "train.py" in command])
def test_training_commands_compose(command):
    """Names and values of the command line are those of conf/; of a sweep, the first job."""
    words = [re.sub(r",.*", "", word) for word in command.split()[2:] if word != "-m"]
    config = compose_run(*words)
    method = re.search(r"method=(\w+)", command)
    assert method is None or config.name == method[1]


def words_of(command: str, trained: Path, data: Path, folder: Path) -> list[str]:
    """A command of the README as it is run here: short, and into a folder."""
    words = command.replace("RUN", f"{trained}").replace("/data/", f"{data}/").split()
    words = [str(ROOT / words[1]), *words[2:]]
    if "train.py" in command:
        words += SHORT if "data=" not in command and "experiment=" not in command else SHORT[1:]
        words += [*UNSEEN, "doctor=false", f"hydra.run.dir={folder}/run", f"hydra.sweep.dir={folder}/sweep"]
        if "callbacks=live" in command:  # another program of the machine may listen there
            words += ["callbacks.live.port=0"]
        if "budget=" in command:  # which counts the steps itself
            words = [word for word in words if not word.startswith(("max_steps=", "budget="))] + ["budget=20s"]
        if "experiment=" in command:  # some of its methods
            words += ["table.methods=[3dgs,etgs]"]
        if "ablation=" in command:  # one seed
            words += ["hydra.sweeper.params={seed:'0'}"]
    elif "evaluate.py" in command:
        words += [*UNSEEN, f"hydra.run.dir={folder}/done"]
    elif "prepare.py" in command:
        words = [*words[:1], f"source={data}/flight", f"target={folder}/prepared", "poses=none"]  # of two frames
    elif "render.py" in command:
        words += ["frames=2", f"hydra.run.dir={folder}/views"]
    else:
        words += [f"hydra.run.dir={folder}/done"]
    return words


@pytest.fixture(scope="module")
def ended(data, tmp_path_factory) -> dict[str, tuple[Done, Path]]:
    """What became of the commands that take seconds, and the folder of each. The first one's run is RUN of those that follow."""
    folders = {command: tmp_path_factory.mktemp("command") for command in PYTHON if command not in LASTING}
    trained = folders[FIRST] / "run"
    done = in_turn([words_of(command, trained, data, folder) for command, folder in folders.items()], trained.parent)
    return dict(zip(folders, zip(done, folders.values(), strict=True), strict=True))


def check_done(command: str, done: Done, folder: Path) -> None:
    assert done.returncode == 0, done.output
    if "train.py" in command or "evaluate.py" in command:
        assert "PSNR" in done.output
        jobs = {" -m ": 3, "ablation=": 5, "experiment=": 2}
        expected = next((count for word, count in jobs.items() if word in command), 1)
        assert len(list(folder.rglob("metrics.json"))) == expected
    elif "study.py" in command:
        assert (folder / "done" / "frontier.html").exists()
    elif "prepare.py" in command:
        assert (folder / "prepared" / "report.md").exists()
    elif "simplify.py" in command:
        assert (folder / "done" / "lod_1.ckpt").exists() and (folder / "done" / "lod_1.ply").exists()
    elif "export.py" in command:
        assert len(list((folder / "done").glob("*.ply"))) == 1
    elif "view.py" in command:
        assert (folder / "done" / "viewer.html").exists()
    else:
        assert (folder / "views" / "video.mp4").exists()


@pytest.mark.parametrize("command", [command for command in PYTHON if command not in LASTING])
def test_python_commands_run(command, ended):
    check_done(command, *ended[command])


@pytest.mark.slow
@pytest.mark.parametrize("command", LASTING)
def test_python_commands_that_take_longer_run(command, ended, data, tmp_path):
    words = words_of(command, ended[FIRST][1] / "run", data, tmp_path)
    check_done(command, python(words, tmp_path), tmp_path)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_demo_trains_etgs():
    shown = shell(["make", "-n", "demo", "ARGS=seed=7"], ROOT)
    words = re.search(r"src/train\.py (.*)", shown)[1].split()
    config = compose_run(*words)
    assert (config.name, config.max_steps, config.seed) == ("etgs", 5000, 7)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_demo_runs():
    ready = ROOT / ".venv" / ".ready"
    if not ready.exists():
        pytest.skip("the environment was not set up by make install")
    output = shell(["make", "demo", f"ARGS={' '.join(SHORT)}"], ROOT)
    assert "PSNR" in output and "picture" in output


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_targets_exist():
    known = shell(["make", "help"], ROOT)
    assert [target for target in re.findall(r"`?make (\w+)`?", TEXT) if f"make {target} " not in known] == []


@pytest.mark.parametrize("name", ["train", "evaluate", "render", "simplify", "view", "export", "study"])
def test_console_commands_are_installed(name):
    programs = [one for one in entry_points(group="console_scripts") if one.name == f"heatsplat-{name}"]
    if not programs:
        pytest.skip("heatsplat is not installed (pip install -e .)")
    assert programs[0].load() is getattr(cli, name)
    assert (Path(sys.executable).parent / f"heatsplat-{name}").exists()


def test_a_console_command_answers():
    program = Path(sys.executable).parent / "heatsplat-train"
    if not program.exists():
        pytest.skip("heatsplat is not installed (pip install -e .)")
    assert "threads" in shell([str(program), "method=etgs", "--cfg", "job"], ROOT)


def test_its_pictures_exist():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert pictures and all((ROOT / picture).exists() for picture in pictures)
