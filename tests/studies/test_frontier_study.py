"""The frontier of finished runs: what is read, who lies on the front, time to a quality, and what is written."""

import csv
import json
import re
import shlex
from pathlib import Path

import pytest
import yaml
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from running import compose_run

from heatsplat import cli
from heatsplat.contracts import SceneError
from heatsplat.io.results import METRICS_FILE, RunResults
from heatsplat.studies.frontier import report
from heatsplat.studies.frontier import study as frontier
from heatsplat.studies.frontier.report import markdown
from heatsplat.studies.frontier.runs import dominated, find_runs, group, seconds_to
from heatsplat.studies.frontier.study import asked_for, run

CONFIG = Path(cli.CONF) / "study" / "frontier.yaml"
LEVELS = {"psnr_levels_db": [25, 30], "mae_levels_c": [15, 10]}


def made(
    folder: Path,
    method: str,
    overrides: list[str],
    course: list[tuple[float, float]],
    seconds: float,
    psnr: float,
    **data: object,
):
    """A run's folder, as far as the frontier reads it; ``data`` is what the results say of the data."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([f"method={method}", *overrides]))
    rows = ["step,train_seconds,gaussians,psnr,mae_c", *(f"1,{s},10,{v},{40 - v}" for s, v in course), "9,,10,99,0"]
    (folder / "curve.csv").write_text("\n".join(rows) + "\n")
    seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
    results = RunResults(run={"scene": "cooling", "method": method, "seed": seed, "threads": 2}, data=data)
    results.put("test", "psnr", psnr)
    results.put("test", "mae_c", 40 - psnr)
    results.put("cost", "train_seconds", seconds)
    results.put("cost", "peak_memory_mb", 700.0)
    results.write(folder / METRICS_FILE)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes a second; the test of tables, pictures and the page looks at it."""
    monkeypatch.setattr(frontier, "picture", lambda recipes: Figure(figsize=(1, 1)))


@pytest.fixture
def runs(tmp_path) -> Path:
    for seed, psnr in ((0, 30.0), (1, 32.0)):
        made(tmp_path / f"a{seed}", "etgs", [f"seed={seed}", "max_steps=9"], [(1, 20), (3, 28), (5, 31)], 5.0, psnr)
    made(tmp_path / "sweep" / "b", "3dgs", ["max_steps=9", "threads=1"], [(1, 18), (4, 24)], 4.0, 24.0)
    made(tmp_path / "sweep" / "c", "3dgs", ["max_steps=9", "thermal.sh_degree=2"], [(1, 18), (8, 25)], 8.0, 25.0)
    (tmp_path / "a0" / "evaluations").mkdir()
    (tmp_path / "a0" / "evaluations" / METRICS_FILE).write_text("{}")
    return tmp_path


def test_runs_are_found_at_any_depth_and_grouped_over_seeds(runs):
    recipes = {recipe.name: recipe for recipe in group(find_runs([runs]))}
    assert set(recipes) == {"etgs", "3dgs", "3dgs thermal.sh_degree=2"}
    etgs = recipes["etgs"]
    assert etgs.count == 2 and etgs.mean("psnr") == 31.0 and etgs.spread("psnr") == pytest.approx(2**0.5)
    assert etgs.table["course"].iloc[0]["psnr"] == [(1, 20), (3, 28), (5, 31)]


def test_the_front_is_what_nothing_beats_in_both(runs):
    made(runs / "d", "ti3dgs", ["max_steps=9"], [(0.5, 10)], 0.9, 19.0)
    front = {recipe.name: recipe.on_front for recipe in group(find_runs([runs]))}
    assert front["ti3dgs"] == {"psnr": True, "mae_c": True}  # the quickest
    assert front["etgs"] == {"psnr": True, "mae_c": True}  # the best
    assert front["3dgs"] == {"psnr": False, "mae_c": False}  # quicker than etgs at its end, which was better on its way
    assert front["3dgs thermal.sh_degree=2"] == {"psnr": False, "mae_c": False}
    assert not dominated(1.0, 2.0, [(1.0, 2.0)]) and dominated(1.0, 2.0, [(1.0, 2.5)])
    assert dominated(1.0, 2.0, [(0.9, 2.0)]) and not dominated(1.0, 2.0, [(0.9, 1.9), (1.1, 2.1)])


def test_time_to_a_quality_lies_on_the_line_between_validations():
    course = [(1.0, 20.0), (3.0, 28.0), (5.0, 26.0), (7.0, 30.0)]
    assert seconds_to(course, 20.0, higher=True) == 1.0 and seconds_to(course, 19.0, higher=True) == 1.0
    assert seconds_to(course, 24.0, higher=True) == 2.0 and seconds_to(course, 29.0, higher=True) == 6.5
    assert seconds_to(course, 31.0, higher=True) is None and seconds_to([], 1.0, higher=True) is None
    falling = [(1.0, 4.0), (2.0, 1.0)]
    assert seconds_to(falling, 2.5, higher=False) == 1.5 and seconds_to(falling, 0.5, higher=False) is None


def test_tables_pictures_and_a_page_that_needs_nothing_else(runs, tmp_path):
    run(tmp_path / "out", [str(runs), str(runs / "sweep")], **LEVELS)  # a run counts once
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert "| etgs | 2 | 5.0 | 31.00 ± 1.41 |" in text and "| PSNR, MAE |" in text
    assert "All rows: `max_steps=9 seed=0,1 threads=2`.\n" in text
    assert re.search(r"\| seconds to \|.* 25 dB \|.* 30 dB \|", text) and "| 3dgs |" in text
    with open(tmp_path / "out" / "frontier.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    ends = [row for row in rows if row["views"] == "test"]
    assert [row["score"] for row in ends] == 4 * ["psnr", "mae_c", "peak_memory_mb"]
    assert [row["on_front"] for row in ends[:3]] == ["False", "False", ""] and ends[2]["value"] == "700.0"
    assert sum(row["views"] == "validation" for row in rows) == 2 * (3 + 3 + 2 + 2)
    page = (tmp_path / "out" / "frontier.html").read_text()
    assert "data:image/svg+xml;base64," in page and not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert (tmp_path / "out" / "frontier.png").stat().st_size > 10_000 and list((tmp_path / "out" / "tb").iterdir())


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"there is no finished run .*Give folders that src/train.py wrote"):
        run(tmp_path / "out", str(tmp_path), **LEVELS)


def measured(size: str, test: int, *more: str, split: str = "every_8th") -> dict:
    """What results say of views of a size."""
    return {"image_sizes": [size, *more], "views": {"train": 9, "val": 2, "test": test}, "split": split}


def names_by_panel(folder: Path) -> dict[str, set[str]]:
    panels: dict[str, set[str]] = {}
    for recipe in group(find_runs([folder])):
        panels.setdefault(recipe.scene, set()).add(recipe.name)
    return panels


def test_runs_that_measured_other_images_have_panels_of_their_own(tmp_path):
    """A front of tiny and large images of one scene would say nothing."""
    for size, shown, test in (("tiny", "64x52", 3), ("demo", "160x128", 9)):
        for method, psnr in (("etgs", 30.0), ("3dgs", 25.0)):
            folder = tmp_path / f"{method}_{size}"
            made(folder, method, [f"data.size={size}", "max_steps=9"], [], 1.0, psnr, **measured(shown, test))
    made(tmp_path / "half", "etgs", ["data.downscale=2"], [], 9.0, 20.0, **measured("80x64", 9))
    recipes = group(find_runs([tmp_path]))
    assert {recipe.scene for recipe in recipes} == {
        f"cooling, image size {text}" for text in ("64x52", "160x128", "80x64")
    }
    best = {(recipe.scene, recipe.name) for recipe in recipes if recipe.on_front["psnr"]}
    assert ("cooling, image size 64x52", "etgs max_steps=9") in best and ("cooling, image size 80x64", "etgs") in best


def test_images_that_only_training_sees_smaller_are_compared(tmp_path):
    made(tmp_path / "a", "supirgs", [], [], 1.0, 30.0, **measured("160x128", 9, "40x32"))
    made(tmp_path / "b", "bicubic_3dgs", [], [], 2.0, 25.0, **measured("160x128", 9))
    assert names_by_panel(tmp_path) == {"cooling": {"supirgs", "bicubic_3dgs"}}


def test_the_picture_has_no_more_scenes_than_can_be_shown(tmp_path, monkeypatch):
    for k, scene in enumerate(("64x52", "160x128", "80x64")):
        made(tmp_path / str(k), "etgs", [], [], 1.0, 30.0, **measured(scene, 9))
    monkeypatch.setattr(report, "DRAWN", 2)
    figure = report.picture(group(find_runs([tmp_path])))
    assert len(figure.axes) == 4 and figure.get_suptitle() == "the first 2 of 3 scenes; the tables have all"


def test_titles_say_as_much_as_tells_panels_apart(tmp_path):
    made(tmp_path / "a", "etgs", [], [], 1.0, 30.0, **measured("64x52", 9))
    made(tmp_path / "b", "etgs", [], [], 1.0, 30.0, **measured("64x52", 3))
    for name, position in (("c", 0.0), ("d", 1.0)):
        place = tmp_path / name
        made(place, "etgs", [f"data.split_position={position}"], [], 1.0, 30.0, **measured("64x52", 3, split="block"))
        (place / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"data": {"split_position": position}}))
    few = "cooling, test views 3, split"
    assert names_by_panel(tmp_path) == {
        "cooling, test views 9": {"etgs"},
        f"{few} every_8th": {"etgs"},
        f"{few} block, data.split_position 0.0": {"etgs"},
        f"{few} block, data.split_position 1.0": {"etgs"},
    }


def test_names_of_rows_stay_whole_and_say_what_else_differs(tmp_path):
    """Only settings are left out of names, whatever stands in a row's name."""
    for i, (k, steps, seed) in enumerate(((8, 9, 0), (8, 9, 1), (24, 9, 0), (24, 18, 0))):
        own = [f"thermal.frequencies={k}", f"max_steps={steps}", f"row='K = {k}'", f"seed={seed}"]
        made(tmp_path / str(i), "etgs", own, [], 1.0, 30.0)
    assert names_by_panel(tmp_path) == {
        "cooling": {"etgs, K = 8", "etgs, K = 24, max_steps=9", "etgs, K = 24, max_steps=18"}
    }
    (eight,) = (recipe for recipe in group(find_runs([tmp_path])) if recipe.name == "etgs, K = 8")
    assert eight.count == 2


def test_runs_that_went_on_and_other_seeds_of_a_scene_are_one_recipe(tmp_path):
    made(tmp_path / "a", "etgs", ["max_steps=9", "seed=0", "data.scene_seed=0"], [], 1.0, 30.0)
    made(tmp_path / "b", "etgs", ["seed=1", "data.scene_seed=1", "max_steps=9", "ckpt=runs/last.ckpt"], [], 1.0, 32.0)
    made(tmp_path / "c", "etgs", ["test=true", "max_steps=9", "table.scenes=[wall]", "seed=2"], [], 1.0, 31.0)
    (recipe,) = group(find_runs([tmp_path]))
    assert recipe.name == "etgs max_steps=9" and recipe.count == 3


def test_a_seed_that_was_trained_twice_counts_once(tmp_path, caplog):
    """By the same command on another day, or with its default written out: the last counts."""
    for name, own, psnr in (("1", [], 30.0), ("2", ["seed=0", "launcher=basic"], 31.0), ("3", ["seed=1"], 33.0)):
        made(tmp_path / name, "etgs", own, [], 1.0, psnr)
    (recipe,) = group(find_runs([tmp_path]))
    assert recipe.values("psnr") == [31.0, 33.0] and f"without {tmp_path / '1'}" in caplog.text


def test_seconds_of_several_numbers_of_threads_are_told(tmp_path):
    made(tmp_path / "a", "etgs", ["seed=0"], [], 1.0, 30.0)
    made(tmp_path / "b", "etgs", ["seed=1"], [], 9.0, 31.0)
    recipes = group(find_runs([tmp_path]))
    assert "Seconds are of" not in markdown(recipes, {"psnr": [], "mae_c": []})
    recipes[0].table["results"].iloc[0].run["threads"] = 16
    told = "compare within one: 16 threads (1 run); 2 threads (1 run).\n"
    assert told in markdown(recipes, {"psnr": [], "mae_c": []})


def test_what_an_experiment_sets_is_no_seed(tmp_path):
    """A published table trains with recipe=published, which no override of its runs tells."""
    made(tmp_path / "a", "etgs", ["max_steps=9", "seed=0"], [], 1.0, 30.0)
    made(tmp_path / "b", "etgs", ["max_steps=9", "seed=1", "experiment=table_etgs_1"], [], 1.0, 31.0)
    assert names_by_panel(tmp_path) == {"cooling": {"etgs max_steps=9", "etgs max_steps=9 experiment=table_etgs_1"}}


def test_runs_that_differ_in_more_than_their_seeds_are_recipes_of_their_own(tmp_path):
    for i, (clip, seed) in enumerate((("1e-4", 0), ("1e-4", 1), ("null", 0))):
        given = [f"+trainer.gradient_clip_val={clip}", f"seed={seed}"]
        made(tmp_path / f"{i}", "etgs", given, [], 1.0, 30.0)
        made(tmp_path / f"row{i}", "etgs", [*given, "row=plain"], [], 1.0, 30.0)
    clips = [f"+trainer.gradient_clip_val={clip}" for clip in ("1e-4", "null")]
    names = {f"{start} {clip}" for start in ("etgs", "etgs, plain") for clip in clips}
    assert names_by_panel(tmp_path) == {"cooling": names}


def test_a_word_or_number_is_a_list_of_one():
    knobs = {"dtype": "float64", "max_steps": 9}
    ((place, overrides),) = asked_for("etgs", "heated", 0, knobs)
    assert place == "etgs_heated_dtype=float64_max_steps=9_seed=0" and overrides[1] == "data.scene=heated"
    assert asked_for({"etgs": knobs}, ["heated"], [0], None) == [(place, overrides)]


def test_folders_of_long_knobs_have_names_that_file_systems_take():
    asked = asked_for("supirgs", "heated", [0, 1], {"teacher": [f"/data/{'deep/' * 60}{name}.pth" for name in "ab"]})
    places = [place for place, _ in asked]
    assert len({*places}) == 4 and max(len(place.encode()) for place in places) <= 200


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seeds": []}, r"study.seeds=\[\] has nothing in it"),
        ({"scenes": None}, "study.scenes=null has nothing in it"),
        ({"knobs": {"dtype": []}}, r"study.knobs.dtype=\[\] has nothing in it"),
        ({"methods": {"etgs": {"dtype": None}}}, "study.methods.etgs.dtype=null has nothing in it"),
        ({"knobs": "dtype"}, r"study.knobs=dtype: give settings with their values, such as \{max_steps"),
        ({"methods": {"etgs": 24}}, "study.methods.etgs=24: give settings with their values"),
    ],
)
def test_what_would_train_nothing_is_refused(wrong, message, tmp_path, monkeypatch):
    monkeypatch.setattr(frontier, "train_or_read", None)
    options = {"methods": ["3dgs"], "scenes": ["heated"], "seeds": [0], "knobs": None} | wrong
    with pytest.raises(SceneError, match=message):
        run(tmp_path / "out", None, **LEVELS, **options)


def test_a_knob_that_is_null_is_null_for_its_run():
    ((place, overrides),) = asked_for(["etgs"], ["heated"], [0], {"thermal.clip": [None]})
    assert overrides[-1] == "thermal.clip=null" and place.endswith("thermal.clip=null_seed=0")


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        (METRICS_FILE, "{", "is not a metrics.json of heatsplat"),
        (METRICS_FILE, '{"run": {"scene": "cooling"}}', "sections are missing or no mappings: test, cost"),
        ("curve.csv", "train_seconds,psnr\n1.0,many\n", "could not convert string to float"),
        ("curve.csv", "train_seconds,psnr\n1,20\n2,213,22\n", "curve.csv: row 2 has more cells than columns"),
        (".hydra/overrides.yaml", "[", "while parsing"),
    ],
)
def test_a_run_that_cannot_be_read_is_left_out_with_a_warning(runs, tmp_path, caplog, no_pictures, name, content, why):
    (runs / "sweep" / "b" / name).write_text(content)
    with caplog.at_level("WARNING", logger="heatsplat"):
        recipes = run(tmp_path / "out", str(runs), **LEVELS)
    assert {recipe.name for recipe in recipes} == {"etgs", "3dgs thermal.sh_degree=2"}
    (warning,) = caplog.messages
    assert warning.startswith(f"{runs / 'sweep' / 'b'} is left out: ") and why in warning


def test_where_no_run_can_be_read_the_folder_and_the_remedy_are_named(tmp_path):
    made(tmp_path / "old", "etgs", [], [(1, 20)], 5.0, 30.0)
    content = json.loads((tmp_path / "old" / METRICS_FILE).read_text())
    del content["effects"]
    (tmp_path / "old" / METRICS_FILE).write_text(json.dumps(content))
    with pytest.raises(SceneError, match=rf"study.runs={tmp_path}: there is no finished run .* must be trained again"):
        run(tmp_path / "out", str(tmp_path), **LEVELS)


def test_one_run_is_one_run(tmp_path, no_pictures, caplog):
    made(tmp_path / "a", "etgs", ["max_steps=9"], [(1, 20), (3, 28)], 5.0, 30.0)
    with caplog.at_level("INFO"):
        run(tmp_path / "out", str(tmp_path / "a"), **LEVELS)
    assert "1 run of 1 recipe:" in caplog.text


def test_levels_are_those_asked_for(runs, tmp_path, no_pictures):
    run(tmp_path / "out", str(runs), psnr_levels_db=[29, 21.5], mae_levels_c=[])
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert "| seconds to | 21.5 dB | 29 dB |\n" in text


def test_a_level_that_every_seed_has_at_its_first_validation_is_left_out(runs, tmp_path, no_pictures):
    made(tmp_path / "slow", "etgs", ["seed=2", "max_steps=9"], [(2, 20), (6, 31)], 7.0, 31.0)
    run(tmp_path / "out", str(runs), psnr_levels_db=[15, 21.5], mae_levels_c=[])
    assert "| seconds to | 21.5 dB |\n" in (tmp_path / "out" / "frontier.md").read_text()


@pytest.mark.parametrize("levels", [30, None, "30", [20, -1], [True], ["20"], [float("nan")], {"a": 1}])
@pytest.mark.parametrize("name", LEVELS)
def test_levels_that_are_none_are_refused(runs, tmp_path, name, levels):
    with pytest.raises(SceneError, match=rf"study.{name}=.*give positive numbers in brackets, such as \[1, 2\]"):
        run(tmp_path / "out", str(runs), **LEVELS | {name: levels})


def test_the_study_trains_what_it_is_asked_for_and_nothing_twice(tmp_path, monkeypatch, no_pictures):
    asked = []

    def trained(place, train, overrides, study):
        if not place.exists():
            asked.append(overrides)
            settings = [text for text in overrides if not text.startswith("method=")]
            made(place, overrides[1].partition("=")[2], settings, [(1, 20), (3, 28)], 5.0, 30.0 + len(asked))

    monkeypatch.setattr(frontier, "train_or_read", trained)
    options = {
        "methods": {"etgs": {"thermal.frequencies": [8, 24]}, "3dgs": {}},
        "scenes": ["heated", "cooling"],
        "seeds": [0, 1],
        "knobs": {"dtype": ["float32", "float64"]},
        "overrides": ["data.size=tiny"],
    }
    for _ in range(2):
        recipes = run(tmp_path / "out", None, **LEVELS, **options, outputs=str(tmp_path / "nowhere"))
    assert len(asked) == 2 * 2 * 2 * (2 + 1)
    assert asked[0] == [
        "data.size=tiny", "method=etgs", "data.scene=heated", "seed=0", "dtype=float32", "thermal.frequencies=8"
    ]  # fmt: skip
    assert "All rows: `data.size=tiny seed=0,1 threads=2`." in (tmp_path / "out" / "frontier.md").read_text()
    assert {recipe.count for recipe in recipes} == {2} and len(recipes) == 2 * 6  # the stand-in says cooling of all


def test_the_commands_in_the_configuration_make_runs_that_compose():
    text = CONFIG.read_text()
    of_all = [shlex.split(typed)[0] for typed in re.findall(r'"study.overrides=[^"]+"', text)]
    lists = [compose_run("study=frontier", typed, config_name="study").study.overrides for typed in of_all]
    assert lists == [["data=rhd", "data.root=/data/RHD"], ["data.size=tiny", "threads=1"]]
    (trains,) = re.findall(r"^# +python src/study.py (study=frontier study.methods.+)$", text, re.MULTILINE)
    (own,) = re.findall(r'^# +\.\.\. ("study.methods=.+")$', text, re.MULTILINE)
    same, other = shlex.split(trains), shlex.split(own)
    own = [other[0] if text.startswith("study.methods=") else text for text in same]
    for command, runs in ((same, 2 * 2 * 2 * 4), (own, 2 * 2 * 4 * 3)):
        study = compose_run(*command, config_name="study").study
        plain = OmegaConf.to_container(study)
        jobs = asked_for(plain["methods"], plain["scenes"], plain["seeds"], plain["knobs"])
        assert len(jobs) == len(dict(jobs)) == runs
        for _, overrides in (jobs[0], jobs[-1]):
            config = compose_run(*overrides)
            assert config.density.cap_max in (5000, 20000) and config.max_steps in (1000, 3000)
