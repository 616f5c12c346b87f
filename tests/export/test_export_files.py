"""Files of several moments, their names."""

from heatsplat.export.files import write_files
from heatsplat.export.formats.npz import Npz


def test_every_moment_has_a_file(cooling, tmp_path):
    written = write_files(cooling.module, Npz(), tmp_path / "new", [0.0, 600.0])
    assert [path.name for path in written] == ["cooling_0s.npz", "cooling_600s.npz"]
    assert all(path.stat().st_size > 1000 for path in written)
