"""The notebooks of the documentation run from top to bottom, with few steps of training."""

from pathlib import Path

import pytest
from running import NO_PICTURES

nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
STEPS = "steps = 1500"
SETTING = '"threads=1"'  # beside which the files of a run are left out that no notebook looks at


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_pictures(path):
    notebook = nbformat.read(path, as_version=4)
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    assert STEPS in first.source
    first.source = first.source.replace(STEPS, "steps = 20")
    run = next(cell for cell in notebook.cells if SETTING in cell.source)
    unseen = ("callbacks.probes=null", "callbacks.images=null", "callbacks.viewer=null", *NO_PICTURES)
    run.source = run.source.replace(SETTING, ", ".join([SETTING, *map(repr, unseen)]))
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in data for data in shown)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_small_and_linked_from_the_readme(path):
    assert path.stat().st_size < 200_000
    assert f"docs/notebooks/{path.name}" in (FOLDER.parents[1] / "README.md").read_text(encoding="utf-8")
