"""Makes a scene that trains of a camera's files: python src/prepare.py source=FOLDER target=FOLDER"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

if __name__ == "__main__":
    from heatsplat.cli import prepare

    prepare()
