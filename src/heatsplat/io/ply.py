"""Splats as a PLY file in the layout of 3DGS, which viewers open, with temperature as an extra property."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.pictures import colorize


def write_splats(
    path: str | Path,
    means: Any,
    log_scales: Any,
    quats: Any,
    opacity_logits: Any,
    values: Any,
    sh_rest: Any = None,
    temperature_k: Any = None,
    colormap: str | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> int:
    """Writes Gaussians for viewers of 3DGS and returns how many; those with a zero quaternion, unseen, stay out.

    **Convention:** one float32 vertex per Gaussian with x y z nx ny nz, f_dc_0..2, f_rest_* (channel by channel),
    opacity (logit), scale_0..2 (logarithm), rot_0..3 (wxyz), ``temperature`` in kelvin where it is given, and attributes
    by their names. A viewer shows the colour 0.5 + C0 * f_dc.

    Args:
        path: ends in .ply; its folder is made.
        means: [N, 3] in world units.
        log_scales: [N, 3].
        quats: [N, 4] wxyz.
        opacity_logits: [N] or [N, 1].
        values: [N, 1] or [N, 3] image values in [0, 1], seen from nowhere in particular; one channel is shown as grey.
        sh_rest: [N, K, C] spherical harmonics of degree 1 and up with C as in ``values``, or None.
        temperature_k: [N] in kelvin, or None.
        colormap: name of a matplotlib map that colours one-channel values, instead of grey; leaves out ``sh_rest``.
        attributes: further properties by name, each [N]; they may be NaN where they are not known.

    Raises:
        ValueError: shapes do not fit, or a value is not finite.
    """
    given = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats,
        "opacity_logits": opacity_logits,
        "values": values,
        "sh_rest": sh_rest,
        "temperature_k": temperature_k,
    }
    arrays = {key: np.asarray(value, dtype=np.float32) for key, value in given.items() if value is not None}
    arrays["opacity_logits"] = arrays["opacity_logits"].reshape(-1, 1)
    _check(arrays)
    count = len(arrays["means"])

    colors = arrays["values"]
    if colormap is not None and colors.shape[1] == 1:
        colors = colorize(colors, 0.0, 1.0, colormap)[:, 0].astype(np.float32) / 255
    rest = np.zeros((count, 0), dtype=np.float32)
    if sh_rest is not None and colormap is None:
        spread = np.broadcast_to(arrays["sh_rest"], (*arrays["sh_rest"].shape[:2], 3))
        rest = spread.transpose(0, 2, 1).reshape(count, -1)
    columns = {
        ("x", "y", "z"): arrays["means"],
        ("nx", "ny", "nz"): np.zeros((count, 3), dtype=np.float32),
        tuple(f"f_dc_{i}" for i in range(3)): np.broadcast_to((colors - 0.5) / C0, (count, 3)),
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): arrays["opacity_logits"],
        tuple(f"scale_{i}" for i in range(3)): arrays["log_scales"],
        tuple(f"rot_{i}" for i in range(4)): arrays["quats"],
    }
    if temperature_k is not None:
        columns[("temperature",)] = arrays["temperature_k"][:, None]
    for name, values in (attributes or {}).items():
        values = np.asarray(values, dtype=np.float32)
        if values.shape != (count,) or any(name in group for group in columns):
            raise ValueError(
                f"attribute {name} must have shape [{count}] and a name of its own, got {list(values.shape)}"
            )
        columns[(name,)] = values[:, None]
    names = [name for group in columns for name in group]
    seen = np.abs(arrays["quats"]).sum(1) > 0
    vertices = np.concatenate(list(columns.values()), axis=1)[seen].astype("<f4")
    table = np.ascontiguousarray(vertices).view([(name, "<f4") for name in names])[:, 0]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(path))
    return int(seen.sum())


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError where an array of ``write_splats`` has not the shape it must have, or is not finite."""
    count, channels = len(arrays["means"]), 3 if arrays["values"].shape[1:] == (3,) else 1
    shapes = {
        "means": (count, 3),
        "log_scales": (count, 3),
        "quats": (count, 4),
        "opacity_logits": (count, 1),
        "values": (count, channels),
        "temperature_k": (count,),
    }
    if "sh_rest" in arrays:
        shapes["sh_rest"] = (count, arrays["sh_rest"].shape[1], channels)
    for name, values in arrays.items():
        if values.shape != shapes[name]:
            raise ValueError(f"{name} must have shape {list(shapes[name])}, got {list(values.shape)}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has values that are NaN or infinite; viewers would show nothing at all")


def read_splats(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of a PLY file in the layout of 3DGS, float32, under the names of ``write_splats``.

    ``values`` come as [N, 3]; ``sh_rest`` [N, K, 3] and ``temperature_k`` [N] only where the file has them.

    Raises:
        ValueError: the file is not a PLY of splats or was damaged, naming what is missing or not finite.
    """
    try:
        vertex = PlyData.read(str(path))["vertex"]
        there = [prop.name for prop in vertex.properties]
        columns = {name: np.asarray(vertex[name], dtype=np.float32) for name in there}
    except OSError:
        raise
    except Exception as error:  # plyfile checks its own grammar; what damage makes of the rest raises anything
        raise ValueError(f"{path} is not a PLY file with vertices: {error!r}") from error

    def stacked(*names: str) -> np.ndarray:
        missing = [name for name in names if name not in columns]
        if missing:
            raise ValueError(f"{path} is no file of splats: it has no property {', '.join(missing)}")
        values = np.stack([columns[name] for name in names], axis=1)
        if not np.isfinite(values).all():
            raise ValueError(f"{path} was damaged: {', '.join(names)} have values that are NaN or infinite")
        return values

    found = {
        "means": stacked("x", "y", "z"),
        "log_scales": stacked("scale_0", "scale_1", "scale_2"),
        "quats": stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacity_logits": stacked("opacity"),
        "values": 0.5 + C0 * stacked("f_dc_0", "f_dc_1", "f_dc_2"),
    }
    rest = sum(name.startswith("f_rest_") for name in columns)
    if rest % 3:
        raise ValueError(f"{path} is no file of splats: {rest} properties f_rest_* are no three channels")
    if rest:
        by_channel = stacked(*(f"f_rest_{i}" for i in range(rest))).reshape(-1, 3, rest // 3)
        found["sh_rest"] = by_channel.transpose(0, 2, 1)
    if "temperature" in columns:
        found["temperature_k"] = stacked("temperature")[:, 0]
    return found
