"""Writes viewer.html: the page's own files and a scene, in one."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from pathlib import Path
from typing import Any

from heatsplat.contracts import check_count
from heatsplat.export.snapshot import snapshot
from heatsplat.io.files import write_atomically
from heatsplat.viewer.payload import payload

FILE = "viewer.html"
CAMERAS = 36  # in a page: their images take 1 to 2 MB
SOURCES = Path(__file__).resolve().parent / "page"
SCRIPTS = (
    "payload.js", "camera.js", "splats.js", "sorting.js", "drawing.js", "isotherm.js", "chart.js", "probes.js",
    "areas.js", "compare.js", "controls.js", "viewer.js",
)  # fmt: skip
LIVE = "live.js"  # of a page that a run serves while it trains


def write_viewer(module: Any, path: Path, cameras: int = CAMERAS) -> Path:
    """The path of the page that was written: a trained scene that a browser opens from a file, offline.

    Args:
        module: a training module with its scene (``training.scene_model.SceneModel``).
        path: of the file.
        cameras: how many training cameras are in it at most, with small images.

    Raises:
        SceneError: fewer than one camera, or Gaussians that cannot be told apart from the model (``snapshot``).
    """
    check_count("cameras", cameras)  # the page opens at the first
    header, block = payload(module, snapshot(module), cameras)
    write_atomically(path, page(header, block))
    return path


def page(header: dict[str, Any], block: bytes) -> str:
    """The page of a header and its arrays (``viewer.payload``); with ``live`` in the header one that asks for newer states."""
    names = (*SCRIPTS, LIVE) if "live" in header else SCRIPTS
    scripts = "\n".join((SOURCES / name).read_text(encoding="utf-8") for name in names)
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
