"""Gains of single images beside recorded weather."""

from types import SimpleNamespace

import pytest

from heatsplat.effects import catalogue
from heatsplat.effects.base import Evidence
from heatsplat.effects.physical import agc


@pytest.mark.parametrize(("told", "weathered", "on"), [(False, True, False), (False, False, True), (True, True, True)])
def test_gains_that_cannot_be_told_are_left_out_beside_recorded_weather(told, weathered, on, monkeypatch):
    monkeypatch.setattr(agc, "outdone", lambda *_: False)
    monkeypatch.setattr(agc, "gained", lambda *_: Evidence(100.0, "gains change values", told=told, gain_db=9.0))
    inspected = SimpleNamespace(
        weathered=object() if weathered else None, given=SimpleNamespace(metadata=frozenset({"images"})), blind=False
    )
    verdict = catalogue._verdict(agc.EFFECT, inspected, "auto")
    assert verdict.on == on and verdict.told == told
    assert ("left out beside recorded weather" in verdict.reason) == (weathered and not told)
