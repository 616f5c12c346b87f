"""The contract of a format: a moment of a trained scene becomes a file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from torch import Tensor

from heatsplat.contracts import SceneError, check_numbers
from heatsplat.export.moment import Moment
from heatsplat.io.pictures import checked_colormap, colorize

# Columns that files have of every model: a model's attribute of such a name must not stand in their place.
OWN_COLUMNS = frozenset({"temperature", "value", "opacity"})


class Format(ABC):
    """One format is one file with one subclass and one yaml in conf/what/.

    Class attributes:
        suffix: of its files, with the dot.
        from_origin: whether coordinates are the scene's own, which count from its "origin" where one was taken off numbers
            that float32 cannot hold (``notes["origin"]``).
        of_gaussians: whether it is made of the Gaussians in such a way that a box can cut some out.
    """

    suffix: str = ""
    from_origin: bool = True
    of_gaussians: bool = True

    @abstractmethod
    def write(self, moment: Moment, path: Path) -> None:
        """Writes one file, whose folder is there.

        Raises:
            SceneError: the scene lacks what the format needs.
            ImportError: a package of the extra "export" is missing; the message names both.
        """


class Coloured(Format):
    """A format whose Gaussians have colours.

    Args:
        colormap: name of a matplotlib map; "rgb" takes the visible colours of methods that have them.
        range_c: °C at the ends of the map; None takes those that an image of the scene can show.

    Raises:
        SceneError: there is no such map, or ``range_c`` is none.
    """

    def __init__(self, colormap: str = "inferno", range_c: Sequence[float] | None = None) -> None:
        self.colormap = colormap if colormap == "rgb" else checked_colormap("what.colormap", colormap)
        self.range_c = checked_range(range_c)

    def colours(self, moment: Moment) -> np.ndarray:
        """Colours [N, 3] float32 in [0, 1] of the Gaussians' values, or of the visible image.

        Raises:
            SceneError: the model has no colours.
        """
        if self.colormap == "rgb":
            if moment.seen.colours is None:
                raise SceneError("what.colormap=rgb: this method has no colours; give the name of a matplotlib map")
            return moment.seen.colours.numpy()
        low, high = self.range_c or moment.seen.limits
        return colorize(moment.values[:, None], low, high, self.colormap)[:, 0].astype(np.float32) / 255

    def opacities(self, moment: Moment) -> Tensor:
        """Opacities [N] that belong to these colours."""
        visible = moment.seen.colour_opacities if self.colormap == "rgb" else None
        return moment.seen.opacities if visible is None else visible


def optional(package: str, what: str) -> ModuleType:
    """A package of the extra "export". Raises ImportError, naming the extra, where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        missing = package.partition(".")[0]
        raise ImportError(f"what={what} needs {missing}: pip install 'heatsplat[export]'") from error


def checked_range(range_c: Sequence[float] | None, name: str = "what.range_c") -> tuple[float, float] | None:
    """Two increasing numbers; None stays. Raises SceneError with the option's name where they are not."""
    if range_c is None:
        return None
    check_numbers(name, range_c, 2, SceneError)
    if not range_c[0] < range_c[1]:
        raise SceneError(f"{name} must be two increasing numbers, got {list(range_c)}")
    return float(range_c[0]), float(range_c[1])


def extra_columns(moment: Moment) -> dict[str, Tensor]:
    """What the Gaussians carry beside temperature, by name, each [N]; names in letters, digits and underscores.

    A name that the files' own columns have comes as "model_" with that name.
    """
    columns = {}
    for name, values in moment.seen.attributes.items():
        plain = "".join(letter if letter.isalnum() else "_" for letter in name)
        columns[f"model_{plain}" if plain in OWN_COLUMNS else plain] = values
    return columns
