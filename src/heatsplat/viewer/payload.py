"""A trained scene as one block of arrays and a header that says where each of them lies, for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, evenly_spread
from heatsplat.export.basis import steps_of
from heatsplat.export.snapshot import TOLERANCE_C, TOLERANCE_UNIT, Layer, Snapshot
from heatsplat.io.pictures import lut
from heatsplat.io.quantities import clock_of, words_and_unit

COLORMAPS = ("inferno", "viridis", "turbo", "cividis", "gray", "RdBu_r")  # the last one is for differences
THUMBNAIL = 144  # pixels of the longer side of an image
MOST = 65535  # largest number of 16 bits
UNKNOWN = MOST  # of a Gaussian that has no value of an attribute
LEVELS = MOST - 1  # steps between the ends of a range where some are unknown
LEAST_SCALE = 1e-12  # of a Gaussian, in world units: none is drawn
ATTRIBUTE_SHARE = (0.001, 0.999)  # quantiles between which an attribute is stored
MOMENTS = 12  # images whose times tell the clock of a run
MEAN_CODE = (
    "The model learned a brightness of its own for each training image: shown, also in the model's recording, is that of "
    "the mean of their codes. src/render.py trajectory=train shows each image's."
)
LOG_RATIO = 100.0  # an attribute above 0 whose ends are further apart than this is stored as its logarithm


class Block:
    """Arrays one after the other, each at a multiple of eight bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, values: Any, kind: str) -> dict[str, Any]:
        """Where an array lies: its type ("f4", "f8", "i2", "i1", "u2", "u1"), shape and first byte. Little-endian."""
        array = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
        content = np.ascontiguousarray(array, dtype=f"<{kind}").tobytes()
        place = {"type": kind, "shape": list(array.shape), "offset": self._size}
        content += bytes(-len(content) % 8)
        self._parts.append(content)
        self._size += len(content)
        return place

    @property
    def content(self) -> bytes:
        return b"".join(self._parts)


def payload(module: Any, seen: Snapshot, cameras: int) -> tuple[dict[str, Any], bytes]:
    """The header and the block of a scene.

    Args:
        module: the training module; of it come cameras, images, the settings of the renderer and names.
        seen: its Gaussians (``export.snapshot``).
        cameras: how many training cameras are in it at most, with their images, spread evenly.
    """
    scene: SceneData = module.scene
    block = Block()
    down = torch.stack([frame.camera.viewmat[1, :3] for frame in scene.train.frames]).mean(0)
    centre, size = scene.bulk
    renderer = module.renderer
    header = {
        "format": 3,
        "scene": scene.name,
        "method": module.config.get("name") or type(module.thermal).__name__,
        "unit": seen.unit,
        "limits": list(seen.limits),
        "count": len(seen.means),
        "means": block.add(seen.means, "f4"),
        "quats": block.add((seen.quats * 32767).round(), "i2"),
        "logScales": _between(seen.scales.clamp_min(LEAST_SCALE).log(), block),
        "opacities": block.add((seen.opacities * MOST).round(), "u2"),
        "background": seen.background,
        "table": block.add(seen.table, "f4"),
        "tableEnds": list(seen.table_ends),
        "layers": [_layer(layer, block) for layer in seen.layers],
        "colours": None if seen.colours is None else block.add((seen.colours * 255).round(), "u1"),
        "colourOpacities": None if seen.colour_opacities is None else block.add(seen.colour_opacities, "f4"),
        "attributes": [_attribute(name, values, block) for name, values in seen.attributes.items()],
        "span": None if seen.start_s is None else [seen.start_s, seen.end_s],
        "record": None if seen.start_s is None else [min(scene.train.times_s), max(scene.train.times_s)],
        "moments": _moments(scene),
        **_clock(scene),
        "leftOut": [*seen.left_out, *[MEAN_CODE] * ("frame_offset" in module.thermal.effects())],
        "beyondRecord": module.thermal.beyond_record,
        "renderer": {
            "eps2d": renderer.eps2d,
            "antialiased": renderer.antialiased,
            "finer": module.supersample,
            "near": renderer.near,
            "far": renderer.far,
        },
        "origin": scene.notes.get("origin"),
        "centre": centre.tolist(),
        "size": size,
        "up": (-down / down.norm().clamp_min(1e-12)).tolist(),
        "cameras": _cameras(module, seen, cameras, block),
        "probes": [] if scene.probes is None else scene.probes.tolist(),
        "effects": sorted(module.thermal.effects() | module.sensor.effects()),
        "maps": {name: block.add(lut(name), "u1") for name in COLORMAPS},
    }
    return header, block.content


def _moments(scene: SceneData) -> list[tuple[str, float]]:
    """Names and times of some images, spread over those of all splits: the same images for every split of a scene, by which the
    page finds how far the clocks of two runs are apart."""
    known = {frame.name: frame.time_s for frame in scene.frames if frame.time_s is not None}
    ordered = sorted(known.items(), key=lambda moment: (moment[1], moment[0]))
    return [ordered[i] for i in evenly_spread(len(ordered), MOMENTS)]


def _clock(scene: SceneData) -> dict[str, Any]:
    """The moment of second 0 in seconds since 1970, None where no clock tells it, and whether that is known to be UTC: a camera's
    own clock may count in any zone."""
    clock = clock_of(scene)
    return {"start": None, "utc": False} if clock is None else {"start": clock.at_zero_s, "utc": clock.zone == "UTC"}


def _layer(layer: Layer, block: Block) -> dict[str, Any]:
    """Coefficients lie curve by curve; levels, coefficients and curves in steps."""
    basis = layer.basis
    return {
        "name": layer.name,
        "label": layer.label,
        "worst": layer.worst,
        "aim": layer.tolerance,
        "clipped": layer.clipped,
        "checks": basis.checks,
        "offsets": _steps(basis.offsets, block),
        "coefficients": [_steps(column, block, basis.step) for column in basis.coefficients.unbind(1)],
        "curves": [_steps(curve, block) for curve in basis.curves],
        "times": block.add(basis.times_s, "f8"),
    }


def _steps(values: Tensor, block: Block, least: float = 0.0) -> dict[str, Any]:
    """Where values lie in steps: whole multiples of 256 of them and the rest apart, because alike bytes pack better."""
    steps, size = steps_of(values, least)
    many = (steps.int() + 128) >> 8
    told: dict[str, Any] = {"step": size, "rest": block.add(steps.int() - 256 * many, "i1")}
    return told | {"many": block.add(many, "i2" if many.max() > 127 else "i1")} if many.any() else told


def _between(values: Tensor, block: Block) -> dict[str, Any]:
    """Where values lie as shares of the way from the least to the largest, in 16 bits."""
    low, high = values.aminmax() if values.numel() else (values.new_zeros(()), values.new_ones(()))
    span = (high - low).clamp_min(1e-12)
    return block.add(((values - low) / span * MOST).round(), "u2") | {"low": low.item(), "span": span.item()}


def _attribute(name: str, values: Tensor, block: Block) -> dict[str, Any]:
    """16 bits between the quantiles of ATTRIBUTE_SHARE; NaN is UNKNOWN."""
    known = values[values.isfinite()].double().numpy()
    low, high = np.quantile(known, ATTRIBUTE_SHARE).tolist() if len(known) else (0.0, 1.0)
    logarithmic = low > 0 and high / low > LOG_RATIO
    if logarithmic:
        values, low, high = values.clamp_min(1e-30).log10(), math.log10(low), math.log10(high)
    span = high - low if high > low else 1.0
    levels = ((values.double() - low) / span).clamp(0, 1) * LEVELS
    label, unit = words_and_unit(name)
    return {
        "name": name,
        "label": label,
        "unit": unit,
        "low": low,
        "high": low + span,
        "log": logarithmic,
        "values": block.add(levels.round().nan_to_num(UNKNOWN), "u2"),
    }


def _cameras(module: Any, seen: Snapshot, count: int, block: Block) -> list[dict[str, Any]]:
    """Training cameras with small images: what was recorded, what the sensor of the model adds, what the eye saw."""
    scene = module.scene
    told, tolerance = [], TOLERANCE_C if seen.unit else TOLERANCE_UNIT
    for i in evenly_spread(len(scene.train), count):
        view = scene.train[i]
        frame = view.frame
        with torch.no_grad():
            camera = module.cameras.of(frame)  # the one that is rendered beside what it recorded
        low, high = seen.limits
        small = camera.within(THUMBNAIL)
        size = small.height, small.width
        entry: dict[str, Any] = {
            "name": frame.name,
            "time": frame.time_s,
            "width": camera.width,
            "height": camera.height,
            "intrinsics": [camera.K[0, 0].item(), camera.K[1, 1].item(), camera.K[0, 2].item(), camera.K[1, 2].item()],
            "viewmat": camera.viewmat[:3].flatten().tolist(),
        }
        above = _small(view.image(module.modality).float().mean(-1), size).clamp(0, 1) * (high - low)
        if view.mask is not None:
            above[_small(view.mask.float(), size) < 0.999] = low - high  # the page knows masked pixels by their sign
        entry["recorded"] = _steps(above.flatten(), block, tolerance) | {"size": size}
        if module.sensor.parts:
            entry["added"] = _added(module, frame, size, high - low, tolerance / 10, block)
        if view.rgb is not None:
            entry["rgb"] = block.add((_small(view.rgb.float(), size).clamp(0, 1) * 255).round(), "u1")
        told.append(entry)
    return told


@torch.no_grad()
def _added(
    module: Any, frame: Frame, size: tuple[int, int], span: float, least: float, block: Block
) -> list[Mapping[str, Any]]:
    """What each part of the sensor adds to the image of a frame, in their order, in steps of ``least`` of the scene's unit."""
    output = module.render(frame, depth=module.sensor.needs_depth)
    image, depth = output.features[..., : module.thermal.modality_channels[0]], output.seen_depth
    told = []
    for name, part in module.sensor.parts.items():
        after = part(image, frame, depth) if part.needs_depth else part(image, frame)
        difference = (after - image).mean(-1).cpu() * span
        told.append(_steps(_small(difference, size).flatten(), block, least) | {"name": name.replace("_", " ")})
        image = after
    return told


def _small(image: Tensor, size: tuple[int, int]) -> Tensor:
    """An image [H, W] or [H, W, C] as means over the pixels of a coarser grid."""
    planes = image.unsqueeze(-1) if image.ndim == 2 else image
    small = torch.nn.functional.interpolate(planes.permute(2, 0, 1)[None], size=size, mode="area")[0]
    return small.permute(1, 2, 0).squeeze(-1) if image.ndim == 2 else small.permute(1, 2, 0)
