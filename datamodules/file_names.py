"""Which names in tables and lists mean which files: people write them with and without folders and endings."""

from __future__ import annotations

import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import PurePosixPath


def stem_of(name: str) -> str:
    """File name without folder and extension."""
    base = PurePosixPath(name.replace("\\", "/")).name
    head, dot, tail = base.rpartition(".")
    return head if dot and tail.isalnum() and not tail.isdigit() else base


def same_files(names: Sequence[str], listed: Iterable[str]) -> dict[str, list[str]]:
    """By each of ``names`` those of ``listed`` that mean the same file: mostly one or none.

    Two names may mean one file if they are the same without folders and ending. Of all pairs that may, those do whose folders
    agree the farthest from the file outwards, for both of them: left/0001.png is that of left/0001.png and never that of
    right/0001.png, and 0001.tiff is either's where no folders tell them apart.
    """
    groups: dict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for at, all_of_them in enumerate((names, listed)):
        for name in dict.fromkeys(all_of_them):
            # Letters and their marks are one character in names that were typed, and two in those of some disks of macOS.
            groups[unicodedata.normalize("NFC", stem_of(name))][at].append(name)
    found: dict[str, list[str]] = {name: [] for name in names}
    for ours, theirs in groups.values():
        if not ours or not theirs:
            continue
        agree = {(one, other): _common_folders(one, other) for one in ours for other in theirs}
        best_of_ours = {one: max(agree[one, other] for other in theirs) for one in ours}
        best_of_theirs = {other: max(agree[one, other] for one in ours) for other in theirs}
        for (one, other), folders in agree.items():
            if folders == best_of_ours[one] == best_of_theirs[other]:
                found[one].append(other)
    return found


def _common_folders(one: str, other: str) -> int:
    """How many folders agree, from the files outwards."""
    folders = [PurePosixPath(name.replace("\\", "/")).parts[-2::-1] for name in (one, other)]
    count = 0
    for a, b in zip(*folders, strict=False):
        if a != b:
            break
        count += 1
    return count
