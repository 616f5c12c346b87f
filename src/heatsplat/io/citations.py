"""How to cite: heatsplat, and the paper of a method, of CITATION.cff."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

import yaml

from heatsplat import CHECKOUT

CITATION_FILE = "CITATION.cff"


def citations(method: str | None) -> list[str]:
    """Lines of text for a list of references: heatsplat first, then what the file notes as the paper of the method.

    Empty where a copy of the sources came without the file.
    """
    file = yaml.safe_load(_text())
    if file is None:
        return []
    own = f"{_names(file['authors'])}: {file['title']}, version {file['version']}. {file['abstract'].rstrip('.')}."
    papers = [entry for entry in file["references"] if method in re.findall(r"\w+", entry["notes"].partition(";")[0])]
    also = [entry for entry in file["references"] if method in re.findall(r"\w+", entry["notes"].partition(";")[2])]
    return [own, *map(_line, papers or also)]


def _text() -> str:
    """The file in the source tree, or what an installed package has of it."""
    if CHECKOUT is not None:
        file = CHECKOUT / CITATION_FILE
        return file.read_text(encoding="utf-8") if file.exists() else ""
    try:
        return distribution("heatsplat").read_text(f"licenses/{CITATION_FILE}") or ""
    except PackageNotFoundError:
        return ""


def _line(entry: dict[str, Any]) -> str:
    venue = entry.get("journal") or entry.get("collection-title") or "manuscript"
    place = "".join(
        form.format(entry[key]) for key, form in (("volume", " {}"), ("issue", "({})")) if entry.get(key) is not None
    )
    link = f"https://doi.org/{entry['doi']}" if "doi" in entry else entry.get("url", "")
    year = f", {entry['year']}" if "year" in entry else ""
    return f"{_names(entry['authors'])}: {entry['title'].strip()}. {venue}{place}{year}. {link}".strip()


def _names(authors: list[dict[str, str]]) -> str:
    return ", ".join(one.get("name") or f"{one['given-names']} {one['family-names']}" for one in authors)
