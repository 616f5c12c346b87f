"""Nested settings and their dotted keys."""

import pytest

from heatsplat.io.settings import at, walk

SETTINGS = {"thermal": {"lr": 0.1, "source": {"_target_": "a.B", "n": 3}, "sky": None}, "seed": 0, "loss": {}}


def test_every_setting_comes_with_its_key_after_what_holds_it():
    found = dict(walk(SETTINGS))
    assert list(found) == [
        "thermal", "thermal.lr", "thermal.source", "thermal.source._target_", "thermal.source.n", "thermal.sky", "seed", "loss",
    ]  # fmt: skip
    assert found["thermal.source"] is SETTINGS["thermal"]["source"] and found["seed"] == 0


@pytest.mark.parametrize("key", ["thermal", "thermal.source.n", "thermal.sky", "loss"])
def test_a_setting_is_found_by_its_key(key):
    assert at(SETTINGS, key, "absent") == dict(walk(SETTINGS))[key]


@pytest.mark.parametrize("key", ["thermal.n", "thermal.lr.n", "nowhere", "thermal.sky.n"])
def test_a_setting_that_is_not_there_is_the_default(key):
    assert at(SETTINGS, key, "absent") == "absent" and at(SETTINGS, key) is None and at(None, key) is None
