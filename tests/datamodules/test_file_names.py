"""Names in tables and lists find the files that they mean."""

import pytest

from heatsplat.datamodules.file_names import same_files, stem_of


@pytest.mark.parametrize(
    ("names", "listed", "expected"),
    [
        (["a/1.png", "b/1.png"], ["b/1.png", "a/1.png"], [["a/1.png"], ["b/1.png"]]),
        (["a/1.png", "b/1.png"], ["a/1"], [["a/1"], []]),  # never that of the other camera
        (["x/a/1.png", "x/b/1.png"], ["b\\1.tiff"], [[], ["b\\1.tiff"]]),
        (["thermal/1.png"], ["images/1.JPG"], [["images/1.JPG"]]),
        (["a/1.png", "b/1.png"], ["1.png"], [["1.png"], ["1.png"]]),
        (["1.png"], ["a/1.png", "b/1.png"], [["a/1.png", "b/1.png"]]),
        (["1.png", "2.png"], ["2.png", "2.png"], [[], ["2.png"]]),
        (["12.500", "12.png"], ["12.500"], [["12.500"], []]),
        ([], ["1.png"], []),
    ],
)
def test_folders_tell_files_of_one_name_apart(names, listed, expected):
    assert list(same_files(names, listed).values()) == expected


def test_stems_lose_folder_and_extension_only():
    assert stem_of("a/b/DJI_1_T.JPG") == stem_of("DJI_1_T") == "DJI_1_T"
    assert stem_of("12.500") == "12.500"
