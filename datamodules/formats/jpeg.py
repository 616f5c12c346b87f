"""The segments of a JPEG that stand before its picture: where cameras keep what they measured."""

from __future__ import annotations

from collections.abc import Iterator


def segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, payload) of the segments before the first scan of a JPEG; none of what is no JPEG."""
    if data[:2] != b"\xff\xd8":
        return
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2:
            return
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + length
