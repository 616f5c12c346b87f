"""NumPy's own archive: all that is known of the Gaussians, over time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from heatsplat.export.formats.base import Format, extra_columns
from heatsplat.export.moment import Moment


class Npz(Format):
    """Geometry, temperature at the moment, attributes, and the layer over time as a basis (docs/export.md).

    **Convention:** where ``about["clipped"]``, what the basis gives is clipped to [0, 1] before the table is asked.
    """

    suffix = ".npz"

    def write(self, moment: Moment, path: Path) -> None:
        seen, basis = moment.seen, moment.layer.basis
        arrays = {
            "means": seen.means,
            "quats_wxyz": seen.quats,
            "scales": seen.scales,
            "opacities": seen.opacities,
            moment.quantity: moment.values,
            "basis_times_s": basis.times_s,
            "basis_offsets": basis.offsets,
            "basis_coefficients": basis.coefficients,
            "basis_curves": basis.curves,
            "table": seen.table,
            "table_ends": np.array(seen.table_ends),
        }
        if seen.colours is not None:
            arrays |= {"colours": seen.colours, "colour_opacities": seen.colour_opacities}
        arrays |= {f"attribute_{name}": values for name, values in extra_columns(moment).items()}
        about = {
            "scene": moment.module.scene.name,
            "unit": seen.unit,
            "layer": moment.layer.name,
            "clipped": moment.layer.clipped,
            "worst_error": moment.layer.worst,
            "time_s": moment.time_s,
            "left_out": seen.left_out,
            "origin": moment.module.scene.notes.get("origin"),
        }
        with open(path, "wb") as file:
            np.savez_compressed(
                file, about=json.dumps(about), **{key: np.asarray(value) for key, value in arrays.items()}
            )
