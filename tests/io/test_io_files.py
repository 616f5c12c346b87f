"""Files are written as a whole or not at all, and what is none is read as none."""

import json
import os

import pytest

from heatsplat.io.files import read_json_object, short_name, size_told, write_atomically


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    write_atomically(path, "old")
    with pytest.raises(TypeError):
        write_atomically(path, 17)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_name_that_is_no_utf_8_can_be_told(tmp_path):
    name = os.fsdecode(b"M\xfcller")
    write_atomically(tmp_path / "run.json", json.dumps({"scene": name}, ensure_ascii=False))
    assert read_json_object(tmp_path / "run.json") == {"scene": name}


@pytest.mark.parametrize("content", [None, b"{", b"[1]", b"3", b"\xff{}"])
def test_what_is_no_object_is_read_as_none(tmp_path, content):
    path = tmp_path / "record.json"
    if content is not None:
        path.write_bytes(content)
    assert read_json_object(path) is None
    path.write_text('{"made": 1}')
    assert read_json_object(path) == {"made": 1}


def test_small_files_have_a_size_too():
    assert [size_told(n) for n in (512, 43_210, 99_999, 150_000, 3_400_000)] == [
        "0.5 kB",
        "43 kB",
        "100 kB",
        "0.1 MB",
        "3.4 MB",
    ]


def test_names_that_are_too_long_lose_their_middle_and_still_differ():
    assert short_name("a" * 40, 40) == "a" * 40 and short_name("küche", 6) == "küche"
    for letter in ("a", "ü", "漢", "😀"):
        names = [short_name(letter * 60 + end, 40) for end in "12"]
        assert len(set(names)) == 2 and all(len(name.encode()) <= 40 and name.startswith(letter) for name in names)
        assert names[0].encode().decode() == names[0]
    assert short_name("a-b", 40, "a/b") == short_name("a-b", 40, "a/b") != short_name("a-b", 40)
