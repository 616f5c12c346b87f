"""heatsplat: thermal-infrared scenes as 3D Gaussians whose appearance is a physical model of heat.

In Python: ``config = heatsplat.compose(["method=etgs", "data.scene=heated"])``, ``heatsplat.train(config)`` and
``heatsplat.load("outputs/.../checkpoints/last.ckpt")``. Each brings what it needs when it is first asked for.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
__all__ = ["compose", "load", "train"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("heatsplat.composition" if name == "compose" else "heatsplat.runs.run"), name)
