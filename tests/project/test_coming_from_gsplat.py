"""docs/coming_from_gsplat.md: every key that it names is in the composed configuration, with the published value beside it, and
its examples run."""

import re
from functools import reduce
from pathlib import Path

import pytest
from running import TINY

import heatsplat
from heatsplat.composition import compose

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "coming_from_gsplat.md").read_text(encoding="utf-8")
CONFIG = compose(["method=3dgs", "recipe=published"])  # published length, density control and rates
NAMED = re.findall(r"`([^`]+)`", re.sub(r"^```python\n.*?^```", "", TEXT, flags=re.M | re.S))
EXAMPLES = re.findall(r"^```python\n(.*?)^```", TEXT, re.M | re.S)
KEYS = sorted({name for name in NAMED if re.fullmatch(r"[a-z]+(\.\w+)+", name) and name.split(".")[0] in CONFIG})
ROWS = re.findall(r"^\| (`\w+`|opacity|[\d.]+ extents) ?([\d.e-]*) \|.*`([a-z]+(?:\.\w+)+)`[^`|]* \|$", TEXT, re.M)
PUBLISHED = {key: float(value or 0.1) for name, value, key in ROWS if value or "extents" in name}


def value_of(key: str):
    """The value of a dotted key. Raises KeyError where the configuration lacks it."""
    return reduce(lambda tree, part: tree[part], key.split("."), CONFIG)


@pytest.mark.parametrize("key", KEYS)
def test_keys_are_in_the_configuration(key):
    group, _, last = key.rpartition(".")
    assert last in value_of(group)


def test_settings_in_commands_are_keys_of_a_command():
    keys = {*CONFIG, *compose([], "render"), "method", "preset", "recipe", "hydra"}
    given = {word.partition("=")[0] for name in NAMED for word in name.split() if re.match(r"[a-z_.]+=[^\"]", word)}
    wrong = {key for key in given if key.split(".")[0] not in keys}
    assert wrong == {"antialiased", "camera", "modality_channels"}  # arguments in Python


@pytest.mark.parametrize("key", PUBLISHED)
def test_published_values_are_those_of_the_configuration(key):
    assert value_of(key) == pytest.approx(PUBLISHED[key], rel=0.003)


def test_the_page_has_the_keys_of_density_control_that_it_is_looked_up_for():
    assert {"density.start", "density.stop", "density.every", "density.duplicate_scale", "renderer.eps2d"} <= set(KEYS)
    assert len(PUBLISHED) >= 9


def test_the_renderer_alone_learns_an_image():
    found = {}
    exec(EXAMPLES[0], found)
    assert found["loss"].item() < 0.1 and tuple(found["output"].alpha.shape) == (1, 48, 64)


def test_a_camera_is_led_back_to_its_image(tmp_path):
    quick = ["data.scene=cooling", *TINY, "max_steps=150", "test=false", "doctor=false"]
    heatsplat.train(compose(["method=etgs", *quick]), tmp_path)
    found = {"CHECKPOINT": tmp_path / "checkpoints" / "last.ckpt"}
    exec(EXAMPLES[1], found)
    assert found["offset"].norm().item() < 0.02
