"""Measures the test views of a checkpoint: python src/evaluate.py ckpt=..."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import evaluate

    evaluate()
