"""Runs a study, a benchmark or a comparison: python src/study.py study=renderer"""

import sys
from pathlib import Path

SOURCES = Path(__file__).resolve().parent
sys.path[:0] = [str(SOURCES), str(SOURCES.parent)]  # the package, and benchmarks/ beside it

if __name__ == "__main__":
    from heatsplat.cli import study

    study()
