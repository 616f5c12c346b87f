"""Runs a study, a benchmark or a comparison: python src/study.py study=renderer"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import study

    study()
