"""Renders temperatures from a checkpoint: python src/render.py ckpt=... time=600 trajectory=orbit"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT)]

if __name__ == "__main__":
    from heatsplat.cli import render

    render()
