"""What a preparation found and did, as parts of one page."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Section:
    """A part of the report: Markdown under a heading.

    Args:
        title: of the heading.
        lines: Markdown; pictures are linked by their names relative to the prepared folder.
        values: what a program may want to read of it, as plain JSON values.
    """

    title: str
    lines: list[str]
    values: dict[str, object] = field(default_factory=dict)
