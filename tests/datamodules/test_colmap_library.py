"""What loading pycolmap leaves as it was: who hears SIGTERM."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LISTENER = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7)); "


@pytest.mark.parametrize(("listener", "code"), [(LISTENER, 7), ("", -signal.SIGTERM)], ids=["heard", "not heard"])
def test_kill_is_heard_by_who_listened_before_and_leaves_no_native_trace(listener, code):
    import_it = "from heatsplat.datamodules.formats import colmap_library; "
    told = f"import os, signal, sys; {listener}{import_it}os.kill(os.getpid(), signal.SIGTERM)"
    ended = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, cwd=ROOT / "src")
    assert (ended.returncode, ended.stderr) == (code, "")


def test_no_other_module_loads_pycolmap():
    sources = [path for name in ("datamodules", "preparation", "src") for path in (ROOT / name).rglob("*.py")]
    loads = re.compile(r"^ *(import|from) pycolmap", re.M)
    assert [path.stem for path in sources if loads.search(path.read_text())] == ["colmap_library"]
