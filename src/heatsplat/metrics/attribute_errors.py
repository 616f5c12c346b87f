"""Mean absolute errors of material attributes, as of a model's and, beside them, of the table that it was pulled to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from torch import Tensor

# What models call an attribute -> what a scene's ``true_attributes`` calls it, and the factor from its unit to theirs.
TRUE_NAMES = {
    "emissivity": ("emissivity", 1.0),
    "absorptivity": ("absorptivity", 1.0),
    "convection": ("convection_w_m2_k", 1.0),
    "convection_w_m2_k": ("convection_w_m2_k", 1.0),
    "capacity": ("heat_capacity_j_m3_k", 1.0),
    "areal_heat_capacity_kj_m2_k": ("areal_heat_capacity_j_m2_k", 1e-3),
}


def attribute_errors(
    told: Mapping[str, Tensor], truth: Mapping[str, Tensor], weights: Tensor | None = None
) -> dict[str, float]:
    """Mean |told - truth| by name, in the unit of each, of the attributes that both know.

    An attribute was learned where the model's error (``thermal.attributes``) is smaller than that of its prior
    (``thermal.prior``); where they are alike it is only the prior.

    Args:
        told: by the model's names, each [n]; NaN where nothing is known, which does not count.
        truth: by the names of ``SceneData.true_attributes``, each [n].
        weights: [n] how much each Gaussian counts, such as its opacity; None counts all alike.
    """
    errors = {}
    for name, true in true_values(told, truth).items():
        off = (told[name].double() - true.to(told[name].device)).abs()
        share = (off.new_ones(len(off)) if weights is None else weights.double()) * ~off.isnan()
        if float(share.sum()) > 0:
            errors[name] = float((off.nan_to_num() * share).sum() / share.sum())
    return errors


def true_values(names: Iterable[str], truth: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What is true of the attributes that a scene knows, each [n] float64, by the model's ``names`` and in the model's units.

    Args:
        names: as models call their attributes.
        truth: by the names of ``SceneData.true_attributes``, each [n].
    """
    meant = {name: TRUE_NAMES.get(name, (name, 1.0)) for name in names}
    return {name: factor * truth[true].double() for name, (true, factor) in meant.items() if true in truth}
