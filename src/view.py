"""Writes viewer.html of a checkpoint, which a browser opens: python src/view.py ckpt=..."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import view

    view()
