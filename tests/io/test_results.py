"""metrics.json: every value a number or null with a reason, written as a whole, read back unchanged."""

import json
import math

import numpy as np
import pytest
import torch

from heatsplat.io.results import RunResults
from heatsplat.metrics.definitions import COSTS, DEFINITIONS


def filled():
    results = RunResults(run={"method": "etgs", "scene": "cooling"}, versions={"heatsplat": "0"})
    results.put("test", "psnr", 31.5)
    results.put("test", "lpips", None, "no weights")
    results.put("cost", "train_seconds", 12.25)
    results.data = {
        "points": torch.tensor([1.0, 2.0]),
        "folder": np.float64(3.5),
        "bounds": (10.0, 50.0),
        "tags": {"b", "a"},
    }
    return results


def test_round_trip(tmp_path):
    path = tmp_path / "deep" / "metrics.json"
    filled().write(path)
    back = RunResults.read(path)
    assert back.test["psnr"] == 31.5
    assert back.reasons["test.lpips"] == "no weights"
    assert back.data == {"points": [1.0, 2.0], "folder": 3.5, "bounds": [10.0, 50.0], "tags": ["a", "b"]}
    again = tmp_path / "again.json"
    back.write(again)
    assert again.read_text() == path.read_text()
    assert [p.name for p in path.parent.iterdir()] == ["metrics.json"]


def test_every_number_is_there_or_explained():
    content = filled().as_json()
    assert set(DEFINITIONS) <= set(content["test"])
    assert set(COSTS) <= set(content["cost"])
    for section in ("test", "cost"):
        for name, value in content[section].items():
            assert (value is None) == (f"{section}.{name}" in content["reasons"]), name
    assert content["reasons"]["cost.render_fps"] == "not measured in this run"


def test_infinity_is_null_with_a_reason(tmp_path):
    results = filled()
    results.put("test", "psnr", math.inf)
    results.data["noise"] = float("nan")
    results.write(tmp_path / "metrics.json")
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["test"]["psnr"] is None
    assert content["reasons"]["test.psnr"] == "infinite"
    assert content["reasons"]["data.noise"] == "not a number"


def test_nothing_is_null_without_a_reason():
    results = RunResults()
    with pytest.raises(ValueError, match=r"test\.psnr is null: say why"):
        results.put("test", "psnr", None)
    with pytest.raises(ValueError, match=r"test\.psnr is NaN"):
        results.put("test", "psnr", float("nan"))
    results.put("test", "psnr", None, "no test views")
    results.put("test", "psnr", 30.0)
    assert results.reasons == {}


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{", "Expecting property name"),
        (b"[]", "sections are missing or no mappings: run, test"),
        (b'{"test": {}}', "no mappings: run, cost"),
        (b'\xff{"test": {}}', "can't decode byte"),
        (b"3", "not iterable"),
    ],
)
def test_a_broken_file_is_named(tmp_path, content, why):
    path = tmp_path / "metrics.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path.name} is not a metrics.json of heatsplat: .*{why}"):
        RunResults.read(path)


@pytest.mark.parametrize("change", [{"test": None}, {"test": {"psnr": "31"}}, {"cost": {"gaussians": math.nan}}])
def test_a_file_with_other_things_in_a_section_is_named(tmp_path, change):
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps(filled().as_json() | change))
    with pytest.raises(
        ValueError, match=r"metrics.json is not .*(no mappings: test|psnr is neither|gaussians is neither)"
    ):
        RunResults.read(path)
