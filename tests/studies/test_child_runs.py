"""Runs of a study: found again where they are the same, refused where they are not, and told where they fail."""

import json
import sys
from pathlib import Path

import hydra
import pytest
from hydra.core.hydra_config import HydraConfig

from heatsplat.composition import CONF
from heatsplat.contracts import SceneError
from heatsplat.studies.child_runs import OtherSettingsError, all_rows, train_or_read

SCRIPT = """import json, sys
from pathlib import Path
from hydra.core.override_parser.overrides_parser import OverridesParser
settings = dict(text.partition("=")[::2] for text in sys.argv[1:])
place = Path(OverridesParser.create().parse_override("hydra.run.dir=" + settings.pop("hydra.run.dir")).value())
(place / ".hydra").mkdir(parents=True, exist_ok=True)
(place / ".hydra" / "overrides.yaml").write_text(json.dumps([f"{k}={v}" for k, v in settings.items()]))
if settings.get("seed") == "13":
    (place / "FAILED").write_text("bad luck")
    sys.exit("unlucky")
sys.path[:0] = SOURCES
from heatsplat.io.results import RunResults
with (place / "times").open("a") as file:
    file.write("once\\n")
RunResults(run={"seed": settings.get("seed")}).write(place / "metrics.json")
"""


@pytest.fixture
def script(tmp_path) -> str:
    import heatsplat

    path = tmp_path / "train.py"
    path.write_text(SCRIPT.replace("SOURCES", repr([str(Path(heatsplat.__path__[0]).parent)])))
    return str(path)


@pytest.mark.parametrize("name", ["one", "thermal.frequencies=8, it's"])
def test_a_run_is_trained_once(script, tmp_path, name):
    place = tmp_path / "study" / name
    for curves in ("here", "there"):  # where a file lies says nothing of what it holds
        assert (
            train_or_read(place, script, ["seed=3", f"budget_curves={curves}"], tmp_path / "study").run["seed"] == "3"
        )
    assert (place / "times").read_text() == "once\n"


def test_a_folder_with_a_run_of_other_settings_is_refused(script, tmp_path):
    place = tmp_path / "study" / "one"
    train_or_read(place, script, ["seed=3", "max_steps=5"], tmp_path / "study")
    message = r"one was made with other settings \(max_steps=5, max_steps=9\): give the former ones, delete it"
    with pytest.raises(OtherSettingsError, match=message):
        train_or_read(place, script, ["seed=3", "max_steps=9"], tmp_path / "study")
    with pytest.raises(OtherSettingsError, match=r"\(threads=2\)"):  # whose seconds stand in no table beside others
        train_or_read(place, script, ["seed=3", "max_steps=5", "threads=2"], tmp_path / "study")


def test_a_setting_that_is_given_twice_is_the_last_of_them(script, tmp_path):
    """As a recipe's own interval of validations after that of all runs; what is taken away has no value."""
    place, wanted = tmp_path / "one", ["max_steps=5", "~logger", "max_steps=9"]
    for _ in range(2):
        train_or_read(place, script, wanted, tmp_path)
    assert (place / "times").read_text() == "once\n"
    with pytest.raises(OtherSettingsError, match=r"\(max_steps=5, max_steps=9\)"):
        train_or_read(place, script, wanted[:2], tmp_path)


def test_a_report_says_what_all_of_its_runs_have():
    line = all_rows(["data.size=tiny", "threads=null"], seed=[1, 0, 1], threads=[2, 2], max_steps=[None])
    assert line == "All rows: `data.size=tiny seed=0,1 threads=2`."
    assert all_rows(["threads=1"], threads=[None]) == "All rows: `threads=1`."


@pytest.mark.parametrize(("name", "typed"), [("study", "hydra.run.dir={}"), ("my study", "\"hydra.run.dir='{}'\"")])
def test_a_run_that_failed_says_where_and_how_to_go_on(script, tmp_path, name, typed):
    place = tmp_path / name / "one"
    with pytest.raises(SceneError, match="unlucky") as failure:
        train_or_read(place, script, ["seed=13"], tmp_path / name)
    assert f"{place / 'FAILED'} says why" in str(failure.value) and sys.executable in str(failure.value)
    assert f"{typed.format(tmp_path / name)} goes on" in str(failure.value)


def test_a_run_is_told_of_configurations_beside_ours(script, tmp_path, monkeypatch):
    """Of a plugin's folder, which the study was given by --config-dir."""
    (tmp_path / "plugin, mine").mkdir()
    name = f"hydra.searchpath=['file://{tmp_path}/plugin, mine']"
    before = HydraConfig.instance().cfg
    try:
        with hydra.initialize_config_dir(CONF, version_base="1.3"):
            HydraConfig.instance().set_config(hydra.compose("study", [name], return_hydra_config=True))
        train_or_read(tmp_path / "one", script, ["seed=1"], tmp_path)
    finally:
        HydraConfig.instance().cfg = before
    assert name in json.loads((tmp_path / "one" / ".hydra" / "overrides.yaml").read_text())
