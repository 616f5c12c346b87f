"""Files of a trained scene: one for each moment."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from torch import Tensor

from heatsplat.export.formats.base import Format
from heatsplat.export.moment import Moment, inside, moments, moments_in
from heatsplat.export.snapshot import snapshot, span_of
from heatsplat.shots import Times

log = logging.getLogger("heatsplat")


def write_files(
    module: Any, form: Format, folder: Path, times: Times | None = None, layer: str = "auto", box: Tensor | None = None
) -> list[Path]:
    """Paths of the files written, ``<scene>_<seconds>s<suffix>``; what they do not hold is warned of.

    Args:
        module: a training module with its scene (``training.scene_model.SceneModel``).
        form: the format.
        folder: of the files; it is made.
        times: seconds since the first training frame, or date-times, one or several; None takes ``SceneData.middle_s``.
        layer: as in ``export.moment.moments``.
        box: outside of which Gaussians are left out (``export.moment.checked_box``); None leaves out none.

    Raises:
        SceneError: the scene lacks what was asked for.
        ImportError: a package of the extra "export" is missing.
    """
    found = _moments(module, form, times, layer)
    if box is not None:
        found = [inside(moment, box) for moment in found]
        log.info("%d of %d Gaussians lie in the box", len(found[0].values), len(found[0].whole.values))
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for moment in found:
        when = "" if moment.time_s is None else f"_{moment.time_s:.9g}s"
        written.append(folder / f"{module.scene.name}{when}{form.suffix}")
        form.write(moment, written[-1])
    return written


def write_file(module: Any, form: Format, path: Path, time: float | str | None = None) -> None:
    """As ``write_files``, one file at one moment."""
    (moment,) = _moments(module, form, time, "auto")
    form.write(moment, path)


def _moments(module: Any, form: Format, times: Times | None, layer: str) -> list[Moment]:
    """The moments that a format is to write; what their files will not hold is warned of."""
    moments_in(module.scene, span_of(module.scene), times)  # a snapshot may take a minute
    seen = snapshot(module)
    for sentence in seen.left_out:
        log.warning("%s", sentence)
    if form.from_origin and (origin := module.scene.notes.get("origin")) is not None:
        log.warning(
            "coordinates count from %s of the data set, whose numbers are too large for float32; add it to get those back",
            ", ".join(f"{x:.10g}" for x in origin),
        )
    return moments(module, seen, times, layer)
