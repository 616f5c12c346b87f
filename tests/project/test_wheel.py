"""What a wheel holds. ``make wheel-test`` installs one and trains from it."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {"src/heatsplat": "heatsplat", "src/hydra_plugins": "hydra_plugins"} | {
    name: f"heatsplat/{name}" for name in ("conf", "datamodules", "preparation")
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder into which the wheel of a copy of the sources is unpacked."""
    copy, site = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("site")
    for name in ("src", "conf", "datamodules", "preparation", "tests"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    build = "from setuptools import build_meta; print(build_meta.build_wheel('.'))"
    done = subprocess.run([sys.executable, "-c", build], cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    zipfile.ZipFile(copy / done.stdout.splitlines()[-1]).extractall(site)
    return site


def files(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_it_holds_every_file_of_the_packages_and_nothing_else(site):
    expected = {f"{inside}/{path}" for folder, inside in FOLDERS.items() for path in files(ROOT / folder)}
    assert {path for path in files(site) if ".dist-info/" not in path} == expected


def test_it_has_the_licence_and_the_commands(site):
    (info,) = site.glob("heatsplat-*.dist-info")
    assert (info / "licenses" / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    commands = dict(line.split(" = ") for line in (info / "entry_points.txt").read_text().splitlines() if "=" in line)
    assert commands == PROJECT["scripts"]


def targets(node: object) -> set[str]:
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    own = {node["_target_"]} if isinstance(node, dict) and "_target_" in node else set()
    return own.union(*map(targets, inner))


def test_every_target_of_its_configurations_is_in_it(site):
    found = set().union(*(targets(yaml.safe_load(path.read_text())) for path in site.glob("heatsplat/conf/**/*.yaml")))
    ours = {target for target in found if isinstance(target, str) and re.match(r"heatsplat\.", target)}
    assert any(target.startswith("heatsplat.datamodules.") for target in ours)
    for target in ours:
        parts = target.split(".")
        places = [site.joinpath(*parts[:end]) for end in range(2, len(parts))]
        assert any(place.with_suffix(".py").exists() or (place / "__init__.py").exists() for place in places), target


def test_its_commands_have_their_configurations_and_write_where_they_are_called(site, tmp_path):
    command = "from heatsplat.cli import study; study()"
    done = subprocess.run(
        [sys.executable, "-c", command, "study=frontier", "--cfg", "job", "--resolve"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(site)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    settings = yaml.safe_load(done.stdout)["study"]
    assert settings["outputs"] == str(tmp_path / "outputs")
    assert settings["train"] is None
