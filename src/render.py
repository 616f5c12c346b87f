"""Renders temperatures from a checkpoint: python src/render.py ckpt=... time=600 trajectory=orbit"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import render

    render()
