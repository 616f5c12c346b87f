"""A few hundred damaged scenes; ``make fuzz`` tries thousands."""

import json
import random
import re
import time

import mutate
import pytest
import readers
from mutate import Outcome, damaged, guarded, other_bytes


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole")
    readers.write_templates(root)
    return root


@pytest.mark.parametrize("layout", readers.READERS)
def test_damaged_scenes_load_sanely_or_are_refused_by_name(whole, layout, tmp_path):
    outcomes = readers.fuzzed(layout, whole, tmp_path / "copy", range(16))
    assert [outcome for outcome in outcomes if outcome.failed] == []
    assert {outcome.kind for outcome in outcomes} == {"loads", "refused"}


@pytest.mark.parametrize("layout", readers.READERS)
def test_whole_scenes_load(whole, layout, tmp_path, monkeypatch):
    monkeypatch.setattr(mutate, "damage", lambda folder, rng: [])
    (outcome,) = readers.fuzzed(layout, whole, tmp_path / "copy", range(1))
    assert outcome.kind == "loads"


def test_the_guard_sees_hangs_crashes_and_hunger_and_goes_on(monkeypatch):
    monkeypatch.setattr(mutate, "SECONDS", 2.0)

    def work(number):
        if number == 1:
            time.sleep(60)
        if number == 2:
            mutate.os.abort()
        if number == 3:
            try:
                bytearray(64 << 30)
            except MemoryError:
                return Outcome(number, "traceback", "MemoryError")
        return Outcome(number, "loads")

    kinds = [outcome.kind for outcome in guarded(range(5), work)]
    assert kinds == ["loads", "hang", "crash", "traceback", "loads"]


def test_damage_is_repeatable_and_does_something():
    data = json.dumps({"frames": [{"a": [1.0, 2.0]}] * 3}).encode()
    for suffix in (".json", ".csv", ".bin"):
        twice = [[damaged(data, suffix, random.Random(i)) for i in range(50)] for _ in range(2)]
        assert twice[0] == twice[1]
        assert sum(d != data for d in twice[0]) > 40 and len(set(twice[0])) > 25
    assert other_bytes(b"", random.Random(1)) is not None


def test_a_campaign_counts_outcomes_and_fails_for_a_bad_one(capsys):
    def fuzzed(kind, whole, copy, numbers):
        assert (whole / "here").exists()
        return [Outcome(number, "crash" if (kind, number) == ("b", 7) else "loads") for number in numbers]

    def write(root):
        (root / "here").mkdir(parents=True)

    assert mutate.campaign("ab", write, fuzzed, ["0"]) == 1
    printed = capsys.readouterr().out
    assert "b 7: crash" in printed and re.search(r"all +100 +crash 1, loads 99", printed)
    assert mutate.campaign("ab", write, fuzzed, ["0", "a"]) == 0
    assert mutate.campaign("ab", write, fuzzed, ["0", "b", "8"]) == 0
    assert "b 8: loads" in capsys.readouterr().out
