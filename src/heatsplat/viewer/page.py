"""Writes viewer.html: the page's own files and a scene, in one."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError
from heatsplat.export.snapshot import snapshot
from heatsplat.io.results import write_atomically
from heatsplat.viewer.payload import payload

FILE = "viewer.html"
CAMERAS = 36  # in a page: their images take 1 to 2 MB
SOURCES = Path(__file__).resolve().parent / "page"
SCRIPTS = ("payload.js", "camera.js", "splats.js", "sorting.js", "drawing.js", "chart.js", "viewer.js")


def checked_cameras(count: int) -> int:
    """The number of training cameras of a page.

    Raises:
        SceneError: it is no whole number, or less than one; the page stands at the first when it opens.
    """
    if not isinstance(count, int) or count < 1:
        raise SceneError(f"cameras must be a whole number, 1 or more: the page opens at a training camera; got {count}")
    return count


def write_viewer(module: Any, path: Path, cameras: int = CAMERAS) -> Path:
    """The path of the page that was written: a trained scene that a browser opens from a file, offline.

    Args:
        module: a training module with its scene (``training.scene_model.SceneModel``).
        path: of the file.
        cameras: how many training cameras are in it at most, with small images.

    Raises:
        SceneError: fewer than one camera, or Gaussians that cannot be told apart from the model (``snapshot``).
    """
    header, block = payload(module, snapshot(module), checked_cameras(cameras))
    write_atomically(path, page(header, block))
    return path


def page(header: dict[str, Any], block: bytes) -> str:
    """The page of a header and its arrays (``viewer.payload``)."""
    scripts = "\n".join((SOURCES / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "title": html.escape(f"{header['scene']} · {header['method']}"),
        "style": (SOURCES / "viewer.css").read_text(encoding="utf-8"),
        "header": json.dumps(header, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "block": base64.b64encode(_packed(block)).decode("ascii"),
        "scripts": f'"use strict";\n{scripts}',
    }
    template = (SOURCES / "viewer.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)


def _packed(block: bytes) -> bytes:
    """Packed for numbers that seldom repeat: a twentieth smaller than as text is packed."""
    packer = zlib.compressobj(strategy=zlib.Z_FILTERED)
    return packer.compress(block) + packer.flush()
