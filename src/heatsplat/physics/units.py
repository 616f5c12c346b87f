"""Constants of physics, each defined here alone. Physics is in kelvin; °C appears at files, metrics and pictures only."""

from __future__ import annotations

from typing import TypeVar

from torch import Tensor

KELVIN_AT_0_C = 273.15
DAY_S = 86400.0
CENTIKELVIN = 0.01  # kelvin per count of cameras that store kelvin x 100 (Lepton's TLinear, Boson's radiometric video)
# Counts whose median and whose bulk lie so are taken for kelvin x 100.
USUAL_MEDIAN_C, USUAL_SPAN_K = (-40.0, 100.0), 200.0
# Numbers in this range may be kelvin of -73 .. 127 °C or °C of a furnace; nothing tells.
MAYBE_KELVIN = (200.0, 400.0)
STEFAN_BOLTZMANN = 5.670374419e-8  # W/(m² K⁴), CODATA 2018


Temperature = TypeVar("Temperature", float, Tensor)


def kelvin(celsius: Temperature) -> Temperature:
    """Temperatures in kelvin of temperatures in °C; any shape, tensor or number."""
    return celsius + KELVIN_AT_0_C


def celsius(kelvin: Temperature) -> Temperature:
    """Temperatures in °C of temperatures in kelvin; any shape, tensor or number."""
    return kelvin - KELVIN_AT_0_C


def is_centikelvin(low: float, median: float, high: float) -> bool:
    """Whether counts are plausible as kelvin x 100, by their 1, 50 and 99 % percentile."""
    return (
        USUAL_MEDIAN_C[0] < CENTIKELVIN * median - KELVIN_AT_0_C < USUAL_MEDIAN_C[1]
        and CENTIKELVIN * (high - low) < USUAL_SPAN_K
    )
