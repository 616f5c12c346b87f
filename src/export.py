"""Writes a checkpoint's scene as a file of another program: python src/export.py ckpt=... what=ply time=600"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import export

    export()
