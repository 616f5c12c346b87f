"""PLY in the layout of 3DGS, for viewers of splats; temperature and attributes as further properties."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from heatsplat.export.formats.base import Format, checked_range, colours_of, extra_columns, opacities_of
from heatsplat.export.moment import Moment
from heatsplat.io.ply import write_splats
from heatsplat.physics.units import kelvin


class Ply(Format):
    """Gaussians coloured at a moment.

    Viewers blend these colours, which is not the colour of the blended temperature: edges of unlike temperatures get colours
    between (docs/export.md).

    Args:
        colormap: name of a matplotlib map; "rgb" takes the visible colours of methods that have them.
        range_c: °C at the ends of the map; None takes the scene's range.
    """

    suffix = ".ply"

    def __init__(self, colormap: str = "inferno", range_c: Sequence[float] | None = None) -> None:
        self.colormap, self.range_c = colormap, checked_range(range_c)

    def write(self, moment: Moment, path: Path) -> None:
        seen = moment.seen
        opacities = opacities_of(moment, self.colormap)
        write_splats(
            path,
            seen.means,
            seen.scales.log().clamp(min=-50),
            seen.quats,
            opacities.logit().clamp(-30, 30),
            colours_of(moment, self.colormap, self.range_c),
            temperature_k=kelvin(moment.values) if seen.unit else None,
            attributes=extra_columns(moment),
        )
