"""heatsplat: thermal-infrared scenes as 3D Gaussians whose appearance is a physical model of heat.

In Python: ``config = heatsplat.compose(["method=etgs", "data.scene=heated"])``, ``heatsplat.train(config)`` and
``heatsplat.load("outputs/.../checkpoints/last.ckpt")``. Each brings what it needs when it is first asked for.
"""

import os
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"
__all__ = ["compose", "load", "train"]

# A wheel has conf/, datamodules/ and preparation/ inside the package. In a checkout they lie beside src/, where setup.py takes
# them from, and the package looks for them there: with or without an editable install, and in any copy of the sources.
CHECKOUT = next((root for root in [Path(__file__).resolve().parents[2]] if (root / "datamodules").is_dir()), None)
if CHECKOUT is not None:
    __path__.append(str(CHECKOUT))

# Threads of OpenMP wait for each other at the end of every parallel loop, some thirty times in a training step. Left to
# themselves they spin meanwhile, in two pools, PyTorch's and Numba's: two runs on two cores then take ten times as long as
# one. If they sleep at once, a run alone takes a fifth longer than it must. So they spin for some microseconds. The
# libraries read this when they are loaded, and children inherit it; what the user sets stands.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "1000"}


def _made_by_intel() -> bool:
    try:
        processor = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:  # not on Linux
        processor = os.environ.get("PROCESSOR_IDENTIFIER", "")
    return "GenuineIntel" in processor


# On processors of Intel, MKL (PyTorch's products of matrices) divides long sums among the threads, so that last bits depend on
# their number. Its strict mode keeps them the same, a third slower where sums are long. It is asked for before the first product.
if _made_by_intel():
    os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("heatsplat.composition" if name == "compose" else "heatsplat.runs.run"), name)
