"""conf/callbacks: every entry can be built, says what its settings are, and stands in its place."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml
from fake_run import FakeModule, fit, trainer, wall

FILES = [
    Path(__file__).resolve().parents[2] / "conf" / "callbacks" / name
    for name in ("evaluate.yaml", "default.yaml", "live.yaml")
]
ENTRIES = {
    name: entry
    for file in FILES
    for name, entry in yaml.safe_load(file.read_text()).items()
    if name != "defaults" and entry is not None
}


def build(name, **changes):
    settings = dict(ENTRIES[name])
    module, _, cls = settings.pop("_target_").rpartition(".")
    return getattr(import_module(module), cls)(**settings | changes)


@pytest.mark.parametrize("name", list(ENTRIES))
def test_every_setting_is_one_that_exists(name):
    settings = dict(ENTRIES[name])
    module, _, cls = settings.pop("_target_").rpartition(".")
    accepted = inspect.signature(getattr(import_module(module), cls)).parameters
    assert set(settings) <= set(accepted)
    if module.startswith("heatsplat.callbacks"):
        assert set(settings) == set(accepted), "every setting is shown in the file"
        assert all(settings[key] == accepted[key].default for key in settings), "file and code have the same defaults"


NUMBERS = [
    (name, key)
    for name, entry in ENTRIES.items()
    if entry["_target_"].startswith("heatsplat.callbacks")
    for key, value in entry.items()
    if isinstance(value, (int, float)) and not isinstance(value, bool)
]


@pytest.mark.parametrize(("name", "key"), NUMBERS, ids=".".join)
def test_a_number_that_would_end_the_run_when_it_is_used_is_refused_by_name(name, key):
    """Most are used when training is over."""
    with pytest.raises(ValueError, match=re.escape(f"callbacks.{name}.{key} must")):
        build(name, **{key: -2})


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("costs", "every"), ("costs", "fps_views"), ("costs", "fps_repeats"), ("probes", "times"), ("surfaces", "views"),
        ("surfaces", "share"), ("turntable", "frames"), ("turntable", "size"), ("statistics", "every"), ("learned", "views"),
        ("finite", "every"),
    ],
)  # fmt: skip
def test_where_there_has_to_be_one_none_is_refused(name, key):
    with pytest.raises(ValueError, match=re.escape(f"callbacks.{name}.{key} must")):
        build(name, **{key: 0})


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_key_has_a_comment(file):
    for line in file.read_text().splitlines():
        if re.match(r"\s*\w+:", line) and "_target_" not in line and line != "defaults:":
            assert "  # " in line, line


def test_an_evaluation_has_the_measuring_part():
    evaluate, default, _ = (yaml.safe_load(file.read_text()) for file in FILES)
    assert list(evaluate) == [
        "costs",
        "metrics",
        "images",
        "attributes",
        "attribute_errors",
        "probes",
        "courses",
        "learned",
        "surfaces",
        "turntable",
        "viewer",
        "report",
    ]  # costs first, report last
    assert default["defaults"] == ["evaluate", "_self_"]
    assert not set(evaluate) & set(default)
    assert "${" not in FILES[0].read_text()  # needs nothing of a training's configuration


@pytest.mark.parametrize("steps", [8, 9])
def test_checkpoints_at_fixed_steps_and_at_the_end(tmp_path, steps):
    where = {"dirpath": str(tmp_path / "checkpoints")}
    saves = [build("checkpoint", every_n_train_steps=4, **where), build("checkpoint_end", **where)]
    module = FakeModule(wall(), tmp_path)
    fit(module, trainer(tmp_path, saves, steps=steps, every=4))
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["last.ckpt", "step_000004.ckpt", "step_000008.ckpt"]
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == steps
    again = FakeModule(wall(), tmp_path)
    saves = [build("checkpoint", every_n_train_steps=4, **where), build("checkpoint_end", **where)]
    fit(again, trainer(tmp_path, saves, steps=12, every=4), ckpt=tmp_path / "checkpoints" / "step_000004.ckpt")
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["last.ckpt", "step_000004.ckpt", "step_000008.ckpt", "step_000012.ckpt"]
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 12
