"""Mean absolute error of temperature."""

from __future__ import annotations

from torch import Tensor

from heatsplat.contracts import ThermalRange
from heatsplat.metrics.valid import valid_pixels


def mae_c(
    prediction: Tensor,
    target: Tensor,
    thermal_range: ThermalRange,
    mask: Tensor | None = None,
    outlier_c: float | None = None,
) -> float | None:
    """Mean absolute temperature error in °C; None where no pixel is left.

    **Convention:** image values are linear in temperature between the bounds of ``thermal_range``, so an error of 1 is
    the whole range.

    Args:
        prediction, target: [H, W, 1] in [0, 1].
        thermal_range: the temperatures of 0 and 1.
        mask: [H, W] bool, True where a pixel counts.
        outlier_c: pixels with a larger error are dropped before averaging (SupIR-GS: 10 °C). Report it beside the value
            without the rule, never instead of it.

    Raises:
        ValueError: the images have more than one channel: pseudo-colour is no temperature.
    """
    if target.shape[-1] != 1:
        raise ValueError(
            f"temperature error needs one channel, got {target.shape[-1]}; pseudo-colour has no temperature"
        )
    valid = valid_pixels(prediction, target, mask)
    errors = (prediction[valid].double() - target[valid].double()).abs() * thermal_range.span_k
    if outlier_c is not None:
        errors = errors[errors <= outlier_c]
    return errors.mean().item() if errors.numel() else None
