"""Settings of any text: what Hydra reads is what was meant, also from a shell."""

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from heatsplat.io.command_lines import as_dict, key_of, keys_of, setting, typed

TEXTS = [
    "/data/flight_2",
    "/data/flight,2",
    "/data/lr=1e-3",
    "/data/Flug über Köln, 2. Tag",
    "/data/[a] {b}",
    "/data/Mike's",
]


@pytest.mark.parametrize("text", TEXTS)
def test_hydra_reads_what_was_meant(text):
    written = setting("data.root", text)
    for argument in (written, *shlex.split(typed(written))):
        (read,) = OverridesParser.create().parse_overrides([argument])
        assert (read.key_or_group, read.value()) == ("data.root", text)


def test_plain_text_stays_plain():
    assert typed(setting("data.root", "/data/flight_2")) == "data.root=/data/flight_2"


def test_overrides_are_told_apart_by_what_they_are_for():
    overrides = ["data.scene=heated", "+row='a=b'", "++seed=1", "~logger"]
    assert [key_of(text) for text in overrides] == ["data.scene", "row", "seed", "logger"]
    assert keys_of(overrides) == {"data.scene", "row", "seed", "logger"}
    assert as_dict(overrides) == {"data.scene": "heated", "+row": "'a=b'", "++seed": "1", "~logger": ""}
