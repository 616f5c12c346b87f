"""What the heat that a wall loses says of the wall, as building physics tells it."""

from __future__ import annotations

from torch import Tensor

OUTSIDE_M2_K_W = 0.04  # resistance between surface and air outside, by convention (ISO 6946, table 7)
CONVECTION = (4.0, 4.0)  # W/(m² K) in still air, and W s/(m³ K) for wind, by convention (ISO 6946, annex C)
LEAST_K = 1.0  # between indoors and the outer surface: below, a loss says nothing of the wall
MOST_INWARD_W_M2 = 10.0  # that errors make of a wall that loses next to nothing; ground takes in more


def u_value(loss_w_m2: Tensor, indoor_c: float, surface_c: Tensor) -> Tensor:
    """Thermal transmittance in W/(m² K) of walls [n] with a constant loss of heat; NaN where it cannot be told, or heat flows in.

    From indoor air to the outer surface a wall lets pass Λ = q / (T_indoor - T_surface), both as means over time: sun and sky
    change the surface's temperature, not what Λ is. U is that with the resistance outside by convention added, as tables and
    rules have it. Small negative values stay, so that means over a well insulated wall are not biased.

    Args:
        loss_w_m2: q, positive outwards.
        indoor_c: of the air.
        surface_c: of the outer surface, mean over time.
    """
    driving = indoor_c - surface_c
    told = (driving > LEAST_K) & (loss_w_m2 > -MOST_INWARD_W_M2)
    return (loss_w_m2 / (driving + OUTSIDE_M2_K_W * loss_w_m2)).where(told, float("nan"))
