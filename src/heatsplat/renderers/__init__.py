"""Renderers: splats and a camera in, pixels out. They know nothing of temperature."""

from heatsplat.renderers.base import BACKENDS as BACKENDS
from heatsplat.renderers.base import rasterization as rasterization
