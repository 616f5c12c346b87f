"""Runs a study, a benchmark or a comparison: python src/study.py study=renderer"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT)]

if __name__ == "__main__":
    from heatsplat.cli import study

    study()
