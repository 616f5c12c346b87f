"""Files are written as a whole or not at all, and what is none is read as none."""

import pytest

from heatsplat.io.files import read_json_object, write_atomically


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    write_atomically(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "new \ud800")
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("content", [None, b"{", b"[1]", b"3", b"\xff{}"])
def test_what_is_no_object_is_read_as_none(tmp_path, content):
    path = tmp_path / "record.json"
    if content is not None:
        path.write_bytes(content)
    assert read_json_object(path) is None
    path.write_text('{"made": 1}')
    assert read_json_object(path) == {"made": 1}
