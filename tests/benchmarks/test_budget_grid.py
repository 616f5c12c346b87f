"""The grid behind budget=SECONDS: its curves, its planned runs and what the study asks for."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import running

from benchmarks import budget_grid
from benchmarks.budget_grid import Trained, costs, mean_gaussians, means, picture, tables
from heatsplat.composition import CONF
from heatsplat.contracts import SceneError
from heatsplat.io.results import RunResults
from heatsplat.runs.curves import CURVES_FILE, Point, curves_of, read_points, write_points

FREE = math.inf
POINTS = [
    Point("etgs", "heated", steps, growth, mean_growth, psnr)
    for growth, mean_growth, scores in ((1.0, 1.0, (20, 24, 26)), (FREE, 4.0, (18, 26, 32)))
    for steps, psnr in zip((250, 1000, 4000), scores, strict=True)
]


@pytest.fixture(autouse=True)
def grey_for_pictures(monkeypatch):
    """Drawing the curves takes a second of each study; the tables' test makes the figure itself."""
    monkeypatch.setattr(budget_grid, "figure_picture", lambda figure: np.zeros((1, 1, 3), np.uint8))


def a_run(steps: int, cap: int | None, seed: int, psnr: float, seconds: float) -> Trained:
    results = RunResults(data={"points": 4000})
    results.put("test", "psnr", psnr)
    results.put("cost", "train_seconds", seconds)
    results.put("cost", "gaussians", 5000)
    return Trained("etgs", "heated", steps, cap, 1.0, seed, results, 6000.0)


def test_the_grid_becomes_curves_and_rivals_of_planned_runs(tmp_path):
    grid = [
        a_run(250, None, 0, 20, 5),
        a_run(250, None, 1, 22, 5),
        a_run(1000, 8000, 0, 25, 32),
        a_run(1000, None, 0, 29, 60),
    ]
    points = means(grid)
    assert [(p.steps, p.growth, p.psnr, p.mean_growth, p.seeds) for p in points] == [
        (250, FREE, 21, 1.5, 2), (1000, 2.0, 25, 1.5, 1), (1000, FREE, 29, 1.5, 1),
    ]  # fmt: skip
    planned = RunResults(run={"budget": {"train_s": 29.0, "calibration_s": 0.7, "off_percent": -1.0, "steps": 900}})
    planned.put("test", "psnr", 26.0)
    text = tables(grid, [("etgs", "heated", 30.0, planned)], "All rows: `data.size=demo`.")
    assert "All rows: `data.size=demo`." in text
    assert "| etgs | heated | 30 | 29.7 | -1.0 % | 900 | 26.00 | 1,000 steps, 8,000, decay 1 | 25.00 | 32.0 |" in text
    assert len(picture(points).axes) == 2


def paced(step_s: float, mean: float, *settings: str) -> Trained:
    """A run whose steps took so many processor seconds with so many Gaussians in the mean."""
    one = a_run(1000, None, 0, 30.0, 50.0)
    one.results.put("cost", "steps_per_second", 10.0)
    one.results.put("cost", "cpu_seconds", step_s * 500)
    return replace(one, mean_gaussians=mean, settings=settings)


def test_what_settings_cost_is_told_at_equal_gaussians():
    """A step takes 2 ms and 1 ms per 1000 Gaussians; settings that halve all of it do so with few and with many."""
    few, many = paced(0.006, 4000.0), paced(0.014, 12000.0)
    half, same = paced(0.005, 8000.0, "schedule=coarse_to_fine"), paced(0.022, 20000.0, "thermal.frequencies=8")
    assert costs([few, half, many, same]) == pytest.approx([1.0, 0.5, 1.0, 1.0])
    assert costs([few, half]) == pytest.approx([1.0, 5 / 6])  # one number of Gaussians says nothing of others
    found = {point.settings: point.cost for point in means([few, many, half])}
    assert found[half.settings] == pytest.approx(0.5) and found[()] == 1.0
    assert "| etgs | heated | 1,000 | free | 1 | schedule=coarse_to_fine | 0 | 0.50 |" in tables(
        [few, many, half], [], ""
    )


def test_further_settings_are_measured_beside_the_same_without(tmp_path, monkeypatch):
    asked = []

    def trained(place, train, overrides, study):
        asked.append((place.parent.name, overrides))
        place.mkdir(parents=True)
        (place / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,5000\n")
        return paced(0.01, 5000.0).results

    monkeypatch.setattr(budget_grid, "train_or_read", trained)
    grid = {
        "scenes": ["etgs/heated"],
        "steps": [250, 500],
        "caps": [8000],
        "decays": [1.0],
        "seeds": [0],
        "budgets": [],
    }
    common = {"train": None, "overrides": [], "curves": str(tmp_path / "curves.csv")}
    further = [
        {"set": ["schedule=coarse_to_fine", "density=budget"], "caps": [4000]},
        {"set": ["dtype=float64"], "steps": [250]},
    ]
    budget_grid.run(tmp_path / "study", **grid, **common, further=further)
    names = [name for name, _ in asked]
    both = "density=budget_schedule=coarse_to_fine"
    assert set(names) == {
        "etgs_heated_250_8000_1", "etgs_heated_500_8000_1", "etgs_heated_250_4000_1", "etgs_heated_500_4000_1",
        f"etgs_heated_250_4000_1_{both}", f"etgs_heated_500_4000_1_{both}", "etgs_heated_250_8000_1_dtype=float64",
    }  # fmt: skip
    assert len(names) == len(set(names))
    for name, overrides in asked:
        assert "density.reset_every=null" not in overrides  # none has any
        assert "density.multiple=null" in overrides, name  # the cap counts
    points = read_points(tmp_path / "curves.csv")
    assert {point.settings for point in points} == {
        (), ("density=budget", "schedule=coarse_to_fine"), ("dtype=float64",),
    }  # fmt: skip


def test_the_grid_trains_every_combination_and_leaves_the_curves_of_other_scenes(tmp_path, monkeypatch):
    asked = []

    def trained(place, train, overrides, study):
        asked.append(overrides)
        place.mkdir(parents=True)
        (place / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,5000\n")
        return a_run(0, None, 0, 20.0 + len(asked), 5.0).results

    monkeypatch.setattr(budget_grid, "train_or_read", trained)
    longer = replace(POINTS[4], steps=9000)
    write_points([replace(POINTS[0], scene="cooling"), POINTS[3], longer], tmp_path / "curves.csv")
    settings = {"train": "train.py", "steps": [250, 500], "caps": [8000, None], "decays": [1.0, 0.25], "seeds": [0]}
    settings |= {"budgets": [], "overrides": ["data.size=demo"], "curves": str(tmp_path / "curves.csv")}
    budget_grid.run(tmp_path / "study", scenes=["etgs/heated"], **settings)
    assert len(asked) == 8 and len({tuple(overrides) for overrides in asked}) == 8
    assert sum("optim.decay=0.25" in one and "density.cap_max=8000" in one for one in asked) == 2
    assert all(("density.multiple=null" in one) == ("density.cap_max=8000" in one) for one in asked)
    assert not any("threads" in override for one in asked for override in one)
    points = read_points(tmp_path / "curves.csv")
    assert [point.scene for point in points] == ["cooling"] + 9 * ["heated"]
    assert longer in points and POINTS[3] not in points  # measured anew: 250 steps, free, decay 1
    assert len(curves_of(points)["etgs", "heated"]) == 4
    with pytest.raises(SceneError, match="of the form method/scene, such as etgs/heated, got .*'etgs'"):
        budget_grid.run(tmp_path / "study", scenes=["etgs"], **settings)


@pytest.mark.parametrize("named", [True, False], ids=["curves file", "study's folder"])
def test_planned_runs_read_the_curves_just_written_on_the_threads_asked_for(tmp_path, monkeypatch, named):
    asked = {}

    def trained(place, train, overrides, study):
        source = next((text.partition("=")[2] for text in overrides if text.startswith("budget_curves=")), None)
        asked[place] = overrides, [] if source is None else read_points(Path(source))
        place.mkdir(parents=True)
        (place / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,5000\n")
        results = a_run(0, None, 0, 20.0, 5.0).results
        results.run["budget"] = {"train_s": 5.0, "calibration_s": 0.1, "off_percent": 0.0, "steps": 250}
        return results

    monkeypatch.setattr(budget_grid, "train_or_read", trained)
    monkeypatch.chdir(tmp_path)
    write_points([POINTS[5]], tmp_path / "curves.csv")
    settings = {
        "train": "train.py",
        "steps": [250],
        "caps": [None],
        "decays": [1.0],
        "seeds": [0],
        "budgets": [30.0],
    }
    curves = "curves.csv" if named else None
    budget_grid.run("study", scenes=["etgs/heated"], overrides=["data.size=demo"], curves=curves, threads=1, **settings)
    (grid, none), (planned, points) = asked.values()
    assert none == [] and "budget=30s" in planned and "threads=1" in planned and "threads=1" in grid
    assert all(place.is_absolute() for place in asked)  # whatever the run's working directory
    assert "All rows: `threads=1 data.size=demo`." in (tmp_path / "study" / "budget.md").read_text()
    assert [point.steps for point in points] == ([250, 4000] if named else [250])


def noted(monkeypatch) -> list[list[str]]:
    """The overrides of all runs that are asked for from here on, of which none is trained."""
    asked = []

    def trained(place, train, overrides, study):
        asked.append(overrides)
        place.mkdir(parents=True)
        (place / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,5000\n")
        return a_run(0, None, 0, 20.0, 5.0).results

    monkeypatch.setattr(budget_grid, "train_or_read", trained)
    return asked


def test_other_curves_plan_other_runs(tmp_path, monkeypatch):
    asked = []

    def trained(place, train, overrides, study):
        asked.append(place)
        place.mkdir(parents=True, exist_ok=True)
        (place / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,5000\n")
        results = a_run(0, None, 0, 20.0, 5.0).results
        results.run["budget"] = {"train_s": 5.0, "calibration_s": 0.1, "off_percent": 0.0, "steps": 250}
        return results

    monkeypatch.setattr(budget_grid, "train_or_read", trained)
    settings = {"train": None, "caps": [None], "decays": [1.0], "seeds": [0], "overrides": [], "curves": None}
    for steps in ([250], [250], [250, 500]):
        budget_grid.run(tmp_path, scenes=["etgs/heated"], steps=steps, budgets=[30.0], **settings)
    planned = [place for place in asked if "planned" in place.parts]
    assert planned[0] == planned[1] != planned[2]


def test_settings_of_all_runs_choose_what_a_cap_turns_off(tmp_path, monkeypatch):
    asked = noted(monkeypatch)
    settings = {"train": None, "steps": 250, "caps": 8000, "decays": 1.0, "seeds": 0, "budgets": [], "curves": None}
    budget_grid.run(tmp_path, scenes="etgs/heated", overrides="density=mcmc", **settings)
    (overrides,) = asked
    density = running.compose_run(*overrides).density  # refused where a key is none of this density control's
    assert "MCMC" in density._target_ and density.cap_max == 8000
    assert not [text for text in overrides if text.startswith(("density.multiple", "density.reset_every"))]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scenes": []}, r"study.scenes=\[\] has nothing in it"),
        ({"steps": ["long"]}, "study.steps must be a whole number, 1 or more, got long"),
        ({"caps": [0]}, "study.caps must be a whole number, 1 or more, got 0"),
        ({"decays": ["a"]}, "study.decays must be a number, got a"),
        ({"seeds": []}, r"study.seeds=\[\] has nothing in it"),
        ({"budgets": ["1min"]}, "study.budgets must be a number, got 1min"),
        ({"further": [{"set": ["dtype=float64"], "steps": []}]}, r"study.steps=\[\] has nothing in it"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_trained(wrong, message, tmp_path, monkeypatch):
    monkeypatch.setattr(budget_grid, "train_or_read", lambda *_: pytest.fail("trained"))
    options = {"scenes": ["etgs/heated"], "steps": [250], "caps": [None], "decays": [1.0], "seeds": [0], "budgets": []}
    with pytest.raises(SceneError, match=message):
        budget_grid.run(tmp_path, None, **options | {"overrides": [], "curves": None} | wrong)


def test_threads_of_the_study_are_those_of_its_runs():
    for given, expected in (((), None), (("threads=1",), 1), (("threads=1", "study.threads=3"), 3)):
        config = running.compose_run("study=budget", *given, config_name="study")
        assert config.study.threads == expected


def test_the_study_as_it_stands_measures_what_the_repository_holds():
    study = running.compose_run("study=budget", config_name="study").study
    points = read_points(CURVES_FILE)
    assert {f"{point.method}/{point.scene}" for point in points} <= set(study.scenes)
    assert {point.steps for point in points} <= set(study.steps)
    starts = {"haze": 500}  # points of a demo scene, 4000 of the others
    for point in points:
        start = starts.get(point.scene, 4000)
        assert point.growth in {FREE if cap is None else cap / start for cap in study.caps}
    assert {point.decay for point in points} <= set(study.decays)


def test_the_study_sets_options_that_every_growing_method_has():
    for method in sorted(path.stem for path in (Path(CONF) / "method").glob("*.yaml")):
        density = running.compose_run(f"method={method}").density
        if method in ("scaffold_gs", "instant_ngp", "thermonerf"):  # anchors, and fields that do not grow
            continue
        assert {"cap_max", "multiple"} <= set(density) or {"cap_max", "reset_every"} <= set(density), method


def test_caps_go_to_density_control(tmp_path, monkeypatch):
    asked = noted(monkeypatch)
    settings = {"train": "train.py", "steps": [250], "caps": [8000], "decays": [1.0], "seeds": [0], "budgets": []}
    settings |= {"overrides": [], "curves": None}
    budget_grid.run(tmp_path / "study", scenes=["ti3dgs/haze"], **settings)
    assert asked[0][-3:] == ["density.reset_every=null", "density.multiple=null", "density.cap_max=8000"]


def test_curves_that_are_none_are_told_before_anything_is_trained(tmp_path, monkeypatch):
    monkeypatch.setattr(budget_grid, "train_or_read", lambda *_: pytest.fail("trained"))
    (tmp_path / "notes.txt").write_text("not curves")
    settings = {
        "steps": [250],
        "caps": [None],
        "decays": [1.0],
        "seeds": [0],
        "budgets": [],
        "overrides": [],
    }
    with pytest.raises(SceneError, match="notes.txt holds no curves"):
        budget_grid.run(tmp_path, "train.py", ["etgs/heated"], curves=str(tmp_path / "notes.txt"), **settings)


def test_mean_gaussians_weigh_the_steps(tmp_path):
    (tmp_path / "curve.csv").write_text("step,train_seconds,gaussians\n50,1,200\n100,2,200\n")
    assert mean_gaussians(tmp_path / "curve.csv", 100) == pytest.approx(0.5 * 150 + 0.5 * 200)
