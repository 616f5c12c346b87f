"""Options of studies as they are typed: a word is no list of letters, and what is missing is named."""

import pytest
from omegaconf import OmegaConf

from heatsplat.contracts import SceneError
from heatsplat.studies.options import listed, non_empty, of_runs, subset_of, whole_numbers


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("etgs", ["etgs"]),
        (["etgs", "3dgs"], ["etgs", "3dgs"]),
        ((0, 1), [0, 1]),
        (0, [0]),
        (None, []),
        ([], []),
        (OmegaConf.create(["etgs"]), ["etgs"]),
    ],
)
def test_a_word_or_number_is_a_list_of_one(typed, expected):
    assert listed(typed) == expected


def test_runs_of_a_study_have_its_threads_unless_their_overrides_say_others():
    assert of_runs("max_steps=9", 2) == ["threads=2", "max_steps=9"] and of_runs(None, None) == []


@pytest.mark.parametrize("empty", [[], None])
def test_an_option_without_a_value_is_named(empty):
    with pytest.raises(SceneError, match=r"^study\.seeds=.* has nothing in it: give at least one value$"):
        non_empty("study.seeds", empty)
    assert non_empty("study.seeds", 0) == [0]


def test_a_name_that_there_is_not_and_a_number_that_counts_nothing_are_told_one_by_one():
    assert subset_of("study.only", "hot", ["hot", "cold"]) == ["hot"]
    assert whole_numbers("study.seeds", 0, least=0) == [0]
    with pytest.raises(SceneError, match="each of study.only must be one of hot, cold, got 'warm'"):
        subset_of("study.only", ["hot", "warm"], ["hot", "cold"])
    with pytest.raises(SceneError, match="study.steps must be a whole number, 1 or more, got long"):
        whole_numbers("study.steps", [5, "long"])
    for check in (whole_numbers, lambda key, value: subset_of(key, value, ["hot"])):
        with pytest.raises(SceneError, match="study.only=.* has nothing in it"):
            check("study.only", [])
