"""The notebooks of the documentation run from top to bottom, with few steps of training."""

import re
from pathlib import Path

import pytest
from running import NO_PICTURES

nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
STEPS = "steps = 1500"
SETTING = '"threads=1"'  # beside which the files of a run are left out that no notebook looks at

each_notebook = pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)


def shortened(path: Path):
    """A notebook that trains for six steps, on a few images."""
    notebook = nbformat.read(path, as_version=4)
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    assert STEPS in first.source
    first.source = first.source.replace(STEPS, "steps = 6")
    run = next(cell for cell in notebook.cells if SETTING in cell.source)
    unseen = ("callbacks.probes=null", "callbacks.images=null", "callbacks.viewer=null", *NO_PICTURES)
    unseen += ("callbacks.costs.fps_repeats=1", "doctor=false", "data.frames=8")
    run.source = run.source.replace(SETTING, ", ".join([SETTING, *map(repr, unseen)]))
    return notebook


@each_notebook
def test_the_cells_of_a_notebook_run_and_draw(path, monkeypatch, tmp_path):
    """In this process, which has the libraries: a kernel of Jupyter's takes ten seconds to load them."""
    from IPython.core.interactiveshell import InteractiveShell
    from matplotlib import pyplot
    from traitlets.config import Config

    monkeypatch.chdir(FOLDER)
    pyplot.close("all")
    shell = InteractiveShell(ipython_dir=str(tmp_path), config=Config(HistoryManager={"enabled": False}))
    try:
        for cell in shortened(path).cells:
            if cell.cell_type == "code":
                shell.run_cell(cell.source).raise_error()
        drawn = [pyplot.figure(number) for number in pyplot.get_fignums()]
        assert any(axes.has_data() for figure in drawn for axes in figure.axes)
    finally:
        pyplot.close("all")


@pytest.mark.slow
@each_notebook
def test_a_notebook_runs_in_jupyter_and_shows_pictures(path):
    notebook = shortened(path)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in data for data in shown)


def scores(notebook) -> list[float]:
    """The first score of each row of results that a notebook shows."""
    shown = [output["data"] for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    return [float(found) for data in shown for found in re.findall(r"^\D*(\d+\.\d{3})", data["text/plain"], re.M)]


@pytest.mark.slow
@each_notebook
def test_what_a_notebook_shows_is_what_its_cells_give_today(path):
    notebook = nbformat.read(path, as_version=4)
    stored = scores(notebook)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(FOLDER)}}).execute()
    assert stored and stored == pytest.approx(scores(notebook), abs=1.0)  # dB


@each_notebook
def test_a_notebook_is_small_and_linked_from_the_readme(path):
    assert path.stat().st_size < 200_000
    assert f"docs/notebooks/{path.name}" in (FOLDER.parents[1] / "README.md").read_text(encoding="utf-8")
