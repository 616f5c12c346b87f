"""Trains a method on a scene: python src/train.py method=etgs data=rhd data.root=... data.scene=..."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import train

    train()
