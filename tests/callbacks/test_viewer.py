"""Every run leaves viewer.html, unless it is told not to or its Gaussians do not stay as they are."""

import re
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from running import TINY, run

from heatsplat.viewer.page import FILE

SHORT = ("method=3dgs", "data.scene=static", "max_steps=2")


def test_a_run_leaves_the_page_or_not(tmp_path):
    shown = [setting for setting in TINY if setting != "callbacks.viewer=null"]
    run(tmp_path / "with", *shown, *SHORT)
    run(tmp_path / "without", *TINY, *SHORT)
    assert "viewer" in (tmp_path / "with" / FILE).read_text(encoding="utf-8")
    assert not (tmp_path / "without" / FILE).exists()


@pytest.mark.parametrize("page", ["README.md", "docs/viewer.md"])
def test_the_pages_name_the_methods_that_leave_none(page):
    root = Path(__file__).parents[2]
    without = set()
    for path in (root / "conf" / "method").glob("*.yaml"):
        part = re.search(r"override /thermal: (\w+)", path.read_text(encoding="utf-8"))
        option, model = part and part[1], {}
        while option and "_target_" not in model:  # else it is that of the option which this one builds upon
            model = yaml.safe_load((root / "conf" / "thermal" / f"{option}.yaml").read_text())
            option = next(iter(model.get("defaults", ())), None)
        module, _, name = model.get("_target_", "").rpartition(".")
        if module and getattr(getattr(import_module(module), name), "stays_here", ""):
            without.add(path.stem)
    assert without == {"instant_ngp", "scaffold_gs", "thermonerf"}
    assert "`scaffold_gs`, `instant_ngp` and `thermonerf`" in (root / page).read_text(encoding="utf-8")
