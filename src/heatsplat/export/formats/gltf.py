"""glTF with the extension KHR_gaussian_splatting, in one binary file."""

from __future__ import annotations

import json
import logging
import struct
from pathlib import Path
from typing import Any

import numpy as np

import heatsplat
from heatsplat.export.formats.base import Coloured, extra_columns
from heatsplat.export.moment import Moment
from heatsplat.export.place import upright
from heatsplat.geometry.spherical_harmonics import C0

log = logging.getLogger("heatsplat")

EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS, ARRAY_BUFFER = 5126, 0, 34962  # glTF's numbers
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class Gltf(Coloured):
    """Gaussians coloured at a moment, y up, in metres where the scene's scale is known.

    Viewers blend these colours; the attribute ``_TEMPERATURE`` holds °C, and others begin with an underscore, too. What is
    not known of a Gaussian (NaN) has no place in glTF: an attribute with such values stays out.

    Args:
        colormap, range_c: as in ``Coloured``.
    """

    suffix = ".glb"
    from_origin = False

    def write(self, moment: Moment, path: Path) -> None:
        means, quats, scales = (values.numpy() for values in upright(moment))
        colours = self.colours(moment)
        opacities = self.opacities(moment).numpy()
        arrays = {
            "POSITION": means,
            "COLOR_0": np.concatenate(
                [_linear(colours), opacities[:, None]], axis=1
            ),  # of viewers that know points only
            f"{EXTENSION}:ROTATION": np.roll(quats, -1, axis=1),  # xyzw
            f"{EXTENSION}:SCALE": scales,
            f"{EXTENSION}:OPACITY": opacities[:, None],
            f"{EXTENSION}:SH_DEGREE_0_COEF_0": (colours - 0.5) / C0,
            f"_{moment.quantity.upper()}": moment.values.numpy()[:, None],
        }
        for name, values in extra_columns(moment).items():
            if values.isfinite().all():
                arrays[f"_{name.upper()}"] = values.numpy()[:, None]
            else:
                log.warning(
                    "attribute %s is not known of every Gaussian: glTF has no place for that, it is left out", name
                )
        document, content = _packed(arrays)
        document["meshes"][0]["extras"] = {
            "unit": moment.seen.unit,
            "time_s": moment.time_s,
            "layer": moment.layer.name,
        }
        path.write_bytes(_glb(document, content))


def _packed(arrays: dict[str, np.ndarray]) -> tuple[dict[str, Any], bytes]:
    """The document and the buffer of one primitive."""
    views, accessors, parts, offset = [], [], [], 0
    for values in arrays.values():
        content = np.ascontiguousarray(values, dtype="<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(content), "target": ARRAY_BUFFER})
        kind = {"componentType": FLOAT, "count": len(values), "type": TYPES[values.shape[1]]}
        accessors.append({"bufferView": len(views) - 1, **kind})
        parts.append(content)
        offset += len(content)
    places = arrays["POSITION"].astype("<f4")
    accessors[0] |= {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    attributes = {name: i for i, name in enumerate(arrays)}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: splats}}
    document = {
        "asset": {"version": "2.0", "generator": f"heatsplat {heatsplat.__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return document, b"".join(parts)


def _glb(document: dict[str, Any], content: bytes) -> bytes:
    """glTF's binary container: a header and two chunks, each a multiple of four bytes."""
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode("utf-8")
    chunks = b""
    for kind, chunk, filler in ((b"JSON", text, b" "), (b"BIN\0", content, b"\0")):
        chunk += filler * (-len(chunk) % 4)
        chunks += struct.pack("<I4s", len(chunk), kind) + chunk
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _linear(colours: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
