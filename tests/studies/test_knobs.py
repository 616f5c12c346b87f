"""The sweep over every number of a recipe: which there are, how they are changed, and what the table and picture say of them."""

import math
from pathlib import Path

import pytest
import yaml
from commands import succeeds
from finished_runs import job
from omegaconf import OmegaConf
from running import compose_run

from heatsplat.contracts import SceneError
from heatsplat.studies.knobs import DEFAULT, Knobs, beside_default, factor_of, knob, numbers_of, picture, scaled
from heatsplat.studies.sweeps import collect

ROOT = Path(__file__).resolve().parents[2]
SWEEPER = yaml.safe_load((ROOT / "conf/experiment/knobs.yaml").read_text())["hydra"]["sweeper"]["knobs"]


def nowhere(number, job):
    raise AssertionError("knobs come after no other job")


def test_numbers_are_those_that_can_be_changed_and_follow_no_other():
    written = {
        "steps": 2000,
        "text": "a",
        "optim": {"rate": 0.1, "steps": "${steps}", "doubled": "${double:${steps}}", "off": 0, "far": math.inf},
        "parts": {"on": True, "none": None, "betas": [0.9, 0.999], "names": ["a"], "inner": {"count": 3, "empty": []}},
    }
    settings = written | {"optim": written["optim"] | {"steps": 2000, "doubled": 4000}}
    assert numbers_of(written, settings, ["steps", "text", "nowhere", "optim", "parts"]) == {
        "steps": 2000, "optim.rate": 0.1, "optim.doubled": 4000, "parts.betas": [0.9, 0.999], "parts.inner.count": 3
    }  # fmt: skip
    assert numbers_of(written, settings, "parts.inner") == {"parts.inner.count": 3}
    with pytest.raises(SceneError, match=r"knobs.of=\[text,nowhere\]: the recipe has no numbers there"):
        numbers_of(written, settings, ["text", "nowhere"])


def numbers_told(*overrides):
    config = compose_run(*overrides)
    written, settings = (OmegaConf.to_container(config, resolve=resolve) for resolve in (False, True))
    return numbers_of(written, settings, SWEEPER["of"])


@pytest.mark.parametrize(("method", "numbers"), [("etgs", (0.6, 0.1)), ("energy_balance", (0.1, 0.5))])
def test_numbers_that_the_thermal_model_has_are_among_them(method, numbers):
    told = numbers_told(f"method={method}")
    assert (told["init.opacity"], told["optim.averaged"]) == numbers
    assert numbers_told(f"method={method}", "init.opacity=0.3")["init.opacity"] == 0.3


@pytest.mark.parametrize(
    ("value", "half", "twice"),
    [
        (0.2, 0.1, 0.4), (-3.0, -1.5, -6.0), (0.999, 0.999 / 1.001, 1.998 / 1.999), (0.5, 1 / 3, 2 / 3), (1.0, 0.5, 2.0),
        (1, 1, 2), (-1, -1, -2), (24, 12, 48), ([0.25, 4], [0.125, 2], [0.5, 8]),
    ],
)  # fmt: skip
def test_half_and_twice_of_a_number(value, half, twice):
    assert scaled(value, 0.5) == pytest.approx(half) and scaled(value, 2) == pytest.approx(twice)
    assert type(scaled(value, 0.5)) is type(value)


def test_numbers_near_one_are_told_apart():
    """Of four digits 0.9999 has none other next to it but 1, which many settings refuse."""
    jobs, _ = Knobs(lambda job: {"keep": 0.9999, "odd": 1 - 1e-9}, [0.5, 2]).jobs([[]], nowhere)
    assert [job[0] for job in jobs[1:]] == ["keep=0.9998", "keep=0.99995", "odd=0.999999998", "odd=0.9999999995"]


def test_each_job_of_the_grid_has_its_default_and_its_own_numbers_changed_one_at_a_time():
    plan = Knobs(lambda job: {"a.b": 0.1} if job == ["seed=0"] else {"n": 1, "betas": [0.9, 2.0]}, [0.5, 2])
    jobs, first = plan.jobs([["seed=0"], ["seed=1"]], nowhere)
    assert first == 0 and jobs == [
        ["seed=0", "row=default"],
        ["seed=0", "a.b=0.05", "row='a.b 0.05 (x0.5)'"],
        ["seed=0", "a.b=0.2", "row='a.b 0.2 (x2)'"],
        ["seed=1", "row=default"],
        ["seed=1", "n=2", "row='n 2 (x2)'"],
        ["seed=1", "betas=[0.8182,1]", "row='betas [0.8182,1] (x0.5)'"],
        ["seed=1", "betas=[0.9474,4]", "row='betas [0.9474,4] (x2)'"],
    ]
    assert [(knob(name), factor_of(name)) for name in ("a.b 0.05 (x0.5)", "betas [0.9474,4] (x2)")] == [
        ("a.b", 0.5),
        ("betas", 2),
    ]


@pytest.mark.parametrize("factors", [[], [1], [0.5, -2], ["x"]])
def test_factors_that_change_nothing_are_refused(factors):
    with pytest.raises(SceneError, match=r"knobs.factors=.*give numbers above 0 other than 1"):
        Knobs(dict, factors)


@pytest.mark.parametrize("method", ["etgs", "ravigs", "supirgs", "thermogs", "ti3dgs"])
def test_every_number_of_a_method_can_be_set_to_twice_its_value(method):
    told = ("experiment=knobs", f"method={method}", "preset=fast")
    numbers = numbers_told(*told)
    jobs, _ = Knobs(lambda job: numbers, [2]).jobs([[]], nowhere)
    overrides = [row[0] for row in jobs[1:]]
    assert len(overrides) > 30
    changed = numbers_told(*told, *overrides)
    assert changed.keys() == numbers.keys()
    assert [key for key in numbers if changed[key] == numbers[key]] == []


@pytest.fixture
def sweep(tmp_path):
    for seed in (0, 1):
        job(tmp_path, 10 * seed, [f"seed={seed}", f"row={DEFAULT}"], 30.0 + seed, seconds=10.0)
        job(tmp_path, 10 * seed + 1, [f"seed={seed}", "a.b=0.05", "row='a.b 0.05 (x0.5)'"], 30.1 + seed, seconds=9.0)
        job(tmp_path, 10 * seed + 2, [f"seed={seed}", "n=2", "row='n 2 (x2)'"], 28.0 + seed, seconds=20.0)
    job(tmp_path, 3, ["seed=1", "n=4", "row='n 4 (x4)'"], 31.5, seconds=30.0)
    job(tmp_path, 4, ["seed=0", "a.b=0.2", "row='a.b 0.2 (x2)'"], None)
    return tmp_path


def test_a_row_is_compared_with_the_default_of_its_own_seeds(sweep):
    rows = collect(sweep)
    own = {row.name: row for row in rows}
    assert beside_default(own["a.b 0.05 (x0.5)"], rows, "psnr") == pytest.approx(0.1)
    assert beside_default(own["n 4 (x4)"], rows, "psnr") == pytest.approx(0.5)  # of seed 1 alone
    assert beside_default(own["n 2 (x2)"], rows, "train_seconds") == pytest.approx(10.0)
    assert beside_default(own["a.b 0.2 (x2)"], rows, "psnr") is None
    assert beside_default(own[DEFAULT], rows, "nothing") is None


def test_recordings_of_a_scene_are_compared_each_with_its_own_default(tmp_path):
    for seed, gain in ((0, 2.0), (1, 4.0)):
        told = ["seed=0", f"data.scene_seed={seed}"]
        job(tmp_path, 2 * seed, [*told, f"row={DEFAULT}"], 30.0 + seed)
        job(tmp_path, 2 * seed + 1, [*told, "n=2", "row='n 2 (x2)'"], 30.0 + seed + gain)
    rows = collect(tmp_path)
    assert beside_default(rows[1], rows, "psnr") == 3.0


def test_the_table_has_the_number_that_matters_most_on_top(sweep):
    assert [path.name for path in Knobs(dict, [2]).write(sweep)] == ["table.md", "table.csv", "table.png"]
    text = (sweep / "table.md").read_text()
    places = [text.index(f"| {name}") for name in ("default", "n 2", "n 4", "a.b 0.05", "a.b 0.2")]
    assert places == sorted(places) and "| n 2 (x2) | 2 | 28.50" in text


def test_the_picture_has_gain_and_cost_of_every_knob(sweep):
    gains, costs = picture(collect(sweep)).axes
    assert [label.get_text() for label in gains.get_yticklabels()] == ["a.b", "n"]
    drawn = {(float(line.get_xdata()[0]), float(line.get_ydata()[0])) for line in costs.lines}
    assert drawn >= {(-10.0, 0.0), (100.0, 1.0), (200.0, 1.0)}
    assert picture([row for row in collect(sweep) if row.name != DEFAULT]) is None


def test_knobs_of_the_command_line(tmp_path):
    """The numbers of a job as it is composed, with what the command sets."""
    recipe = ("method=3dgs", "init.scale=4", "data.size=tiny", "debug=fast", "max_steps=6", "doctor=false", "seed=0")
    spared = ("trainer.val_check_interval=6", "callbacks.dashboard=null", "callbacks.statistics=null")
    asked = ("hydra.sweeper.knobs.of=[init.scale]", f"hydra.sweep.dir={tmp_path}")
    assert "table.png" in succeeds([str(ROOT / "src/train.py"), "experiment=knobs", *recipe, *spared, *asked])
    text = (tmp_path / "table.md").read_text()
    assert all(f"| {name} | 1 |" in text for name in ("default", "init.scale 2 (x0.5)", "init.scale 8 (x2)"))


def test_rows_that_change_no_number_are_in_the_table_and_not_in_the_picture(sweep):
    job(sweep, 5, ["seed=0", "loss=other", "row='another loss'"], 29.0, seconds=10.0)
    rows = collect(sweep)
    assert "another loss" in {row.name for row in rows} and factor_of("another loss") is None
    assert [label.get_text() for label in picture(rows).axes[0].get_yticklabels()] == ["a.b", "n"]
    Knobs(dict, [2]).write(sweep)
    assert "| another loss |" in (sweep / "table.md").read_text()
