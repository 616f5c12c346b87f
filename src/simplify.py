"""Merges the Gaussians of a checkpoint: python src/simplify.py ckpt=... levels_c=[0.02,0.1]"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import simplify

    simplify()
