"""Files: their order by name, writing as a whole or not at all, and reading whatever is in them."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path
from typing import Any

LONGEST_STEM = 200  # bytes that a file's name takes of an image's, which leaves room for what stands about it


def by_numbers(name: str) -> list[str | int]:
    """What names are sorted by so that "image 2" comes before "image 10"."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]


def short_name(name: str, most: int, whole: str | None = None) -> str:
    """A file's name of at most so many bytes, which file systems count: what is longer loses its middle.

    Args:
        name: that is cut where it is too long.
        most: bytes.
        whole: what it stands for; None is the name itself. A hash of it stands behind a name that says less than it.
    """
    whole, content = name if whole is None else whole, name.encode()
    if name == whole and len(content) <= most:
        return name
    mark = f"-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"
    if len(content) > most - len(mark):
        half = (most - len(mark) - len("..")) // 2
        name = "..".join(end.decode(errors="ignore") for end in (content[:half], content[-half:]))
    return name + mark


def utf8(text: str) -> bytes:
    """A text as UTF-8. What Python has for a byte of a file's name that is none becomes \\udcfc or the like, which JSON reads as
    the same."""
    return text.encode("utf-8", "backslashreplace")


def write_atomically(path: str | Path, content: str | bytes | memoryview) -> None:
    """Writes a file through a temporary one beside it, which is on the disk before it gets the name; makes its folder.

    Text is written as ``utf8`` has it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(utf8(content) if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def size_told(count: int) -> str:
    """So many bytes for people: "3.4 MB", or "43 kB" where a tenth of a megabyte is too coarse."""
    return (
        f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB" if count < 1e4 else f"{count / 1e3:.0f} kB"
    )


def read_json_object(path: Path) -> dict[str, Any] | None:
    """The object in a JSON file, or None where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
