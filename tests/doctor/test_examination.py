"""Findings of all checks come in order, and there are none where nothing is wrong."""

from dataclasses import replace

import pytest
from materials import changed, clean

from heatsplat.doctor import examination
from heatsplat.doctor.base import Check, Finding
from heatsplat.doctor.examination import CHECKS, examine, show


@pytest.mark.parametrize("scene", ["static", "heated", "cooling", "glass", "haze"])
def test_clean_recordings_raise_no_alarm(scene):
    assert examine(clean(scene)) == []


def test_findings_come_the_most_costly_first_and_say_what_helps():
    images = clean().images.clone()
    images[5], images[:, 3, 4], images[:, 20, 30] = images[4], 1.0, 1.0
    found = examine(changed(clean(), images))
    assert {"duplicates", "dead_pixels"} <= {one.check for one in found}
    assert [one.cost for one in found] == sorted((one.cost for one in found), reverse=True)
    assert all(one.remedy and 0 < one.cost <= 1.5 for one in found)


def test_every_check_says_what_it_looks_at():
    assert len({check.name for check in CHECKS}) == len(CHECKS) == 14
    assert all(check.summary for check in CHECKS)


@pytest.mark.parametrize("speaks", [False, True])
def test_what_a_finding_discredits_is_no_matter_of_the_other_checks(speaks, monkeypatch):
    finding, looked = Finding("first", 1.0, "wrong", "mend it"), []
    first = Check("first", "", lambda material: [finding] * speaks, discredits=("points", "photos"))
    other = Check("other", "", lambda material: looked.append(material) or [])
    monkeypatch.setattr(examination, "CHECKS", (first, other))
    material = replace(clean(), photos=[])
    assert examine(material) == [finding] * speaks
    assert looked[0] == replace(material, points=None, photos=None) if speaks else looked[0] is material
    assert CHECKS[0].discredits and not any(check.discredits for check in CHECKS[1:])


def test_names_in_square_brackets_are_printed(capsys):
    show([], "/data/[old] site :fire:")
    show([Finding("still", 1.0, "image [a].png", "leave [b].png out")], "[old] site")
    said = capsys.readouterr().out
    assert "/data/[old] site :fire:: nothing found" in said
    assert all(name in said for name in ("[a].png", "[b].png", "[old] site"))
