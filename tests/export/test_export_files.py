"""Files of several moments, their names."""

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.export.files import write_file, write_files
from heatsplat.export.formats.npz import Npz


def test_moments_close_to_each_other_late_in_a_record_have_files_of_their_own(cooling, tmp_path):
    written = write_files(cooling.module, Npz(), tmp_path, [1700.00002, 1700.00004])
    assert [path.name for path in written] == ["cooling_1700.00002s.npz", "cooling_1700.00004s.npz"]


def test_every_moment_has_a_file(cooling, tmp_path):
    written = write_files(cooling.module, Npz(), tmp_path / "new", [0.0, 600.0])
    assert [path.name for path in written] == ["cooling_0s.npz", "cooling_600s.npz"]
    assert all(path.stat().st_size > 1000 for path in written)


def test_a_moment_outside_the_record_is_refused_before_the_snapshot(cooling, tmp_path, monkeypatch):
    """It may take a minute."""
    monkeypatch.setattr("heatsplat.export.files.snapshot", lambda module: pytest.fail("the snapshot was taken"))
    for times in (99999, float("nan")):
        with pytest.raises(SceneError, match="time"):
            write_files(cooling.module, Npz(), tmp_path, times)
        with pytest.raises(SceneError, match="time"):
            write_file(cooling.module, Npz(), tmp_path / "a.npz", times)
    assert not list(tmp_path.iterdir())


def test_a_box_leaves_gaussians_out_of_every_file(cooling, tmp_path, caplog):
    caplog.set_level("INFO", logger="heatsplat")
    middle = cooling.seen.means.double().median(0).values
    box = torch.stack([middle - 1.0, middle + 1.0])
    written = write_files(cooling.module, Npz(), tmp_path, [0.0, 600.0], box=box)
    whole = write_files(cooling.module, Npz(), tmp_path / "whole", [0.0])
    counts = [len(np.load(path)["means"]) for path in (*written, *whole)]
    assert 0 < counts[0] == counts[1] < counts[2]
    assert f"{counts[0]} of {counts[2]} Gaussians lie in the box" in caplog.text
    for path in written:
        found = np.load(path)
        assert np.abs(found["means"] - middle.numpy()).max() <= 1.0
        assert {len(found[key]) for key in ("temperature", "basis_offsets", "opacities")} == {counts[0]}
