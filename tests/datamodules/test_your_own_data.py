"""docs/your_own_data.md: its examples are scenes that load, its keys are known to the code."""

import re
from pathlib import Path

import pytest
from layouts import grey, names, rhd_names, write_colmap, write_image, write_rhd

from heatsplat.callbacks.asked_points import asked_points
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.nerfstudio import THERMAL_KEYS, VISIBLE_KEYS
from heatsplat.datamodules.nerfstudio import Nerfstudio
from heatsplat.datamodules.rhd import RHD
from heatsplat.datamodules.thermo import Thermo
from heatsplat.preparation.regions import read_regions

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "your_own_data.md").read_text()
EXAMPLES = dict(re.findall(r'```\w+ title="([^"]+)"\n(.*?)```', PAGE, flags=re.S))
FILES = names(3)


def put(folder, *examples):
    for name in examples:
        (folder / name).write_text(EXAMPLES[name])


def test_every_example_is_tried():
    tried = {
        "temperature_bounds.json",
        "temperature_bounds.csv",
        "times.csv",
        "split.json",
        "transforms.json",
        "meta.json",
        "weather.csv",
        "info.json",
        "points.csv",
        "pixels.csv",
        "regions.csv",
    }
    assert set(EXAMPLES) == tried


def test_the_colmap_example(tmp_path):
    write_colmap(tmp_path, FILES)
    put(tmp_path, "temperature_bounds.json", "times.csv", "split.json")
    scene = Colmap(root=str(tmp_path), time_csv="times.csv", split="list", split_file="split.json").scene
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (12.5, 48.0)
    assert scene.train.times_s == [0.0, 2.5] and scene.test.times_s == [5.0]
    assert [f.name for f in scene.test.frames] == FILES[2:]


def test_the_example_of_a_span_for_each_image(tmp_path):
    write_colmap(tmp_path, FILES)
    put(tmp_path, "temperature_bounds.csv")
    scene = Colmap(root=str(tmp_path)).scene
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (11.9, 51.6)


def test_the_example_of_regions(tmp_path):
    put(tmp_path, "regions.csv")
    regions = read_regions(tmp_path / "regions.csv")
    assert [region.name for region in regions] == ["duct", "window", "tape on the duct"]


def test_the_transforms_example(tmp_path):
    for i, name in enumerate(FILES):
        write_image(tmp_path / "rgb" / name, grey(i))
        write_image(tmp_path / "thermal" / name, grey(i))
    put(tmp_path, "transforms.json")
    scene = Nerfstudio(root=str(tmp_path), random_points=30).scene
    assert [f.name for f in scene.train.frames] == FILES[:2] and [f.name for f in scene.test.frames] == FILES[2:]
    assert scene.train[1].rgb is not None and scene.train[1].camera.center.tolist() == [1.0, 0.0, 4.0]


@pytest.mark.parametrize("table", [True, False])
def test_the_weather_example(tmp_path, table):
    write_colmap(tmp_path, FILES)
    put(tmp_path, "meta.json", *(["weather.csv"] if table else []))
    scene = Thermo(root=str(tmp_path)).scene
    assert (scene.thermal_range.min_c, scene.ambient_c, scene.metres_per_unit) == (5.0, 18.0, 1.0)
    assert scene.train.times_s == [0.0, 3600.0] and scene.test.times_s == [7200.0]
    assert scene.train.frames[1].environment.air_c == pytest.approx(21.5)
    if table:
        assert scene.weather.notes["latitude"] == 50.1 and scene.weather.direct_w_m2 is not None
        assert scene.train.frames[1].environment.irradiance_w_m2 == pytest.approx(700.0)


def test_the_points_of_curves(tmp_path):
    write_colmap(tmp_path, FILES)
    put(tmp_path, "points.csv", "pixels.csv")
    scene = Colmap(root=str(tmp_path)).scene
    places, pixels = (asked_points(tmp_path / name, scene) for name in ("points.csv", "pixels.csv"))
    assert [one.name for one in places] == [one.name for one in pixels] == ["stove", "window"]
    assert places[1].point.tolist() == [1.05, 0.44, 2.1]
    assert [(one.frame.name, one.row, one.column) for one in pixels] == [(FILES[0], 12, 30), (FILES[1], 5, 8)]


def test_the_rhd_example(tmp_path):
    folder = write_rhd(tmp_path, "bench", rhd_names([36000 + 3 * i for i in range(9)])) / "bench" / "thermal"
    put(folder, "info.json")
    scene = RHD(root=str(tmp_path), scene="bench").scene
    assert (scene.ambient_c, scene.thermal_range.min_c, scene.thermal_range.max_c) == (24.0, 10.0, 60.0)
    assert "bounds_assumed" not in scene.notes


def test_every_option_on_the_page_is_one_of_the_configuration():
    options = set(re.findall(r"`?\bdata\.(\w+)", PAGE))
    keys = {
        m for path in (ROOT / "conf" / "data").rglob("*.yaml") for m in re.findall(r"^(\w+):", path.read_text(), re.M)
    }
    assert options and options <= keys
    layouts = {path.stem for path in (ROOT / "conf" / "data").glob("*.yaml")}
    assert set(re.findall(r"`data=(\w+)`", PAGE)) <= layouts
    table = PAGE[PAGE.index("| what you have") : PAGE.index("`data.root`")]
    assert set(re.findall(r"`(\w+)`", "".join(re.findall(r"\|[^|]*\|\n", table)))) == layouts - {
        "synthetic",
        "scenes",
        "benchmark",
    }


def test_every_other_key_of_images_is_understood():
    rows = dict(re.findall(r"^\| `(thermal_file_path|file_path)` \| (.*) \|$", PAGE, re.M))
    for first, keys in (("thermal_file_path", THERMAL_KEYS), ("file_path", VISIBLE_KEYS)):
        assert set(re.findall(r"`(\w+)`", rows[first])) == set(keys) - {first}
