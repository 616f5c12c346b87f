"""EXIF of pictures: when, where and with what they were taken."""

from __future__ import annotations

import io
import logging
import math
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from PIL import Image

log = logging.getLogger(__name__)

EXIF, GPS = 0x8769, 0x8825  # directories
MAKE, MODEL, TAKEN, TAKEN_ZONE, THOUSANDTHS, FOCAL, SERIAL = 0x10F, 0x110, 0x9003, 0x9011, 0x9291, 0x920A, 0xA431


def exif_in(source: bytes | Path) -> dict[str, Any]:
    """What the EXIF of a picture, or of the file of one, says; only what is there, and nothing for what is damaged or no picture.

    "make", "model", "serial", "focal_mm", "time" (with the zone where the file has one), "latitude_deg", "longitude_deg" and
    "altitude_m".
    """
    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as picture:
            whole = picture.getexif()
            taken, gps = whole.get_ifd(EXIF), whole.get_ifd(GPS)
            found = {"make": whole.get(MAKE), "model": whole.get(MODEL), "serial": taken.get(SERIAL)}
    except Exception as error:  # Pillow raises whatever a damaged directory of tags leads to
        log.debug("no EXIF: %s", error)
        return {}
    found = {key: text for key, value in found.items() if (text := _text(value)) is not None}
    readers = (
        lambda: {"focal_mm": _known(taken[FOCAL], above=0.0)} if FOCAL in taken else {},
        lambda: {"time": _time(taken, gps)},
        lambda: _position(gps),
    )
    for read in readers:  # a clock that was never set must not cost the place
        try:
            found |= read()
        except Exception as error:
            log.debug("EXIF: %s", error)
    return {key: value for key, value in found.items() if value is not None}


def _text(value: Any) -> str | None:
    return str(value).replace("\0", "").strip() or None if value is not None else None


def _known(value: Any, above: float = -math.inf) -> float | None:
    """A number, None for 0/0 (with which cameras say that they do not know it) and for one that is not above the limit."""
    number = float(value)
    return number if math.isfinite(number) and number > above else None


def _time(taken: dict[int, Any], gps: dict[int, Any]) -> datetime | None:
    """The camera's clock, with its zone where it says one, or else the zone that its GPS clock shows it to be in."""
    text = _text(taken.get(TAKEN))
    if text is None:
        return None
    moment = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    part = _text(taken.get(THOUSANDTHS))
    if part and part.isdigit():
        moment += timedelta(seconds=float(f"0.{part}"))
    if zone := _text(taken.get(TAKEN_ZONE)):
        try:
            return datetime.fromisoformat(moment.isoformat() + zone.replace("Z", "+00:00"))
        except ValueError:
            log.debug("EXIF: %r is no time zone", zone)
    if 7 in gps and 29 in gps:
        hours, minutes, seconds = (float(x) for x in gps[7])
        day = datetime.strptime(_text(gps[29]) or "", "%Y:%m:%d").replace(tzinfo=UTC)
        ahead = (moment.replace(tzinfo=UTC) - day).total_seconds() - (3600 * hours + 60 * minutes + seconds)
        quarters = round(ahead / 900)  # zones are whole quarters of an hour
        if abs(quarters) <= 56 and abs(ahead - 900 * quarters) < 120:
            return moment.replace(tzinfo=timezone(timedelta(seconds=900 * quarters)))
    return moment


def _position(gps: dict[int, Any]) -> dict[str, float]:
    def degrees(value: Any, side: Any, negative: str) -> float:
        whole, minutes, seconds = (float(x) for x in value)
        return (whole + minutes / 60 + seconds / 3600) * (-1 if _text(side) == negative else 1)

    if 2 not in gps or 4 not in gps:
        return {}
    latitude, longitude = degrees(gps[2], gps.get(1), "S"), degrees(gps[4], gps.get(3), "W")
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        return {}
    found = {"latitude_deg": latitude, "longitude_deg": longitude}
    if 6 in gps and (height := _known(gps[6])) is not None:
        found["altitude_m"] = -height if gps.get(5) in (1, b"\x01") else height
    return found
