"""PLY in the layout of 3DGS, for viewers of splats; temperature and attributes as further properties."""

from __future__ import annotations

from pathlib import Path

from heatsplat.export.formats.base import Coloured, extra_columns
from heatsplat.export.moment import Moment
from heatsplat.io.ply import write_splats
from heatsplat.physics.units import kelvin


class Ply(Coloured):
    """Gaussians coloured at a moment.

    Viewers blend these colours, which is not the colour of the blended temperature: edges of unlike temperatures get colours
    between (docs/export.md).

    Args:
        colormap, range_c: as in ``Coloured``.
    """

    suffix = ".ply"

    def write(self, moment: Moment, path: Path) -> None:
        seen = moment.seen
        write_splats(
            path,
            seen.means,
            seen.scales.log().clamp(min=-50),
            seen.quats,
            self.opacities(moment).logit().clamp(-30, 30),
            self.colours(moment),
            temperature_k=kelvin(moment.values) if seen.unit else None,
            attributes=extra_columns(moment),
        )
