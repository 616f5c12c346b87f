"""The Gaussians of a snapshot at one moment, with their temperature: what a file of another program holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, View, as_written, check_option, is_number, quantile
from heatsplat.export.snapshot import Layer, Snapshot
from heatsplat.geometry.coverage import OPEN, surface_depth
from heatsplat.geometry.looks import Look
from heatsplat.shots import Times, seconds_in

LAYERS = ("auto", "camera", "surface", "truth")


@dataclass(frozen=True)
class Moment:
    """Gaussians [N] at a moment.

    Args:
        seen: the snapshot: geometry, attributes, and the layers over time.
        layer: which of its layers this is.
        time_s: seconds since the first training frame; None where nothing changes.
        blended: [N] values of the layer as renderers blend them.
        values: [N] the same in the unit of the scene: °C, or image values where these are no temperatures.
        module: the training module, for formats that render.
        whole: the moment that these Gaussians were cut out of, which is what cameras see; None of all of them.
        box: [2, 3] float64 corners of where they were cut out, in the coordinates of the data set; None of all of them.
    """

    seen: Snapshot
    layer: Layer
    time_s: float | None
    blended: Tensor
    values: Tensor
    module: Any
    whole: Moment | None = None
    box: Tensor | None = None

    @property
    def quantity(self) -> str:
        """What the values are: "temperature", or "value" where images hold none."""
        return "temperature" if self.seen.unit else "value"

    def of_blended(self, blended: Tensor) -> Tensor:
        """Values in the scene's unit of blended ones, any shape; NaN stays."""
        low, high = self.seen.table_ends
        place = ((blended - low) / (high - low)).nan_to_num().clamp(0, 1) * (len(self.seen.table) - 1)
        below = place.long().clamp(max=len(self.seen.table) - 2)
        share = place - below
        found = self.seen.table[below] * (1 - share) + self.seen.table[below + 1] * share
        return found.where(blended.isfinite(), torch.nan)

    @torch.no_grad()
    def look(self, view: View) -> Look:
        """The values as the camera of a view sees them; NaN where it sees no surface, and where its mask leaves out what it sees:
        nothing of its image told what is there."""
        if self.whole is not None:
            return self.whole.look(view)
        seen, frame = self.seen, view.frame
        shapes = seen.means, seen.quats, seen.scales, seen.opacities[None]
        output = self.module.renderer.values_seen(shapes, self.blended[:, None], frame.camera, depth=True)
        alpha = output.alpha[0]
        known = alpha >= OPEN if view.mask is None else (alpha >= OPEN) & view.mask.to(alpha.device)
        means = (output.features[..., 0] / alpha).where(known, torch.nan)
        return Look(frame.camera, surface_depth(output.depth, alpha), self.of_blended(means))


def checked_box(name: str, box: Any) -> Tensor | None:
    """Lower and upper corner [2, 3] float64 of a box that two opposite corners span; None stays. Raises SceneError with the
    option's ``name`` where they are not two places, or span none."""
    if box is None:
        return None
    places = (
        isinstance(box, list) and len(box) == 2 and all(isinstance(corner, list) and len(corner) == 3 for corner in box)
    )
    if not places or not all(is_number(x) for corner in box for x in corner):
        raise SceneError(f"{name} must be two opposite corners [[x, y, z], [x, y, z]], got {as_written(box)}")
    low, high = torch.tensor(box, dtype=torch.float64).sort(dim=0).values
    if not bool((low < high).all()):
        raise SceneError(f"{name}={box} has no volume: its corners must differ in x, y and z")
    return torch.stack([low, high])


def inside(moment: Moment, box: Tensor) -> Moment:
    """The Gaussians whose centres lie in a box [2, 3] in the coordinates of the data set.

    Raises:
        SceneError: there are none; the message says where they lie.
    """
    places = moment.seen.means.double() + moment.module.scene.origin
    kept = ((places >= box[0]) & (places <= box[1])).all(1)
    if not kept.any():
        ends = [
            ", ".join(f"{x:.6g}" for x in end) for end in quantile(places, places.new_tensor((0.01, 0.99))).tolist()
        ]
        raise SceneError(
            f"box={box.tolist()} holds none of the {len(kept)} Gaussians, which lie between [{ends[0]}] and [{ends[1]}] (98 % of "
            "them along each axis, in the coordinates of the data set)"
        )
    cut = {"seen": moment.seen.of(kept), "blended": moment.blended[kept], "values": moment.values[kept]}
    layer = next(one for one in cut["seen"].layers if one.name == moment.layer.name)
    return replace(moment, layer=layer, whole=moment, box=box, **cut)


def moments_in(scene: SceneData, span: tuple[float, float] | None, times: Times | None) -> list[float | None]:
    """Moments of a scene, [None] where nothing changes.

    Args:
        scene: with the training record.
        span: of time that can be asked for (``snapshot.span_of``).
        times: seconds since the first training frame, or date-times, one or several; None takes ``SceneData.middle_s``.

    Raises:
        SceneError: a moment is none (``shots.seconds_in``) or outside the span, or there is none.
    """
    wanted = None if times is None else seconds_in(scene, times)
    if span is None:
        if wanted is not None:
            raise SceneError(f"time={times}: scene '{scene.name}' does not change in time; leave time out")
        return [None]
    if wanted is None:
        return [scene.middle_s]
    for time_s in wanted:
        if not span[0] <= time_s <= span[1]:
            raise SceneError(
                f"time={time_s:g} s lies outside the record, which runs from {span[0]:g} to {span[1]:g} s; "
                "src/render.py shows what the model predicts beyond it"
            )
    return wanted


def moments(module: Any, seen: Snapshot, times: Times | None, layer: str = "auto") -> list[Moment]:
    """The Gaussians at each of some moments.

    Args:
        module: a training module with its scene.
        seen: its snapshot.
        times: seconds since the first training frame, or date-times, one or several; None takes ``SceneData.middle_s``.
        layer: "camera", "surface" or "truth" (``Layer.name``); "auto" is the surface where the model tells its temperature
            apart from what a camera gets, and the camera elsewhere.

    Raises:
        SceneError: the scene has no such layer, or a moment lies outside its record (``moments_in``).
    """
    check_option("layer", layer, LAYERS, SceneError)
    there = {one.name: one for one in seen.layers}
    name = ("surface" if "surface" in there else "camera") if layer == "auto" else layer
    if name not in there:
        raise SceneError(f"layer={layer}: this method and scene have {', '.join(there)} only")
    found = []
    for time_s in moments_in(module.scene, seen.span, times):
        chosen = there[name]
        blended = chosen.basis.at(time_s)
        # As images have it: beyond their range nothing was ever trained, and single Gaussians are far off there.
        blended = blended.clamp(0, 1) if chosen.clipped else blended
        whole = Moment(seen, chosen, time_s, blended, blended, module)
        found.append(Moment(seen, chosen, time_s, blended, whole.of_blended(blended), module))
    return found
