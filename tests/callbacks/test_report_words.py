"""What the report calls things: every effect has words, and no word stands for a name that nothing writes."""

import pytest
from helpers import ROOT

from heatsplat.callbacks.report_words import COST_WORDS, EFFECT_WORDS, RISE_WORDS, RUN_WORDS, SETTING_WORDS
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.metrics.definitions import COSTS

SOURCES = {
    folder: "\n".join(
        path.read_text(encoding="utf-8") for path in sorted((ROOT / "src/heatsplat" / folder).rglob("*.py"))
    )
    for folder in ("callbacks", "density", "sensors", "thermal", "training")
}


def test_every_effect_of_the_catalogue_has_words_of_its_own():
    assert set(EFFECT_WORDS) == {effect.name for effect in CATALOGUE}
    assert len(set(EFFECT_WORDS.values())) == len(EFFECT_WORDS)


def test_what_may_rise_has_words_for_its_fall():
    assert RISE_WORDS.keys() <= RUN_WORDS.keys()
    assert all(RUN_WORDS[name][0].replace("fall", "rise") == words for name, words in RISE_WORDS.items())


def test_every_cost_has_words_of_its_own():
    assert set(COST_WORDS) == set(COSTS) and len(set(COST_WORDS.values())) == len(COSTS)


@pytest.mark.parametrize(
    ("words", "folders"),
    [(RUN_WORDS, ("callbacks", "density", "training")), (SETTING_WORDS, ("sensors", "thermal"))],
)
def test_every_name_is_written_by_something(words, folders):
    text = "\n".join(SOURCES[folder] for folder in folders)
    own = (ROOT / "src/heatsplat/callbacks/report_words.py").read_text(encoding="utf-8")
    text = text.replace(own, "")
    assert [name for name in words if f'"{name}"' not in text] == []
