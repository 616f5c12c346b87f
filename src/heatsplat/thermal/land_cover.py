"""What surfaces of ten land-cover classes are made of: the reference table of ThermoGS (Tab. 8)."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import SceneError

ATTRIBUTES = ("emissivity", "absorptivity", "convection", "capacity")  # no unit, no unit, W/(m² K), J/(m³ K)

# Class -> emissivity, absorptivity, convection coefficient, volumetric heat capacity. The order is that of the labels.
TABLE = {
    "building": (0.85, 0.65, 7.0, 2400e3),
    "road": (0.88, 0.88, 8.0, 2100e3),
    "vehicle": (0.85, 0.70, 15.0, 3500e3),
    "grassland": (0.92, 0.75, 7.0, 2800e3),
    "high_vegetation": (0.93, 0.78, 8.0, 3000e3),
    "sports_field": (0.85, 0.80, 9.0, 2200e3),
    "water_body": (0.96, 0.65, 15.0, 4200e3),
    "farmland": (0.88, 0.75, 7.0, 2000e3),
    "construction_site": (0.82, 0.65, 8.0, 1800e3),
    "bare_ground": (0.85, 0.70, 6.0, 1900e3),
}
CLASSES = tuple(TABLE)
UNKNOWN = -1  # label of a point whose class nobody knows: no reference, and no penalty


def reference(labels: Tensor) -> Tensor:
    """Attributes of classes, [..., 4] float32 in the order of ``ATTRIBUTES``; NaN for ``UNKNOWN``.

    Args:
        labels: [...] integers, positions in ``CLASSES`` or ``UNKNOWN``.
    """
    rows = torch.tensor([*TABLE.values(), (torch.nan,) * len(ATTRIBUTES)], device=labels.device)
    return rows[torch.where(labels < 0, len(TABLE), labels)]


def typical() -> Tensor:
    """Means over the classes, [4]: what a surface is taken for before anything is known of it."""
    return torch.tensor(list(TABLE.values())).mean(0)


def check_labels(labels: Tensor, points: int, scene: str) -> None:
    """Raises SceneError where labels are no classes of the table, or there is not one for every point."""
    if labels.shape != (points,):
        raise SceneError(
            f"scene '{scene}' has {points} points but labels of shape {list(labels.shape)}; give one label per point, in "
            "the order of the points"
        )
    wrong = labels[(labels < UNKNOWN) | (labels >= len(CLASSES))]
    if len(wrong):
        names = ", ".join(f"{number} {name}" for number, name in enumerate(CLASSES))
        raise SceneError(
            f"scene '{scene}' has the label {int(wrong[0])}, which is no land-cover class; there are {names}, and "
            f"{UNKNOWN} where none is known"
        )
