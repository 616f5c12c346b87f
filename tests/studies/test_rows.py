"""Named rows: what runs, what is refused, and what the paper prints for them."""

from pathlib import Path

import pytest
import yaml
from commands import succeeds
from hydra.core.hydra_config import HydraConfig
from running import compose_run

from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import as_dict
from heatsplat.studies.finished import named_row
from heatsplat.studies.published.figures import figures, quoted
from heatsplat.studies.rows import Rows

ROOT = Path(__file__).resolve().parents[2]
TRAIN = str(ROOT / "src" / "train.py")
ABLATIONS = sorted((ROOT / "conf" / "ablation").glob("*.yaml"))


def nowhere(number, job):
    raise AssertionError("rows come after no other job")


def test_every_row_meets_every_combination_of_the_grid_and_a_grid_needs_no_rows():
    grid = [["seed=0"], ["seed=1"]]
    jobs, first = Rows({"a": {"set": ["max_steps=5"]}, "b": {}}).jobs(grid, nowhere)
    assert jobs == [
        ["seed=0", "max_steps=5", "row='a'"], ["seed=0", "row='b'"], ["seed=1", "max_steps=5", "row='a'"], ["seed=1", "row='b'"]
    ]  # fmt: skip
    assert first == 0 and Rows().jobs(grid, nowhere) == (grid, 0)
    loose = Rows({"a": None, 8: {"set": None}, "c": {"set": "max_steps=5"}})  # as people write them
    assert loose.jobs([[]], nowhere)[0] == [["row='a'"], ["row='8'"], ["max_steps=5", "row='c'"]]
    ((told,),), _ = Rows({"what's new": {}}).jobs([[]], nowhere)
    assert compose_run("method=3dgs", told)["row"] == "what's new" == named_row(as_dict([told]))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            {"full": {}, "short": {"sets": ["max_steps=5"]}},
            "rows: a row has set .* and printed, nothing else; short is {'sets",
        ),
        ({"short": ["max_steps=5"]}, r"short is \['max_steps"),
        (["full", "short"], r"hydra.sweeper.rows=\['full', 'short'\]: give rows by name"),
    ],
)
def test_a_row_that_would_not_be_what_it_is_called_is_refused(rows, message):
    """Misspelled, it would be a second row of the default."""
    with pytest.raises(SceneError, match=message):
        Rows(rows)


@pytest.mark.parametrize("path", ABLATIONS, ids=lambda path: path.stem)
def test_rows_of_an_ablation_are_different_recipes_that_compose(path):
    rows = yaml.safe_load(path.read_text())["hydra"]["sweeper"]["rows"]
    method, recipes = path.stem.partition("_")[0], []
    for name, row in rows.items():
        config = compose_run(f"method={method}", *row.get("set", []), f"row='{name}'")
        recipes.append({key: value for key, value in config.items() if key != "row"})
    texts = [str(recipe) for recipe in recipes]
    assert len(set(texts)) == len(rows) > 1


@pytest.mark.parametrize("path", ABLATIONS, ids=lambda path: path.stem)
def test_rows_stand_beside_what_the_paper_prints_for_them(path):
    """Every setting of the paper's table is printed for one row; of ETGS's terms no figure can be read.

    An ablation of ours stands beside no paper.
    """
    sweeper = yaml.safe_load(path.read_text())["hydra"]["sweeper"]
    printed = [row["printed"] for row in sweeper["rows"].values() if "printed" in row]
    if "paper" not in sweeper:
        assert not printed
        return
    of, table, scenes = (sweeper["paper"][key] for key in ("of", "table", "scenes"))
    assert sorted(printed) == sorted({figure.setting for figure in figures(of, table)})
    texts = [quoted(of, table, setting, scenes) for setting in printed]
    assert [len(text) > 1 for text in texts] == [path.stem != "etgs_terms"] * len(printed)


def test_what_is_quoted_of_several_scenes_stands_side_by_side():
    found = quoted("ti3dgs", "IV", "no_tif", ["ti_nsd_indoor", "ti_nsd_outdoor"])
    assert found == {"psnr": "32.12 / 28.09", "ssim": "0.951 / 0.897"}
    assert quoted("ti3dgs", "IV", "no_tif", ["ti_nsd_indoor", "nowhere"]) == {}


def test_an_ablation_refuses_another_method_before_any_job(tmp_path):
    """Rows such as thermal=static compose with it, and are not what they are called."""
    short = ("data.size=tiny", "debug=fast", "seed=0")
    command = [TRAIN, "ablation=ti3dgs_medium", "method=3dgs", *short, f"hydra.sweep.dir={tmp_path}/sweep"]
    told = succeeds(command, code=1)
    assert "parts of method=ti3dgs, not of method=3dgs: leave method out" in told and "Traceback" not in told
    assert not (tmp_path / "sweep").exists()


@pytest.mark.parametrize("path", ABLATIONS, ids=lambda path: path.stem)
def test_an_ablation_brings_the_method_that_it_is_of(path):
    own = compose_run(f"ablation={path.stem}").name
    of = HydraConfig.get().sweeper.of
    assert own == path.stem.partition("_")[0] == (of if isinstance(of, str) else of[0])
    plan = Rows({"a": {"set": ["max_steps=5"]}}, of=of, method=own)
    assert plan.jobs([["seed=0"]], nowhere) == ([["seed=0", "max_steps=5", "row='a'"]], 0)
    assert plan.jobs([[f"method={own}"]], nowhere)
    for others in ([["method=3dgs"]], [[f"method={own}"], ["method=3dgs"]]):
        with pytest.raises(SceneError, match=rf"parts of method={own}.*, not of method=3dgs"):
            plan.jobs(others, nowhere)


def test_an_ablation_may_be_of_several_methods():
    """The authors' code of ETGS has numbers of frequencies too."""
    compose_run("ablation=etgs_frequencies", "method=etgs_released")
    sweeper = HydraConfig.get().sweeper
    assert "etgs_released" in sweeper.of
    for row in sweeper.rows.values():
        assert compose_run("method=etgs_released", *row.set).name == "etgs_released"
