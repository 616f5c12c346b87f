"""Files of several moments, their names."""

from heatsplat.export.files import write_files
from heatsplat.export.formats.npz import Npz


def test_moments_close_to_each_other_late_in_a_record_have_files_of_their_own(cooling, tmp_path):
    written = write_files(cooling.module, Npz(), tmp_path, [1700.00002, 1700.00004])
    assert [path.name for path in written] == ["cooling_1700.00002s.npz", "cooling_1700.00004s.npz"]


def test_every_moment_has_a_file(cooling, tmp_path):
    written = write_files(cooling.module, Npz(), tmp_path / "new", [0.0, 600.0])
    assert [path.name for path in written] == ["cooling_0s.npz", "cooling_600s.npz"]
    assert all(path.stat().st_size > 1000 for path in written)
