"""Time to a reference's accuracy: what is compared with what, the standard schedule in the same time, and what is trained."""

import csv
from pathlib import Path

import pytest
import yaml
from matplotlib.figure import Figure

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.studies.time_to_accuracy import study as time_to_accuracy
from heatsplat.studies.time_to_accuracy.runs import Outcome
from heatsplat.studies.time_to_accuracy.study import run

REFERENCE, RECIPES = ["max_steps=800"], {"quick": ["preset=fast"]}


def made(
    folder: Path,
    overrides: list[str],
    steps: int,
    seconds: float,
    psnr: float,
    course: list[tuple[float, float]] = (),
    cpu: float = 0.5,
    method: str = "etgs",
    gaussians: float = 1000.0,
) -> None:
    """A finished run's folder; its MAE is (50 - PSNR) / 10, and its processor takes ``cpu`` times the seconds."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(
        yaml.safe_dump([f"method={method}", "data.scene=heated", *overrides])
    )
    rows = [f"1,{s},{s * cpu},10,{v},{(50 - v) / 10}" for s, v in course]
    (folder / "curve.csv").write_text("\n".join(["step,train_seconds,cpu_seconds,gaussians,psnr,mae_c", *rows]) + "\n")
    seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
    results = RunResults(run={"scene": "heated", "method": method, "seed": seed, "steps": steps})
    for name, value in (("psnr", psnr), ("mae_c", (50 - psnr) / 10)):
        results.put("test", name, value)
    for name, value in (("train_seconds", seconds), ("cpu_seconds", seconds * cpu), ("gaussians", gaussians)):
        results.put("cost", name, value)
    results.write(folder / METRICS_FILE)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes half a second; the tests of the standard schedule and of several panels draw."""
    monkeypatch.setattr(time_to_accuracy, "picture", lambda panels, clock: Figure(figsize=(1, 1)))


@pytest.fixture
def runs(tmp_path) -> Path:
    """Two seeds: a reference of 80 s, standard runs of 10 and 40 s, and a recipe of 20 s."""
    for seed, gain in ((0, 0.0), (1, 1.0)):
        common = [f"seed={seed}", "threads=1"]
        course = [(20, 30 + gain), (40, 38 + gain), (60, 39.9 + gain), (80, 40 + gain)]
        made(tmp_path / f"full{seed}", [*common, "max_steps=800"], 800, 80.0, 41 + gain, course)
        made(tmp_path / f"mid{seed}", [*common, "max_steps=400"], 400, 40.0, 39 + gain, [(40, 38 + gain)])
        made(tmp_path / f"short{seed}", [*common, "max_steps=100"], 100, 10.0, 35 + gain)
        quick = [(10, 30 + gain), (20, 41 + gain)]
        made(tmp_path / f"q{seed}", [*common, "preset=fast"], 200, 20.0 + 4 * seed, 40.9 + gain, quick, gaussians=400.0)
    return tmp_path


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def by_recipe(folder: Path, seed: str = "0") -> dict[str, dict[str, str]]:
    return {row["recipe"]: row for row in read(folder / "time_to_accuracy.csv") if row["seed"] == seed}


def test_recipes_are_measured_by_the_reference_of_their_seed(runs, tmp_path, no_pictures):
    run(tmp_path / "out", str(runs), REFERENCE, RECIPES)
    for seed, seconds in (("0", 20.0), ("1", 24.0)):
        row = by_recipe(tmp_path / "out", seed)["quick"]
        assert float(row["time_ratio"]) == pytest.approx(seconds / 80) and float(row["gaussians_ratio"]) == 0.4
        assert float(row["psnr_off"]) == pytest.approx(-0.1) and float(row["mae_c_off"]) == pytest.approx(0.01)
        assert float(row["end_psnr"]) == float(row["end_mae_c"]) == seconds
        assert float(row["end_psnr_of_all"]) == pytest.approx(seconds / 80)
        # 39.8 dB lie between 30 dB after 10 s and 41 after 20; the reference is there shortly before its 60 s
        assert float(row["way_psnr"]) == pytest.approx(10 + 10 * 9.8 / 11)
        own = 40 + 20 * 1.8 / 1.9
        assert float(row["way_psnr_of_own"]) == pytest.approx((10 + 10 * 9.8 / 11) / own)
        # by ends the standard schedule is within 0.2 dB of 41 on 1.8 / 2 of the way from 40 to 80 s, over log seconds
        assert float(row["end_psnr_of_own"]) == pytest.approx(seconds / (40 * 2 ** (1.8 / 2)))
    short = by_recipe(tmp_path / "out")["standard, 100 steps"]
    assert short["end_psnr"] == short["way_psnr"] == ""  # never as good


def test_a_recipe_that_is_nothing_is_left_out(runs, tmp_path, no_pictures):
    run(tmp_path / "out", str(runs), REFERENCE, RECIPES | {"draft": None})
    assert "quick" in by_recipe(tmp_path / "out") and "draft" not in by_recipe(tmp_path / "out")


def test_the_standard_schedule_in_the_same_time_lies_between_its_runs(runs, tmp_path):
    """20 s are half way between 10 and 40 over log seconds."""
    (panel,) = run(tmp_path / "out", str(runs), *REFERENCE, {"quick": "preset=fast"})  # words are lists of one
    row = by_recipe(tmp_path / "out")["standard in the time of quick"]
    assert float(row["psnr"]) == pytest.approx(37.0) and float(row["mae_c"]) == pytest.approx(1.3)
    assert float(row["steps"]) == 250 and float(row["seconds"]) == 20.0
    text = (tmp_path / "out" / "time_to_accuracy.md").read_text()
    assert "| standard, 800 steps (reference) | 2 | 800 | 80.0 ± 0.0 | 1.00 ± 0.00 | 41.50 ± 0.71 |" in text
    assert "| quick | 2 | 200 | 22.0 ± 2.8 | 0.28 ± 0.04 | 41.40 ± 0.71 | -0.10 ± 0.00 | 2 of 2 |" in text
    assert "| – standard in the same time | 2 | ≈ 270 |" in text and "| 0 of 2 |" in text
    assert (tmp_path / "out" / "time_to_accuracy.png").stat().st_size > 10_000
    outside = [one for one in panel.outcomes if one.seconds in (10.0, 80.0)]
    assert all(panel.standard_in(one).scores["psnr"] == pytest.approx(one.scores["psnr"]) for one in outside)
    for seconds in (9.9, 80.1):
        scores = {"psnr": 30.0, "mae_c": 1.0}
        assert panel.standard_in(Outcome("quick", "0", 1, seconds, scores, 1.0, {"psnr": [], "mae_c": []})) is None


def test_processor_seconds_may_take_the_place_of_those_of_the_clock(runs, tmp_path, caplog, no_pictures):
    made(runs / "busy", ["preset=busy", "seed=0"], 200, 900.0, 41.0, [(900, 41.0)], cpu=0.01)
    (panel,) = run(tmp_path / "out", str(runs), REFERENCE, RECIPES, clock="cpu_seconds")
    row = by_recipe(tmp_path / "out")["preset=busy"]
    assert float(row["seconds"]) == float(row["way_psnr"]) == pytest.approx(9.0)
    assert float(row["time_ratio"]) == pytest.approx(9 / 40) and panel.references["0"].seconds == 40.0
    old = RunResults.read(runs / "busy" / METRICS_FILE)
    old.put("cost", "cpu_seconds", None, "of an older version")
    old.write(runs / "busy" / METRICS_FILE)
    run(tmp_path / "again", str(runs), REFERENCE, RECIPES, clock="cpu_seconds")
    assert "preset=busy" not in by_recipe(tmp_path / "again")
    assert "busy is left out: it does not tell its cpu_seconds" in caplog.text


def test_methods_and_scenes_have_panels_and_references_of_their_own(runs, tmp_path, caplog):
    made(runs / "other", ["max_steps=800"], 800, 60.0, 33.0, method="3dgs")
    made(runs / "other_quick", ["preset=fast", "seed=0"], 200, 6.0, 32.0, method="3dgs")
    made(runs / "lone", ["preset=fast", "seed=7"], 200, 6.0, 32.0, method="3dgs")
    made(runs / "before", ["preset=fast", "seed=0", "threads=2"], 190, 1.0, 32.0, method="3dgs")
    made(runs / "table", ["preset=fast", "seed=1", "experiment=table_etgs_1"], 200, 5.0, 30.0)
    panels = {panel.title: panel for panel in run(tmp_path / "out", str(runs), REFERENCE, RECIPES)}
    assert set(panels) == {"etgs on heated", "3dgs on heated"}
    names = {one.recipe for one in panels["etgs on heated"].outcomes}
    assert {"quick", "experiment=table_etgs_1 preset=fast"} <= names  # which sets more
    found = panels["3dgs on heated"]
    outcomes = [own for group in found.groups() for own in group]
    assert [(one.recipe, one.seed, one.seconds) for one in outcomes] == [(None, "0", 60.0), ("quick", "0", 6.0)]
    assert "3dgs on heated, quick, seed 7 is left out: there is no reference with this seed" in caplog.text
    assert "before is left out: a later run of its recipe and seed counts" in caplog.text
    assert found.standard_in(outcomes[1]) is None  # one length says nothing of others


def test_a_scene_without_temperatures_is_measured_by_psnr_alone(tmp_path, no_pictures):
    for place, steps, psnr in (("a", 800, 40.0), ("b", 200, 39.9)):
        overrides = ["max_steps=800"] if steps == 800 else ["preset=fast"]
        made(tmp_path / place, overrides, steps, steps / 10, psnr)
        results = RunResults.read(tmp_path / place / METRICS_FILE)
        results.put("test", "mae_c", None, "no temperature bounds")
        results.write(tmp_path / place / METRICS_FILE)
    run(tmp_path / "out", str(tmp_path), REFERENCE, RECIPES)
    text = (tmp_path / "out" / "time_to_accuracy.md").read_text()
    assert "within 0.2 dB of it" in text and "MAE" not in text


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"reference": ["max_steps=9"]}, r"there is no finished run of the reference \(max_steps=9\)"),
        ({"reference": ["density=adaptive"]}, "give its length too"),
        ({"reference": ["max_steps=3e4"]}, "give its length too, a whole number"),
        ({"psnr_margin_db": "abc"}, "study.psnr_margin_db must be a number, got abc"),
        ({"mae_margin_c": None}, "study.mae_margin_c must be a number, got null"),
        ({"clock": "wall"}, "study.clock must be one of train_seconds, cpu_seconds, got 'wall'"),
        ({"cases": {"a": ["method=etgs"]}, "seeds": []}, r"study.seeds=\[\] has nothing in it"),
        ({"cases": {"a": ["method=etgs"]}, "lengths": ["long"]}, "study.lengths must be a whole number"),
    ],
)
def test_what_cannot_be_compared_is_refused(wrong, message, runs, tmp_path):
    with pytest.raises(SceneError, match=message):
        run(**{"output_dir": tmp_path / "out", "runs": str(runs), "reference": REFERENCE, "recipes": RECIPES} | wrong)


def test_a_word_or_number_is_a_list_of_one():
    found = time_to_accuracy.asked_for({"a": "method=etgs"}, ["max_steps=9"], 5, {}, 0)
    assert found == [
        ("a_reference_0", ["method=etgs", "max_steps=9", "seed=0"]),
        ("a_standard_5_0", ["method=etgs", "max_steps=5", "seed=0"]),
    ]


def test_missing_runs_are_trained_and_finished_ones_are_not(runs, tmp_path, monkeypatch, no_pictures):
    asked = []

    def train(place: Path, train: str | None, overrides: list[str], study: Path) -> None:
        asked.append(overrides)
        chosen = [text for text in overrides if not text.startswith(("method=", "data."))]
        steps = next((int(text[10:]) for text in overrides if text.startswith("max_steps=")), 200)
        made(place, chosen, steps, steps / 10, 40.0)

    monkeypatch.setattr(time_to_accuracy, "train_or_read", train)
    (panel,) = run(
        tmp_path / "out", str(runs), REFERENCE, RECIPES | {"other": ["density=proximity", "max_steps=200"]},
        cases={"case": ["method=etgs", "data.scene=heated"]}, lengths=[100, 300, 400], seeds=[0, 2],
        overrides=["dtype=float64"], threads=1,
    )  # fmt: skip
    told = {tuple(text for text in overrides[4:]) for overrides in asked}
    assert all(
        overrides[:4] == ["threads=1", "dtype=float64", "method=etgs", "data.scene=heated"] for overrides in asked
    )
    assert told == {
        ("max_steps=300", "seed=0"), ("density=proximity", "max_steps=200", "seed=0"),
        ("max_steps=800", "seed=2"), ("max_steps=100", "seed=2"), ("max_steps=300", "seed=2"), ("max_steps=400", "seed=2"),
        ("preset=fast", "seed=2"), ("density=proximity", "max_steps=200", "seed=2"),
    }  # fmt: skip
    names = {(one.recipe, one.steps, one.seed) for one in panel.outcomes}
    assert (None, 300, "2") in names and ("other", 200, "0") in names and ("quick", 200, "2") in names


def test_what_a_case_says_beside_its_scene_makes_a_panel_and_no_other_recipe(tmp_path, monkeypatch, no_pictures):
    def train(place: Path, train: str | None, overrides: list[str], study: Path) -> None:
        own = [text for text in overrides if not text.startswith(("method=", "data.scene="))]
        steps = 800 if "max_steps=800" in overrides else 200
        made(place, own, steps, steps / 10, 41.0 if "thermal.frequencies=8" in overrides else 40.0)

    monkeypatch.setattr(time_to_accuracy, "train_or_read", train)
    scene = ["method=etgs", "data.scene=heated"]
    cases = {
        "plain": scene,
        "few": [*scene, "thermal.frequencies=8"],
        "other": [*scene, "data.scene_seed=1"],
        "degraded": [*scene, "data.degrade=area4"],
    }
    panels = run(tmp_path / "out", None, REFERENCE, RECIPES, cases=cases)
    assert {panel.title: len(panel.outcomes) for panel in panels} == {
        "etgs on heated": 2, "etgs on heated, thermal.frequencies=8": 2, "etgs on heated, data.scene_seed=1": 2,
        "etgs on heated, data.degrade=area4": 2,
    }  # fmt: skip
    assert {one.recipe for panel in panels for one in panel.outcomes} == {None, "quick"}
    few = next(panel for panel in panels if panel.title.endswith("frequencies=8"))
    assert few.references["0"].scores["psnr"] == 41.0


def test_the_configuration_asks_for_what_there_is():
    """Every recipe of the study composes, on the scene of its comment."""
    study = compose(["study=time_to_accuracy"], "study")["study"]
    assert compose([*study["reference"], "method=etgs"])["max_steps"] == 30000
    overrides = study["overrides"]
    for recipe in study["recipes"].values():
        config = compose([*overrides, "method=etgs", "data.scene=heated", *recipe])
        assert config["max_steps"] <= 30000 and config["callbacks"]["images"] is config["threads"] is None
