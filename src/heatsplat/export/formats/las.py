"""LAS and LAZ point clouds: a point at the centre of each Gaussian, with what it carries as extra dimensions."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneError, check_numbers, evenly_spread
from heatsplat.export.formats.base import Coloured, extra_columns, optional
from heatsplat.export.moment import Moment
from heatsplat.export.place import AUTO, place_in_file

log = logging.getLogger("heatsplat")

LONGEST_NAME = 32  # bytes of an extra dimension's name (LAS 1.4)
VIEWS = 48  # training views at most that tell where surfaces are
STEPS = 2**30  # of a coordinate, stored as a whole number of 32 bits


class Las(Coloured):
    """LAS 1.4, point format 7. What lies where no training view shows a surface, such as under the ground, is left out.

    Args:
        compressed: LAZ.
        least_opacity: fainter Gaussians are left out, in [0, 1]: much of a surface is made of faint ones, and so is haze.
        colormap, range_c: as in ``Coloured``.
        gps: table of camera positions, "auto" or None (``export.place``).
    """

    from_origin = False

    def __init__(
        self,
        compressed: bool = True,
        least_opacity: float = 0.1,
        colormap: str = "inferno",
        range_c: Sequence[float] | None = None,
        gps: str | None = AUTO,
    ) -> None:
        check_numbers("what.least_opacity", least_opacity, error=SceneError)
        self.suffix = ".laz" if compressed else ".las"
        super().__init__(colormap, range_c)
        self.least_opacity, self.gps = least_opacity, gps

    def write(self, moment: Moment, path: Path) -> None:
        laspy = optional("laspy", "las")
        if path.suffix == ".laz":
            optional("lazrs", "las")
        place = place_in_file(moment.module.scene, self.gps)
        opaque = moment.seen.opacities >= self.least_opacity
        kept = (opaque & _shown(moment)).numpy()
        if not kept.any():
            raise SceneError(
                f"what.least_opacity={self.least_opacity}: no Gaussian that a training view shows is as opaque"
            )
        log.info(
            "%d of %d Gaussians have an opacity of %g or more and lie where a training view shows a surface; %d lie elsewhere",
            kept.sum(), len(kept), self.least_opacity, opaque.sum() - kept.sum(),
        )  # fmt: skip
        points = place(moment.seen.means.double()).numpy()[kept]
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.offsets = np.floor(points.min(0))
        spread = float((points.max(0) - points.min(0)).max())
        header.scales = np.full(3, max(1e-4, 10.0 ** math.ceil(math.log10(max(spread, 1e-9) / STEPS))))
        columns = {moment.quantity: moment.values, "opacity": moment.seen.opacities}
        columns |= {f"scale_{i}": moment.seen.scales[:, i] * place.scale for i in range(3)}
        columns |= extra_columns(moment)
        names = [name[:LONGEST_NAME] for name in columns]
        header.add_extra_dims(
            [
                laspy.ExtraBytesParams(name, "f4", description=moment.seen.unit.replace("°", "deg ") if i == 0 else "")
                for i, name in enumerate(names)
            ]
        )
        if place.crs is not None:
            wkt = optional("rasterio.crs", "las").CRS.from_user_input(place.crs).to_wkt()
            header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
            header.global_encoding.wkt = True
        data = laspy.LasData(header)
        data.x, data.y, data.z = points.T
        # Each point is the one return of a pulse: programs that look at first or last returns leave out those with number 0.
        data.return_number[:] = data.number_of_returns[:] = 1
        data.red, data.green, data.blue = (self.colours(moment)[kept].T * 65535).astype("u2")
        for name, values in zip(names, columns.values(), strict=True):
            data[name] = values.numpy()[kept]
        data.write(str(path))


def _shown(moment: Moment) -> Tensor:
    """Which Gaussians [N] lie where some training view shows a surface."""
    views = moment.module.scene.train
    shown = torch.zeros(len(moment.seen.means), dtype=torch.bool)
    with torch.no_grad():
        for i in evenly_spread(len(views), VIEWS):
            shown |= moment.look(views[i]).sees(moment.seen.means)[0]
    return shown
