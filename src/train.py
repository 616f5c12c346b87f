"""Trains a method on a scene: python src/train.py method=etgs data=rhd data.root=... data.scene=..."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT)]

if __name__ == "__main__":
    from heatsplat.cli import train

    train()
