"""Settings of any text: what Hydra reads is what was meant, also from a shell."""

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from heatsplat.io.command_lines import as_dict, key_of, keys_of, setting, typed, with_names

TEXTS = [
    "/data/flight_2",
    "/data/flight,2",
    "/data/lr=1e-3",
    "/data/Flug über Köln, 2. Tag",
    "/data/[a] {b}",
    "/data/Mike's",
    "C:\\data\\",
    r"a\'b\\",
    "/data/50$ `x`!",
    '/data/a "b"',
    "2024_08_07",
    "17",
    "-1.5e3",
    "nan",
    "null",
    "True",
    "",
]


@pytest.mark.parametrize("text", TEXTS)
def test_hydra_reads_what_was_meant(text):
    written = setting("data.root", text)
    for argument in (written, *shlex.split(typed(written))):
        (read,) = OverridesParser.create().parse_overrides([argument])
        assert (read.key_or_group, read.value()) == ("data.root", text)


@pytest.mark.parametrize("value", [None, True, False, 17, 2.5e-7])
def test_what_is_no_text_stays_what_it_is(value):
    (read,) = OverridesParser.create().parse_overrides([setting("key", value)])
    assert type(read.value()) is type(value) and read.value() == value


def test_names_that_look_like_numbers_stay_names():
    given = ["data.scene=2024_08_07", "+data.scene=17", "target=1e3", "hydra.run.dir=.5", "data.scene=17,1_2"]
    assert with_names(given) == [
        "data.scene='2024_08_07'", "+data.scene='17'", "target='1e3'", "hydra.run.dir='.5'", "data.scene='17','1_2'"
    ]  # fmt: skip
    others = [
        "data.scene=heated",
        "data.root=null",
        "data.root=/data/17",
        "max_steps=2_000",
        "data.scene='17'",
        "~ckpt",
    ]
    assert with_names(others) == others


def test_plain_text_stays_plain():
    assert typed(setting("data.root", "/data/flight_2")) == "data.root=/data/flight_2"


def test_overrides_are_told_apart_by_what_they_are_for():
    overrides = ["data.scene=heated", "+row='a=b'", "++seed=1", "~logger"]
    assert [key_of(text) for text in overrides] == ["data.scene", "row", "seed", "logger"]
    assert keys_of(overrides) == {"data.scene", "row", "seed", "logger"}
    assert as_dict(overrides) == {"data.scene": "heated", "+row": "'a=b'", "++seed": "1", "~logger": ""}
