"""Options of studies as they are typed: a word is no list of letters, and what is missing is named."""

import pytest
from omegaconf import OmegaConf

from heatsplat.contracts import SceneError
from heatsplat.studies.options import check_count, filled, listed


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


@pytest.mark.parametrize("empty", [[], None])
def test_an_option_without_a_value_is_named(empty):
    with pytest.raises(SceneError, match=r"^study\.seeds=.* has nothing in it: give at least one value$"):
        filled("study.seeds", empty)
    assert filled("study.seeds", 0) == [0]


@pytest.mark.parametrize("wrong", [0, -1, 1.5, "abc", None, True])
def test_what_counts_nothing_is_named(wrong):
    with pytest.raises(SceneError, match=r"^study\.trials must be a whole number, 1 or more, got "):
        check_count("study.trials", wrong)
    check_count("study.trials", 1)
    check_count("study.seeds", 0, least=0)
