"""Tuning: what is searched and compared, when a setting counts as better, and how a study goes on."""

import csv
import math
import re
import sys

import pytest
import yaml
from helpers import ROOT

from heatsplat.composition import compose
from heatsplat.contracts import SceneError
from heatsplat.io.results import FAILED, METRICS_FILE, RunResults
from heatsplat.studies import tune
from heatsplat.studies.child_runs import OtherSettingsError

optuna = pytest.importorskip("optuna")
CASES = {
    "etgs": {"scene": ["data.scene=heated"], "knobs": {"thermal.lr_source": [0.01, 1.0], "b": {"among": ["x", "y"]}}}
}
BEST = 0.3  # the rate at which the world below has its best PSNR


def psnr_of(settings: dict[str, str], seed: int) -> float:
    """A world in which the rate has an optimum, the default is a rate of 0.03, and "y" costs 1 dB."""
    rate = float(settings.get("thermal.lr_source", 0.03))
    noise = (0.0, 0.1, -0.1, 0.05)[seed]
    return 40 - 5 * math.log10(rate / BEST) ** 2 - (settings.get("b") == "y") + noise


@pytest.fixture
def world(monkeypatch):
    """Runs as functions; the list of the overrides that were trained, in order."""
    started = []

    def trained(place, train, overrides, study):
        if (place / METRICS_FILE).exists():
            return RunResults.read(place / METRICS_FILE)
        settings = dict(text.split("=", 1) for text in overrides)
        started.append(settings)
        last = study / "tune.md"
        settings["report"] = last.read_text() if last.exists() else ""
        if float(settings.get("thermal.lr_source", 0)) > 0.9 or settings.get("fragile") == settings["seed"]:
            place.mkdir(parents=True, exist_ok=True)
            (place / FAILED).write_text("Traceback\nSceneError: the loss is NaN\n")
            raise SceneError("a run of the study failed")
        seed = int(settings["seed"])
        results = RunResults(run={"method": settings["method"], "seed": seed})
        for name, value in (("psnr", psnr_of(settings, seed)), ("ssim", 0.9), ("mae_c", 1.0)):
            results.put("test", name, value)
        for name, value in (("gaussians", 1000.0), ("cpu_seconds", 3.0), ("wall_seconds", 5.0)):
            results.put("cost", name, value)
        place.mkdir(parents=True)
        results.write(place / METRICS_FILE)
        return results

    monkeypatch.setattr(tune, "train_or_read", trained)
    return started


def test_a_search_finds_what_is_better_and_other_seeds_confirm_it(world, tmp_path):
    (check,) = tune.run(tmp_path, CASES, trials=12)
    assert check.verdict == "better" and 3 < sum(check.gains) / 3 < 5.1  # 5 dB are to be had
    assert [run["seed"] for run in world].count("0") == 13  # the default, and twelve trials
    assert {run["seed"] for run in world[13:]} == {"1", "2", "3"} and len(world) == 13 + 6
    with open(tmp_path / "tune.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 19 and {row["part"] for row in rows} == {"search", "check"}
    best = max((row for row in rows if row["part"] == "search"), key=lambda row: float(row["psnr"]))
    text = (tmp_path / "tune.md").read_text()
    assert best["settings"].replace(" ", ", ") in text and "| better |" in text


def test_a_study_that_was_stopped_asks_for_the_same_trials(world, tmp_path):
    tune.run(tmp_path, CASES, trials=4)
    before, text = list(world), (tmp_path / "tune.md").read_text()
    tune.run(tmp_path, CASES, trials=4)
    assert world == before and (tmp_path / "tune.md").read_text() == text
    tune.run(tmp_path, CASES, trials=6)
    assert len([run for run in world if run["seed"] == "0"]) == 7  # two more


def test_a_trial_that_fails_is_told_and_the_others_go_on(world, tmp_path):
    cases = {"etgs": CASES["etgs"] | {"knobs": {"thermal.lr_source": {"among": [0.95, 0.3]}}}}
    (check,) = tune.run(tmp_path, cases, trials=6)
    assert check.verdict == "better" and "failed: SceneError: the loss is NaN" in (tmp_path / "tune.md").read_text()


def test_trials_of_other_settings_are_refused_and_not_taken_for_failed_ones(world, tmp_path, monkeypatch):
    train = tune.train_or_read

    def refusing(place, *more):
        if "trial1" in place.name:
            raise OtherSettingsError("of other settings")
        return train(place, *more)

    monkeypatch.setattr(tune, "train_or_read", refusing)
    with pytest.raises(OtherSettingsError, match="of other settings"):
        tune.run(tmp_path, CASES, trials=3)


@pytest.mark.parametrize("which", ["default", "trial"])
def test_a_run_without_the_score_gives_no_verdict(world, tmp_path, monkeypatch, which):
    train = tune.train_or_read

    def blind(place, *more):
        results = train(place, *more)
        if which in place.name and place.name.endswith("_2"):
            results.put("test", "psnr", None, "infinite")
        return results

    monkeypatch.setattr(tune, "train_or_read", blind)
    (check,) = tune.run(tmp_path, CASES, trials=8)
    assert check.gains == [] and check.verdict == "failed: a run has no psnr"
    assert "| failed: a run has no psnr |" in (tmp_path / "tune.md").read_text()


def test_the_report_says_what_all_runs_have_and_with_which_seeds_they_are_compared(world, tmp_path):
    tune.run(tmp_path, CASES, trials=2, seeds=[3, 1], overrides=["data.downscale=2"], threads=1)
    text = (tmp_path / "tune.md").read_text()
    assert "All rows: `threads=1 data.downscale=2`." in text and "beside the default, seeds 3, 1\n" in text
    assert "| gain in PSNR (dB) | verdict |" in text


def test_a_best_setting_that_fails_on_another_seed_is_told(world, tmp_path):
    cases = {"etgs": CASES["etgs"] | {"knobs": {"thermal.lr_source": {"among": [0.3]}, "fragile": {"among": [2]}}}}
    (check,) = tune.run(tmp_path, cases, trials=1)
    assert check.verdict == "failed: SceneError: the loss is NaN" and check.gains == []
    assert [len(several) for several in (check.default, check.best)] == [3, 2]
    rows = [line for line in (tmp_path / "tune.md").read_text().splitlines() if "thermal.lr_source=0.3" in line]
    assert rows[0].endswith("|  | failed: SceneError: the loss is NaN |") and "| 2 |" in rows[0]


def test_what_a_search_found_is_written_before_it_is_compared(world, tmp_path):
    """A default that fails with another seed ends the study, and not what it has found."""
    cases = {"etgs": CASES["etgs"] | {"knobs": {"thermal.lr_source": {"among": [0.3]}}}}
    with pytest.raises(SceneError):
        tune.run(tmp_path, cases, trials=1, seeds=[1, 3], overrides=["fragile=3"])
    assert "| 0.3 |" in (tmp_path / "tune.md").read_text()
    tune.run(tmp_path / "other", cases, trials=1, check_steps=[1500, 7000])
    first = next(run for run in world if run["max_steps"] == "7000")
    assert "| etgs | 1500 | default | 3 |" in first["report"] and "7000" not in first["report"]


def test_no_trial_begins_when_the_seconds_are_spent(world, tmp_path):
    tune.run(tmp_path, CASES, trials=9, seconds=12)
    assert [run["seed"] for run in world].count("0") == 1 + 3  # 5 s each


def test_a_default_that_no_trial_beats_is_not_compared(world, tmp_path):
    cases = {"etgs": CASES["etgs"] | {"knobs": {"thermal.lr_source": [0.001, 0.002]}}}
    assert tune.run(tmp_path, cases, trials=3) == []
    assert "no trial was better than the default" in (tmp_path / "tune.md").read_text()


def test_lengths_are_checked_one_by_one_and_methods_chosen(world, tmp_path):
    cases = CASES | {"3dgs": CASES["etgs"]}
    found = tune.run(tmp_path, cases, methods=["3dgs"], check_steps=[1500, 7000], trials=8)
    assert [(check.method, check.steps) for check in found] == [("3dgs", 1500), ("3dgs", 7000)]
    assert {run["method"] for run in world} == {"3dgs"}


def test_a_word_or_number_is_a_list_of_one(world, tmp_path):
    case = {"scene": "data.scene=heated", "knobs": {"thermal.lr_source": {"among": 0.3}, "b": {"among": "xx"}}}
    options = {"methods": "etgs", "check_steps": 1500, "seeds": 1, "overrides": "logger=none"}
    (check,) = tune.run(tmp_path, {"etgs": case, "3dgs": case}, trials=1, **options)
    assert (check.method, check.steps, len(check.best)) == ("etgs", 1500, 1)
    assert world[1]["data.scene"] == "heated" and world[1]["b"] == "xx" and world[1]["logger"] == "none"


@pytest.mark.parametrize(
    ("default", "best", "verdict"),
    [
        ((30.0, 30.1, 30.2), (31.0, 31.1, 31.2), "better"),
        ((30.0, 30.1, 30.2), (29.0, 29.1, 29.2), "worse"),
        ((30.0, 31.0, 32.0), (30.5, 31.5, 32.5), "within the spread"),  # half a dB, and seeds differ by one
        ((30.0, 30.1, 30.2), (31.0, 31.1, 30.1), "within the spread"),  # one seed says no
        ((30.0,), (35.0,), "within the spread"),  # one seed says nothing
    ],
)
def test_better_is_what_all_seeds_say_by_more_than_they_differ(default, best, verdict):
    def runs(values):
        return [RunResults(test={"psnr": value, "mae_c": -value}) for value in values]

    assert tune.Check("etgs", 1500, runs(default), runs(best), "psnr").verdict == verdict
    assert tune.Check("etgs", 1500, runs(default), runs(best), "mae_c").verdict == verdict


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"score": "speed"}, "study.score must be one of .*, got 'speed'"),
        ({"trials": 0}, "study.trials must be a whole number, 1 or more, got 0"),
        ({"trials": "abc"}, "study.trials must be a whole number, 1 or more, got abc"),
        ({"search_steps": 0}, "study.search_steps must be a whole number"),
        ({"check_steps": [1500, "long"]}, "study.check_steps must be a whole number, 1 or more, got long"),
        ({"seconds": "long"}, "study.seconds must be a number, got long"),
        ({"seeds": []}, "study.seeds=.* give at least one value"),
        ({"seeds": [1, "a"]}, "study.seeds must be a whole number, 0 or more, got a"),
        ({"seeds": [1, 0]}, r"study.seeds=\[1, 0\]: .* not 0, with which the settings were found"),
        ({"seeds": [1, 2, 1]}, r"study.seeds=\[1, 2, 1\]: give every seed once"),
        ({"cases": {"etgs": None}}, "study.cases.etgs has the keys scene and knobs"),
        ({"methods": ["mine"]}, r"mine has no case.*\+study.cases=\{mine:\{scene"),
        ({"cases": {"etgs": {"scene": []}}}, "keys scene and knobs"),
        ({"cases": {"etgs": {"scene": [], "knobs": {"a": [2, 1]}}}}, r"knobs.a=\[2, 1\]: give \[lowest"),
    ],
)
def test_what_is_wrong_is_said_before_anything_trains(changed, message, world, tmp_path):
    with pytest.raises(SceneError, match=message):
        tune.run(tmp_path, **{"cases": CASES, **changed})
    assert world == []


def test_the_case_that_is_proposed_can_be_typed_for_any_method():
    with pytest.raises(SceneError) as refused:
        tune._checked(CASES, ["3dgs"], 1, [1], "psnr")
    (case,) = re.findall(r'"(\+study.cases=.+)"$', str(refused.value))
    assert set(compose(["study=tune", case], "study")["study"]["cases"]["3dgs"]) == {"scene", "knobs"}


def test_a_knob_that_is_null_is_null_for_its_run(world, tmp_path):
    cases = {"etgs": {"scene": ["data.scene=heated"], "knobs": {"b": {"among": [None]}}}}
    tune.run(tmp_path, cases, trials=1)
    assert world[1]["b"] == "null" and "| null |" in (tmp_path / "tune.md").read_text()


def test_without_optuna_its_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ImportError, match=r"heatsplat\[tune\]"):
        tune.run(tmp_path, CASES)


def test_settings_and_scenes_of_the_study_exist():
    """Each knob is a key of its method, whose default lies in its range, and each scene composes. Nothing is None as text,
    such as threads of null that stand within another."""
    config = compose(["study=tune"], "study")["study"]
    assert config["threads"] is None and compose(config["overrides"])["threads"] is None
    assert compose(["study=tune", "threads=2"], "study")["study"]["threads"] == 2
    for method, case in config["cases"].items():
        run = compose([f"method={method}", *case["scene"], f"max_steps={config['search_steps']}"])
        for key, values in case["knobs"].items():
            default = run
            for name in key.split("."):
                default = default[name]
            inside = default in values["among"] if "among" in values else values[0] <= default <= values[1]
            assert inside, (method, key, default)


def test_ranges_of_whole_numbers_give_whole_numbers():
    kind = tune._distribution("etgs", "thermal.frequencies", [8, 64])
    assert isinstance(kind, optuna.distributions.IntDistribution) and kind.log
    assert isinstance(tune._distribution("etgs", "a", [-1.0, 1.0]), optuna.distributions.FloatDistribution)


def test_the_committed_page_names_the_keys_of_the_study():
    keys = set(yaml.safe_load((ROOT / "conf" / "study" / "tune.yaml").read_text()))
    page = (ROOT / "docs" / "tuning.md").read_text()
    assert {"trials", "seconds", "search_steps", "check_steps", "seeds", "cases", "methods"} <= keys
    assert all(f"study.{key}" in page for key in ("trials", "seconds", "check_steps", "cases", "methods"))


def test_trials_that_fail_spend_seconds_too(world, tmp_path, monkeypatch):
    clock = iter(range(0, 10_000, 4))
    monkeypatch.setattr(tune.time, "perf_counter", lambda: next(clock))
    cases = {"etgs": CASES["etgs"] | {"knobs": {"thermal.lr_source": {"among": [0.95]}}}}
    tune.run(tmp_path, cases, trials=9, seconds=12)
    assert [run["seed"] for run in world].count("0") == 1 + 3  # 4 s each
