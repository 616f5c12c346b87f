"""All checks on a recording, the most costly finding first, and how they are told."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from rich.console import Console
from rich.table import Table

from heatsplat.contracts import SceneData
from heatsplat.doctor import checks
from heatsplat.doctor.base import Check, Finding, Material, material_of
from heatsplat.io.files import write_atomically

log = logging.getLogger("heatsplat")

FINDINGS_FILE = "doctor.json"

NAMES = sorted(module.name for module in iter_modules(checks.__path__))
# By name, and first those that decide what the others may look at.
CHECKS: tuple[Check, ...] = tuple(
    sorted((import_module(f"{checks.__name__}.{name}").CHECK for name in NAMES), key=lambda check: not check.discredits)
)


def examine(material: Material) -> list[Finding]:
    """What is wrong, the most costly first; empty where nothing is."""
    if not len(material.images):
        return []
    found = []
    for check in CHECKS:
        told = check.find(material)
        found += told
        if told and check.discredits:
            material = replace(material, **dict.fromkeys(check.discredits))
    return sorted(found, key=lambda finding: -finding.cost)


def warn_of(scene: SceneData) -> list[Finding]:
    """Warns of what is wrong with a scene that is about to be trained; says nothing where nothing is."""
    found = examine(material_of(scene))
    warn(found)
    return found


def warn(found: Sequence[Finding]) -> None:
    """Warns of findings, one line each."""
    for finding in found:
        log.warning("doctor, %s: %s %s", finding.check, finding.what, finding.remedy)


def show(found: Sequence[Finding], title: str) -> None:
    """Prints a table of findings."""
    console = Console(markup=False, emoji=False)  # names and paths as they are
    if not found:
        console.print(f"{title}: nothing found ({len(CHECKS)} checks)")
        return
    table = Table("", "check", "what", "what helps", title=title)
    for number, finding in enumerate(found, 1):
        table.add_row(str(number), finding.check, finding.what, finding.remedy)
    console.print(table)


def write_findings(found: Sequence[Finding], path: Path) -> None:
    """Writes findings as JSON, the most costly first."""
    write_atomically(path, json.dumps([asdict(finding) for finding in found], indent=1))
