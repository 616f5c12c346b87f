"""What tests of preparation share."""

import base64
from pathlib import Path

import pytest
from matplotlib.figure import Figure

DOT = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNgAAAAAgABSK+kcQAAAABJRU5ErkJggg==")


@pytest.fixture
def dots_for_pictures(monkeypatch):
    """Drawing the pictures of a page takes three quarters of preparing a tiny scene; test_preparation_report.py looks at them."""

    def savefig(self, target, **_):
        if hasattr(target, "write"):
            target.write(DOT)
        else:
            Path(target).write_bytes(DOT)

    monkeypatch.setattr(Figure, "savefig", savefig)
