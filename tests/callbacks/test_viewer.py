"""Every run leaves viewer.html, unless it is told not to."""

from running import TINY, run

from heatsplat.viewer.page import FILE

SHORT = ("method=3dgs", "data.scene=static", "max_steps=2")


def test_a_run_leaves_the_page_or_not(tmp_path):
    shown = [setting for setting in TINY if setting != "callbacks.viewer=null"]
    run(tmp_path / "with", *shown, *SHORT)
    run(tmp_path / "without", *TINY, *SHORT)
    assert "viewer" in (tmp_path / "with" / FILE).read_text(encoding="utf-8")
    assert not (tmp_path / "without" / FILE).exists()
