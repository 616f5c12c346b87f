"""Measures the test views of a checkpoint: python src/evaluate.py ckpt=..."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT)]

if __name__ == "__main__":
    from heatsplat.cli import evaluate

    evaluate()
